"""How near a fit has come to the real images: where it lies between what chance leaves and where it set out from.

Distances are squared energy distances [1] without bias: 0 in expectation for two samples of one distribution, of
whatever sizes. The floor is what chance leaves between two halves of the real sample. How much of the way is left is
the learnt sample's distance over that of the nearest of the others, with a bootstrap interval over images.

Samples may be compared at equal numbers, such as of objects in an image: rows are then weighted so that each sample has
the real shares of numbers, and what differs is not the numbers. Axis letters: N rows of a sample, L real, D features, R
resamples, B bins of numbers.

References:
    [1] Székely, Rizzo, *Energy statistics: a class of statistics based on distances*, 2013.
    [2] Kahn, Marshall, *Methods of reducing sample size in Monte Carlo computations*, 1953: the effective sample size.
"""

from collections.abc import Iterable, Mapping
from enum import StrEnum
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from .two_sample import Features

RESAMPLES, SPLITS = 400, 1000
NEAR = 0.1  # of the squared distance that was to be covered
HALF = 0.5
CLEARLY = 0.9  # of it is left at most where a fit is clearly nearer
BINS = 8  # of numbers, at most
LEAST = 15  # rows of a sample, in effect
COMMON = 0.5  # of the real rows whose number the other sample has, too

Metric = Literal["euclidean", "cityblock"]


class Grade(StrEnum):
    """How good a part of a fit is; the best first."""

    GOOD = "good"
    BETTER = "better than the prior"
    NO_BETTER = "no better than the prior"


def worst(words: Iterable[Grade | None]) -> Grade | None:
    """The worst of them; good where there are none. None is what cannot be judged: it may be no better than the prior,
    and is not known to be."""
    order = (Grade.GOOD, Grade.BETTER, None, Grade.NO_BETTER)
    return order[max((order.index(word) for word in words), default=0)]


class Sample(NamedTuple):
    """Rows of one source.

    Attributes:
        features: ``(N, D)``.
        number: ``(N,)``, at equal values of which sources are compared; None for no such.
    """

    features: Features
    number: NDArray[np.floating] | None = None


class ResidualRatio(NamedTuple):
    """Squared distances from the real sample, and what follows from them.

    Attributes:
        learnt: that of what was learnt.
        others: those of what it is held against, by name; without those that cannot be compared.
        floor: what chance leaves, between two halves of the real rows, in 97.5 % of splits.
        left: the learnt sample's over the nearest other's; None where there is no other, or it is no farther than
            chance leaves between samples of their sizes.
        low, high: 95 % of ``left`` over resamples; 0 and infinity where it is None.
        rows: real rows that were compared.
    """

    learnt: float
    others: dict[str, float]
    floor: float
    left: float | None
    low: float
    high: float
    rows: int

    @property
    def nearest(self) -> str | None:
        """Of the others, the one nearest to the real sample."""
        return min(self.others, key=self.others.__getitem__, default=None)

    @property
    def close(self) -> bool:
        """Whether chance alone would leave as much."""
        return self.learnt <= self.floor

    @property
    def word(self) -> Grade | None:
        """Good where at most a tenth is surely left of the nearest other's distance, or surely less than half and no
        more than chance leaves; better where surely a tenth or more is covered. None where chance would leave as much,
        and the rows are too few to say whether the other is farther: the prior, if it is right, is not called good."""
        if self.left is not None and (self.high <= NEAR or (self.close and self.high < HALF)):
            return Grade.GOOD
        if self.left is not None and self.high <= CLEARLY:
            return Grade.BETTER
        return None if self.close and self.low < HALF else Grade.NO_BETTER

    def record(self) -> dict[str, Any]:
        """For JSON; distances are square roots, so metrics."""
        found = {"learnt": root(self.learnt), **{name: root(value) for name, value in self.others.items()}}
        interval = None if self.left is None else [self.low, self.high if np.isfinite(self.high) else None]
        return {"distances": found | {"floor": root(self.floor)}, "left": self.left, "interval": interval} | {
            "rows": self.rows
        }


def root(squared: float) -> float:
    """The distance; 0 where chance has made it negative."""
    return float(np.sqrt(max(0.0, squared)))


