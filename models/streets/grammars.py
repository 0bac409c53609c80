"""The three grammars of driving scenes and their structure priors (Meta-Sim2, section 4.3 and supplement).

City, suburban and rural streets are the paper's, with decisions D2 (``X -> x X | ε``) and D3 (rural shoulders hold
what sidewalks hold). Containers are objects of the scene graph, so that what stands in them is their child, and whether
there is a median is a choice of its own. The paper's order of ``Cars`` and ``Median`` is the order from the left: what
is left of the median comes toward us, whether one stands there or not. Of a city's two collections of buildings, the
second goes on where the first ends. Camera, sun and weather are nodes too. ``cyclist`` is the paper's ``bike``.

Both priors draw n ~ U{fewest..most} for every list, the kinds of what stands in it with equal probability, one to four
lanes with equal probability (two to four where the paper's rural street has no fewer), and a median with probability
0.5. The simple prior has 0 to 2 everywhere; the tuned numbers are ours, the paper prints none.
"""

from collections.abc import Mapping
from functools import cache, reduce
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import poisson

from probscene.grammar import Grammar
from probscene.structure import Counts, StructurePrior, counts, weights

VEHICLES = ("car",)  # what Cars derives; vans and trucks are kinds of their own where they are asked for
MAX_STEPS = 144
STREETS = MappingProxyType({
    "Median Lane": 1,
    "Median Lane Lane": 2,
    "Oncoming Median Lane": 2,
    "Oncoming Median Lane Lane": 3,
    "Oncoming Oncoming Median Lane": 3,
    "Oncoming Oncoming Median Lane Lane": 4,
})  # fmt: skip
ROWS = MappingProxyType({"city": 2, "suburban": 1, "rural": 0})  # of buildings on each side
WALK = ("pole", "sign", "pedestrian", "object", "cyclist")
PLANTS = ("bush", "object", "tree")
# Fewest and most in each list: of the tuned prior, and of what a guide is pretrained on beside it.
BOUNDS = MappingProxyType({
    "city": {"Cars": (0, 4), "Walk": (2, 8), "Planting": (0, 6), "Buildings": (2, 4), "Foliage": (0, 3)},
    "suburban": {"Cars": (0, 3), "Walk": (1, 5), "Planting": (0, 6), "Buildings": (2, 5), "Foliage": (2, 6)},
    "rural": {"Cars": (0, 2), "Walk": (0, 3), "Foliage": (8, 18)},
})  # fmt: skip
SIMPLE = (0, 2)
LONGEST = MappingProxyType({"Cars": 12, "Walk": 10, "Planting": 8, "Buildings": 9, "Foliage": 22})
TAIL = 0.1  # share of the lists of pretraining that are longer than the prior's
FAR = 0.4  # total variation
SHARES = MappingProxyType({"car": 0.86, "van": 0.1, "truck": 0.04})  # among vehicles


@cache
def grammar(scenario: str, vehicles: tuple[str, ...] = VEHICLES) -> Grammar:
    """The grammar of ``"city"``, ``"suburban"`` or ``"rural"``."""
    streets = [f"street({symbols})" for symbols in _streets(scenario)]
    walk = "shoulder" if scenario == "rural" else "sidewalk"
    outer = f"{walk}(Walk){' row(Buildings)' * ROWS[scenario]} verge(Foliage)"
    rows = [
        "Scene -> camera sun weather Street Outer_L Outer_R",
        f"Street -> {' | '.join(streets)}",
        "Median -> median | ε" if scenario == "rural" else "Median -> median(Planting) | ε",
        "Lane -> lane(Cars)",
        "Oncoming -> oncoming(Cars)",
        f"Outer_L -> left({outer})",
        f"Outer_R -> right({outer})",
        _list("Cars", vehicles),
        _list("Walk", WALK),
        *([] if scenario == "rural" else [_list("Planting", PLANTS), _list("Buildings", ("building",))]),
        _list("Foliage", ("tree",)),
    ]
    return Grammar("\n".join(rows))


@cache
def prior(scenario: str, name: str = "tuned", vehicles: tuple[str, ...] = VEHICLES) -> StructurePrior:
    """The ``"tuned"`` or the ``"simple"`` prior of a scenario."""
    return _policy(scenario, vehicles, {key: _uniform(*limits) for key, limits in bounds(scenario, name).items()})


