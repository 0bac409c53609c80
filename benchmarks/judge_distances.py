"""What a verdict on structure says of fits at known distances, and whether the distance that it names is right.

    python benchmarks/judge_distances.py [--fits 40] [--sizes 300x256 1000x1000 2000x1000]

A simulated fit has the target's structures but for one distribution (how many digits, which; how many roads, how many
cars on the first; how many discs), which is a known total variation away: toward the prior's, or toward a random one.
Features are its counts, read with an error: Gaussian, and now and then by one. Nothing is rendered. Half of the fits
have no distance. Sizes are of real images and of scenes, ``LxN``.
"""

import argparse
import math
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from probscene.app.evaluation.structure_counts import StructureCounts, sample_counts
from probscene.app.loading import load_model
from probscene.inference.features.counting.grouping import ABSENT
from probscene.inference.statistics.verdict import Verdict, structure_verdict
from probscene.model import SceneModel
from probscene.models.aerial2d import poisson
from probscene.structure import StructurePrior, counts, ranked, weights

NOISE, MISREAD = 0.1, 0.02  # objects; share of the counts
AWAY = (2.0, 3.0, 4.0, 5.0)  # distances, in sqrt(1/L + 1/N)
DISCS = Path(__file__).parents[1] / "tests" / "app" / "discs.py"
Shares = NDArray[np.float64]


class Case(NamedTuple):
    """One distribution of a model's structures.

    Attributes:
        prior: its shares under the prior.
        policy: of the structures with other shares.
    """

    model: SceneModel
    target: Shares
    prior: Shares
    policy: Callable[[Shares], StructurePrior]


def cases(rng: np.random.Generator) -> dict[str, Case]:
    digits, aerial, discs = load_model("multi_mnist"), load_model("aerial2d"), load_model(str(DISCS))
    number, share = rng.dirichlet(np.ones(11)), rng.dirichlet(np.ones(10))
    roads, first, other = (
        np.array(each) for each in ((0, 0.05, 0.15, 0.4, 0.4), poisson(9.0).probs, poisson(3.0).probs)
    )
    cars = np.r_[np.full(9, 1 / 9), np.zeros(12)]
    few, colours = np.array([0, 0.1, 0.2, 0.7]), rng.dirichlet(np.ones(2))

    def digit(number: Shares, share: Shares) -> StructurePrior:
        return StructurePrior(digits.grammar, Digits=counts(*number), Digit=weights(*share))

    def road(roads: Shares, first: Shares) -> StructurePrior:
        return StructurePrior(aerial.grammar, Roads=counts(*roads), Cars=ranked(counts(*first), counts(*other)))

    def disc(few: Shares) -> StructurePrior:
        return StructurePrior(discs.grammar, Discs=counts(*few), Disc=weights(*colours))

    return {
        "digits": Case(digits, number, np.full(11, 1 / 11), lambda p: digit(p, share)),
        "classes of digits": Case(digits, share, np.full(10, 0.1), lambda p: digit(number, p)),
        "roads": Case(aerial, roads, np.array([0, 0.25, 0.25, 0.25, 0.25]), lambda p: road(p, first)),
        "cars on the first road": Case(aerial, first / first.sum(), cars, lambda p: road(roads, p)),
        "discs": Case(discs, few, np.full(4, 0.25), disc),
    }


def read(model: SceneModel, found: StructureCounts, rng: np.random.Generator) -> Shares:
    """Features ``(N, D)`` of structures, as a counting network would have them."""
    if model.groups is None:
        drawn = np.column_stack([found.counts, found.counts.sum(1)])
    else:
        scene, rank, number = (x.numpy() for x in next(iter(found.children.values())))
        drawn = np.full((len(found), 1 + model.groups.max_groups), ABSENT)
        drawn[:, 0] = found.counts[:, model.classes.index(model.groups.kind)]
        drawn[scene, 1 + rank] = number
    wrong = rng.choice([-1, 0, 1], drawn.shape, p=[MISREAD / 2, 1 - MISREAD, MISREAD / 2])
    return np.where(drawn < 0, drawn, (drawn + wrong).clip(min=0)) + NOISE * rng.normal(size=drawn.shape)


def at(target: Shares, other: Shares, distance: float) -> Shares | None:
    """Shares a total variation away from the target, toward others; None where these are not so far."""
    whole = np.abs(target - other).sum() / 2
    return None if whole < distance else target + (other - target) * distance / whole


def main():
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--fits", type=int, default=40, help="at each size, at no distance and as many at others")
    parser.add_argument("--sizes", nargs="*", default=["300x256", "1000x1000", "2000x1000"], metavar="LxN")
    args = parser.parse_args()
    for size in args.sizes:
        L, N = map(int, size.split("x"))
        unit, named = math.sqrt(1 / L + 1 / N), []
        rows = {away: [] for away in (0.0, *AWAY)}
        for fit in range(2 * args.fits):
            rng = np.random.default_rng(fit)
            case = list(cases(rng).values())[fit // 2 % 5]
            away = 0.0 if fit % 2 == 0 else AWAY[fit // 2 % len(AWAY)]
            found = None
            while found is None:
                toward = (
                    case.prior if rng.random() < 0.5 else rng.dirichlet(np.ones(len(case.prior))) * (case.target > 0)
                )
                found = at(case.target, toward / toward.sum(), away * unit)
            sides = (case.policy(found), N), (case.policy(case.target), L), (case.model.prior, N)
            features = (
                read(case.model, sample_counts(case.model, *of, 3 * fit + i), rng) for i, of in enumerate(sides)
            )
            verdict = structure_verdict(*features, resolution=0.5, seed=fit)
            visible = verdict.statistics.difference.detectable
            named.append(visible)
            rows[away].append(
                (away * unit, verdict.verdict is Verdict.GOOD, visible is not None and away * unit > visible)
            )
        low, high = min(named), max(named)
        print(f"{L} real images, {N} scenes; named: a TV of {low:.3f} to {high:.3f}", flush=True)
        for away, found in rows.items():
            print(f"    TV {away * unit:.3f}: good {sum(good for _, good, _ in found)} of {len(found)}")
        beyond = [good for found in rows.values() for _, good, above in found if above]
        print(f"    above what is named: good {sum(beyond)} of {len(beyond)}", flush=True)


if __name__ == "__main__":
    main()
