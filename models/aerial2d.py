"""Aerial 2D (Meta-Sim2, section 4.2): roads seen from above, cars on them, trees and houses between them.

The prior puts cars at uniform places and angles; the target has them well spaced in their lanes, nine on the first road
and three on the others, which no context-free grammar can say. Decisions D8 to D11: one to four roads, up to 64 steps,
trees and houses are decoration. Departures from the paper: cars of one road never overlap, without which the feature
network's counts are biased; roads are put so that all fit on the canvas; a guide's pretraining has longer lists of
cars than the prior, because half of the target's first roads have.

``--assets DIR``, or the environment variable ``PROBSCENE_SPRITES``, draws with a folder of RGBA pictures in the
subfolders ``car``, ``tree`` and ``house``.
"""

import math
from collections.abc import Callable
from functools import partial

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from probscene.derive import derive
from probscene.drawing import Drawing, Sprites
from probscene.grammar import Grammar
from probscene.model import Groups, SceneModel
from probscene.policy import Policy
from probscene.scene import SceneGraph
from probscene.structure import Counts, StructurePrior, counts, ranked

from .aerial_sprites import CAR, ROAD, Scenery, drawn, folder

GRAMMAR = Grammar("""
    Scene -> Roads
    Roads -> Road Roads | ε
    Road  -> road(Cars)
    Cars  -> car Cars | ε
""")
CANVAS, MAX_STEPS, CLASSES = 256, 64, ("road", "car")
LANE = ROAD / 4  # pixels from the middle of a road to the middle of a lane
APART = 20.5  # pixels between cars of a lane: more than the diagonal of a car
LANE_CAPACITY = 11  # cars that a lane has room for
EDGE = CAR / 2 + 1  # pixels from the border of the canvas to the middle of the first car
TREES, HOUSES, GAP = 28, 12, 5  # at most so many, and pixels between them and a road
COLOURS = torch.tensor(
    [[0.93, 0.93, 0.92], [0.55, 0.57, 0.60], [0.20, 0.21, 0.24], [0.72, 0.15, 0.13], [0.17, 0.30, 0.58]]
    + [[0.85, 0.78, 0.62], [0.16, 0.38, 0.26], [0.92, 0.72, 0.20]]
)
ROOFS = torch.tensor([[0.72, 0.40, 0.30], [0.58, 0.33, 0.28], [0.55, 0.53, 0.52], [0.66, 0.52, 0.40]])
PRIOR = StructurePrior(GRAMMAR, Roads=counts(0, 1, 1, 1, 1), Cars=counts(*[1] * 9))
# A tenth of the roads have 9 to 20 cars.
PRETRAINING = StructurePrior(GRAMMAR, Roads=counts(0, 1, 1, 1, 1), Cars=counts(*[0.1] * 9, *[0.1 / 12] * 12))


def poisson(mean: float, most: int = 20) -> Counts:
    """Cars on a road: Poisson, cut where a road is full."""
    return counts(*(mean**n / math.factorial(n) for n in range(most + 1)))


TARGET = StructurePrior(
    GRAMMAR, Roads=counts(0, 0.05, 0.15, 0.4, 0.4), Cars=ranked(poisson(9.0), poisson(3.0))
)  # section 4.2


def aerial(num_scenes: int, structure: Policy, spaced: bool, scenery) -> Drawing:
    """The program of prior and target; lengths in pixels, angles in radians."""
    uniform = dist.Uniform(0.0, 1.0)
    with pyro.plate("scenes", num_scenes, dim=-2):
        scene = SceneGraph(GRAMMAR, derive(GRAMMAR, structure, num_scenes, MAX_STEPS))
        below = pyro.sample("roads.below", uniform)  # (N, 1)
        ground = [pyro.sample(f"ground.{name}", uniform) for name in ("look", "x", "y")]
        with scene.nodes("road"):
            distance = pyro.sample("road.distance", uniform)  # (N, M) to the road before, in shares of what is free
            asphalt = pyro.sample("road.asphalt", uniform)
        with scene.nodes("car"):
            side, place, turn, shape, paint = (
                pyro.sample(f"car.{name}", uniform) for name in ("lane", "place", "turn", "shape", "paint")
            )
        with pyro.plate("decoration", TREES + HOUSES, dim=-1):
            where_x, where_y, chance, look, tone = (
                pyro.sample(f"decoration.{name}", uniform) for name in ("x", "y", "there", "look", "tone")
            )
    look_of = scenery()
    road, car = scene.mask("road"), scene.mask("car")
    road_y = _road_places(road, distance, below)
    car_x, lane, heading = _car_places(scene, car, place, side, turn, spaced)
    car_y = scene.of_parent(road_y) + (2 * lane - 1) * LANE
    trees, houses = slice(0, TREES), slice(TREES, None)
    x, y = CANVAS * where_x, CANVAS * where_y
    house = torch.arange(TREES + HOUSES) >= TREES
    clear = _clear(y, torch.where(house, 20.0, 12.0), road_y, road) & (chance < 0.7)

    def layer(kinds, atlas, which, *place, tint=(1.0, 1.0, 1.0), **more):
        return Sprites(kinds, atlas, (which * len(atlas)).long().clamp(max=len(atlas) - 1), *place, tint=tint, **more)

    def colour(table, which):
        return table[(which * len(table)).long().clamp(max=len(table) - 1)] if look_of.tinted else (1.0, 1.0, 1.0)

    everywhere = torch.ones(num_scenes, 1, dtype=torch.bool)
    middle = CANVAS // 2 + torch.round(128 * torch.cat(ground[1:], 1) - 64)  # whole pixels: the ground keeps its grain
    return scene.draw(
        layer((), look_of.grounds, ground[0], middle[:, :1], middle[:, 1:], present=everywhere),
        layer("road", look_of.roads, asphalt, CANVAS / 2 + torch.round(128 * distance - 64), road_y),
        layer(
            (), look_of.houses, look[:, houses], x[:, houses], y[:, houses], math.pi * (look[:, houses] > 0.5) / 2,
            tint=colour(ROOFS, tone[:, houses]), present=clear[:, houses],
        ),
        layer("car", look_of.cars, shape, car_x, car_y, heading, tint=colour(COLOURS, paint)),
        layer(
            (), look_of.trees, look[:, trees], x[:, trees], y[:, trees],
            tint=0.7 + 0.3 * tone[:, trees, None].expand(-1, -1, 3), present=clear[:, trees],
        ),
    )  # fmt: skip