def residual_ratio(
    real: Sample,
    learnt: Sample,
    others: Mapping[str, Sample],
    metric: Metric = "euclidean",
    tests: int = 1,
    seed: int = 0,
) -> ResidualRatio | None:
    """Compare samples with the real one; None where the learnt sample has too few rows of the real numbers.

    Args:
        others: what the learnt sample is held against, such as the prior's; those with too few such rows are left out.
        metric: of rows; both are of negative type.
        tests: how many such comparisons are made together: the confidence of each is raised (Bonferroni).
    """
    rng = np.random.default_rng(seed)
    if len(real.features) < LEAST:
        return None
    here = _Side.of(real, real, rng)
    beside = cdist(real.features, real.features, metric)
    found: dict[str, tuple[NDArray[np.floating], float]] = {}
    for name, sample in {"learnt": learnt, **others}.items():
        if len(sample.features) < LEAST:
            continue
        side = _Side.of(sample, real, rng)
        across, within = cdist(sample.features, real.features, metric), cdist(sample.features, sample.features, metric)
        energies = _energies(side, here, across, within, beside)
        if energies is not None:
            found[name] = energies
    if "learnt" not in found:
        return None
    tail = 0.025 / tests
    floor = max(0.0, float(np.quantile(_halves(beside, seed), 1 - tail)))
    mine, _ = found.pop("learnt")
    values = {name: float(energies[0]) for name, (energies, _) in found.items()}
    name = min(values, key=values.__getitem__, default=None)
    left, low, high = None, 0.0, float("inf")
    if name is not None:
        theirs, rows = found[name]
        # Under chance a distance is as 1 / N + 1 / L, between the halves 4 / L.
        if values[name] > floor * (1 / rows + 1 / len(beside)) * len(beside) / 4:
            left = float(mine[0] / theirs[0])
            with np.errstate(divide="ignore", invalid="ignore"):
                ratios = np.where(theirs > 0, mine / theirs, np.inf)[1:]
            low, high = (float(np.quantile(ratios, q, method="inverted_cdf")) for q in (tail, 1 - tail))
    return ResidualRatio(float(mine[0]), values, floor, left, low, high, len(real.features))


class _Side(NamedTuple):
    """Of a sample: in which bin each row is ``(N, B)``, and how often it was drawn ``(1 + R, N)``, once at first."""

    bins: NDArray[np.floating]
    drawn: NDArray[np.floating]

    @staticmethod
    def of(sample: Sample, real: Sample, rng: np.random.Generator) -> "_Side":
        N = len(sample.features)
        drawn = np.concatenate([np.ones((1, N)), rng.multinomial(N, np.full(N, 1 / N), RESAMPLES).astype(float)])
        if sample.number is None or real.number is None:
            return _Side(np.ones((N, 1)), drawn)
        return _Side(_bins(sample.number, real.number), drawn)


def _bins(number: NDArray[np.floating], real: NDArray[np.floating]) -> NDArray[np.floating]:
    """Which bin each number is in ``(N, B)``: one for each number of the real rows; where there are many, bins of about
    as many real rows each. None for numbers beyond the real ones."""
    values = np.unique(real)
    if len(values) <= BINS:
        return (number[:, None] == values).astype(float)
    values = np.unique(np.quantile(real, np.linspace(0, 1, BINS + 1), method="inverted_cdf"))
    inside = (number >= values[0]) & (number <= values[-1])
    index = np.searchsorted(values[1:-1], number)
    return np.eye(len(values) - 1)[index] * inside[:, None]


def _energies(
    side: _Side,
    real: _Side,
    across: NDArray[np.floating],
    within: NDArray[np.floating],
    beside: NDArray[np.floating],
) -> tuple[NDArray[np.floating], float] | None:
    """Squared distances ``(1 + R,)``, of the samples and of resamples, and how many rows the sample has in effect; None
    where too few have common numbers."""
    mine, theirs = side.drawn @ side.bins, real.drawn @ real.bins  # (1 + R, B)
    both = (mine > 0) & (theirs > 0)
    ratio = np.divide(theirs, mine, out=np.zeros_like(mine), where=both)
    weight, of_real = side.drawn * (ratio @ side.bins.T), real.drawn * (both @ real.bins.T)
    kept = of_real[0].sum() / len(of_real[0])
    rows = _effective(weight[0])
    if kept < COMMON or rows < LEAST or _effective(of_real[0]) < LEAST:
        return None
    return _energy(weight, of_real, across, within, beside), rows


def _energy(
    one: NDArray[np.floating],
    other: NDArray[np.floating],
    across: NDArray[np.floating],
    within: NDArray[np.floating],
    beside: NDArray[np.floating],
) -> NDArray[np.floating]:
    """Of weights ``(R, N)`` and ``(R, L)``, ``(R,)``; no row is paired with itself or with a copy of itself."""
    one, other = (each / np.maximum(each.sum(1, keepdims=True), 1e-12) for each in (one, other))
    far = 2 * ((one @ across) * other).sum(1)
    for weight, distances in ((one, within), (other, beside)):
        far -= ((weight @ distances) * weight).sum(1) / np.maximum(1 - (weight**2).sum(1), 1e-12)
    return far


def _effective(weight: NDArray[np.floating]) -> float:
    """How many rows of equal weight say as much [2]."""
    return float(weight.sum() ** 2 / max((weight**2).sum(), 1e-12))


def _halves(beside: NDArray[np.floating], seed: int) -> NDArray[np.floating]:
    """Squared distances between random halves of the real rows, ``(SPLITS,)``; the same whatever is compared."""
    L = len(beside)
    halves = np.tile(np.arange(L) < L // 2, (SPLITS, 1))
    which = np.random.default_rng([seed, 1]).permuted(halves, axis=1).astype(float)
    return _energy(which, 1 - which, beside, beside, beside)