@cache
def pretraining(scenario: str, name: str = "tuned", vehicles: tuple[str, ...] = VEHICLES) -> StructurePrior:
    """The prior but that a tenth of the lists are longer, so that a guide can learn to make many of anything."""
    lists = {}
    for key, (fewest, most) in bounds(scenario, name).items():
        more, less = LONGEST[key] - most, most - fewest + 1
        below = [TAIL / 2 / fewest] * fewest if fewest else []
        lists[key] = below + [(1 - TAIL - sum(below)) / less] * less + [TAIL / more] * more
    return _policy(scenario, vehicles, lists)


def target(scenario: str, seed: int, vehicles: tuple[str, ...] = VEHICLES) -> StructurePrior:
    """A truth to be found: lists of Poisson lengths with random means, and random shares of the streets and of what
    stands in a list.

    Lists are no longer than those of pretraining. Means are uniform up to one more than the tuned prior's most, shares
    Dirichlet draws of ``seed``; those of vehicles and streets are drawn again until the number of vehicles differs from
    either prior's by ``FAR``.
    """
    rng = np.random.default_rng([seed, *scenario.encode()])
    limits = bounds(scenario, "tuned")
    lists = {key: _poisson(rng, key, most) for key, (_, most) in limits.items()}
    kinds = {"Walk": rng.dirichlet(np.ones(len(WALK))), "Planting": rng.dirichlet(np.ones(len(PLANTS)))}
    known = [
        vehicle_numbers(scenario, _uniform(*bounds(scenario, name)["Cars"]), _lane_weights(scenario))
        for name in ("tuned", "simple")
    ]
    while True:
        lists["Cars"] = _poisson(rng, "Cars", limits["Cars"][1])
        streets = rng.dirichlet(np.ones(len(_streets(scenario))))
        numbers = vehicle_numbers(scenario, lists["Cars"], streets)
        if min(np.abs(numbers - other).sum() / 2 for other in known) >= FAR:
            return _policy(scenario, vehicles, lists, kinds, streets)


def vehicle_numbers(scenario: str, lengths: ArrayLike, streets: ArrayLike) -> np.ndarray:
    """``(49,)``, how probable each number of vehicles in a scene is.

    Args:
        lengths: probabilities of a lane's number, at most 12; ``streets`` of the productions; up to a factor.
    """
    each = np.asarray(lengths) / np.sum(lengths)
    total = np.zeros(4 * LONGEST["Cars"] + 1)
    for symbols, share in zip(_streets(scenario), np.asarray(streets) / np.sum(streets), strict=True):
        number = reduce(np.convolve, [each] * STREETS[symbols])
        total[: len(number)] += share * number
    return total


def bounds(scenario: str, name: str) -> dict[str, tuple[int, int]]:
    """Fewest and most of each list."""
    return {key: SIMPLE if name == "simple" else limits for key, limits in BOUNDS[scenario].items()}


def _policy(scenario, vehicles, lists, kinds: Mapping[str, Any] = MappingProxyType({}), streets=None) -> StructurePrior:
    """``lists``: probabilities of lengths; ``kinds``: of what stands in a list; ``streets``: of the productions."""
    streets = _lane_weights(scenario) if streets is None else streets
    kinds = {"Cars": [SHARES[name] for name in vehicles], **kinds}

    def counted(key) -> Counts:
        return counts(*lists[key], weights=tuple(map(float, kinds[key])) if key in kinds else None)

    return StructurePrior(grammar(scenario, vehicles), Street=weights(*streets), **{key: counted(key) for key in lists})


def _streets(scenario: str) -> list[str]:
    return [symbols for symbols in STREETS if scenario != "rural" or symbols.startswith("Oncoming")]


def _lane_weights(scenario: str) -> list[float]:
    """Of the productions, so that every number of lanes is as probable."""
    lanes = [STREETS[symbols] for symbols in _streets(scenario)]
    return [1 / lanes.count(number) for number in lanes]


def _poisson(rng: np.random.Generator, key: str, most: int) -> np.ndarray:
    """Probabilities of a list's lengths, of a random mean."""
    return poisson.pmf(np.arange(LONGEST[key] + 1), rng.uniform(0, most + 1))


def _uniform(fewest: int, most: int) -> list[float]:
    return [0.0] * fewest + [1.0] * (most - fewest + 1)


def _list(name: str, kinds: tuple[str, ...]) -> str:
    return f"{name} -> {' | '.join(f'{kind} {name}' for kind in kinds)} | ε"