def _road_places(road: Tensor, distance: Tensor, below: Tensor) -> Tensor:
    """``(N, M)`` y of the middle of each road: one a random distance below the other, whole pixels.

    Distances are scaled so that all roads fit; where so many cannot, they overlap evenly.
    """
    distance = distance * road
    number, free = road.sum(1, keepdim=True), (CANVAS - ROAD * road.sum(1, keepdim=True)).clamp(min=0)
    pitch = CANVAS / (number.clamp(min=1) * ROAD).clamp(min=CANVAS) * ROAD
    before = (road.cumsum(1) - 1) * pitch
    return torch.round(before + pitch / 2 + distance.cumsum(1) * free / (distance.sum(1, keepdim=True) + below))


def _car_places(scene: SceneGraph, car: Tensor, place, side, turn, spaced: bool) -> tuple[Tensor, Tensor, Tensor]:
    """x, lane (0 or 1) and heading of the cars, each ``(N, M)``.

    Each car takes the lane that ``side`` says, unless one lane has no room for all that do; then, and in the target, a
    road's cars are shared out over its lanes by the order of ``side``. In a lane they are spaced evenly, or at places
    that are uniform among all at which they do not overlap: sorted uniform numbers, each pushed on by the cars before
    it. A car is turned relative to its lane's direction.
    """
    siblings = (scene.parent[:, :, None] == scene.parent[:, None, :]) & car[:, None, :] & car[:, :, None]

    def rank(key):
        return (siblings & (key[:, None, :] < key[:, :, None])).sum(-1)

    shared, chosen = rank(side) % 2, (side > 0.5).long()
    in_lane = (siblings & (chosen[:, None, :] == chosen[:, :, None])).sum(-1)
    crowded = (siblings & (in_lane > LANE_CAPACITY)[:, None, :]).any(-1)
    lane = torch.where(crowded, shared, shared if spaced else chosen)
    along = torch.where(lane == 1, 0.0, math.pi)
    siblings = siblings & (lane[:, None, :] == lane[:, :, None])
    number, first = siblings.sum(-1), rank(place)
    length = CANVAS - 2 * EDGE
    if spaced:
        pitch = CANVAS / number.clamp(min=1)
        x = pitch * (first + 0.5) + (place - 0.5) * (pitch - APART).clamp(0, 8)
        return x, lane, along + (turn - 0.5) * math.radians(6)
    apart = torch.clamp(length / (number - 1).clamp(min=1), max=APART)
    return (
        EDGE + place * (length - (number - 1).clamp(min=0) * apart) + first * apart,
        lane,
        along + 2 * math.pi * (turn - 0.5),
    )


def _clear(y: Tensor, reach: Tensor, road_y: Tensor, road: Tensor) -> Tensor:
    """``(N, J)`` whether decoration at y that reaches so far keeps off every road."""
    away = (y[:, :, None] - road_y[:, None, :]).abs().masked_fill(~road[:, None, :], math.inf)
    return away.amin(-1) > ROAD / 2 + reach + GAP


def with_assets(path: str, prior: Policy) -> SceneModel:
    """The model with the pictures in a folder."""
    folder(path)  # which finds what is wrong with it
    return aerial2d(partial(folder, path), f"pictures in {path}", prior)


def aerial2d(look: Callable[[], Scenery] = drawn, assets: str = "", prior: Policy = PRIOR) -> SceneModel:
    """The model with scenery of any source, the project's own if none is named; ``assets`` says which in words."""

    def model(name, structure, spaced, **more):
        program = partial(aerial, spaced=spaced, scenery=look)
        more = {"assets": assets, "groups": Groups("road", along="y", max_groups=6), **more}
        return SceneModel(name, GRAMMAR, structure, program, (CANVAS, CANVAS), MAX_STEPS, CLASSES, **more)

    def target(seed: int) -> SceneModel:
        """The experiment's truth; the paper has one, whatever the seed."""
        return model("aerial2d_target", TARGET, True)

    drawn_with = {"with_assets": partial(with_assets, prior=prior), "assets_variable": "PROBSCENE_SPRITES"}
    return model("aerial2d", prior, False, pretraining=PRETRAINING, target=target, **drawn_with)


MODEL = aerial2d()
