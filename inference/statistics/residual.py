"""How much of its distance from the real images a fit has left: its squared energy distance over that of its reference.

Distances are squared energy distances [1] without bias: 0 in expectation for two samples of one distribution, of
whatever sizes. The noise floor is the distance between two halves of the real sample. The ratio is the learnt sample's
distance over that of the nearest reference, such as the prior, with a bootstrap interval over images.

Samples may be compared at equal numbers, such as of objects in an image: rows are then weighted so that each sample has
the real shares of numbers, and numbers alone make no distance. Axis letters: N rows of a sample, L real, D features, R
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

from .energy import Features, weighted_energy

RESAMPLES, FLOOR_SPLITS = 400, 1000
GOOD_RATIO = 0.1  # upper limit of the ratio
GOOD_RATIO_AT_FLOOR = 0.5  # the same where the learnt distance is within the noise floor
BETTER_RATIO = 0.9
MAX_BINS = 8  # of numbers
MIN_ROWS = 15  # of a sample, in effect
MIN_COMMON_SHARE = 0.5  # of the real rows, whose number the other sample has as well

Metric = Literal["euclidean", "cityblock"]


class Grade(StrEnum):
    """How good a part of a fit is; the best first."""

    GOOD = "good"
    BETTER = "better than the prior"
    NO_BETTER = "no better than the prior"


def worst_grade(grades: Iterable[Grade | None]) -> Grade | None:
    """The worst of them; good where there are none. None, which cannot be judged, is between better and no better."""
    order = (Grade.GOOD, Grade.BETTER, None, Grade.NO_BETTER)
    return order[max((order.index(grade) for grade in grades), default=0)]


class Sample(NamedTuple):
    """Rows of one source.

    Attributes:
        features: ``(N, D)``.
        number: ``(N,)``, at equal values of which sources are compared; None for no such.
    """

    features: Features
    number: NDArray[np.floating] | None = None


class ResidualRatio(NamedTuple):
    """Squared distances from the real sample, and their ratio.

    Attributes:
        learnt: of the learnt sample.
        references: of the samples it is compared with, by name; without those that cannot be compared.
        floor: between two halves of the real rows, the 97.5 % quantile over splits.
        ratio: the learnt sample's over the nearest reference's; None where there is no reference, or where its distance
            is within the noise of samples of these sizes.
        low, high: 95 % limits of ``ratio`` over resamples; 0 and infinity where it is None.
        rows: real rows that were compared.
    """

    learnt: float
    references: dict[str, float]
    floor: float
    ratio: float | None
    low: float
    high: float
    rows: int

    @property
    def nearest(self) -> str | None:
        """The reference nearest to the real sample."""
        return min(self.references, key=self.references.__getitem__, default=None)

    @property
    def close(self) -> bool:
        """Whether the learnt distance is within the noise floor."""
        return self.learnt <= self.floor

    @property
    def grade(self) -> Grade | None:
        """Good: the ratio is at most ``GOOD_RATIO``, or at most ``GOOD_RATIO_AT_FLOOR`` and the distance within the
        floor, both by its upper limit. Better: its upper limit is at most ``BETTER_RATIO``. None: the distance is
        within the floor, and the rows are too few to tell the reference's from it, so that a prior which is right is
        not called good."""
        if self.ratio is not None and (self.high <= GOOD_RATIO or (self.close and self.high < GOOD_RATIO_AT_FLOOR)):
            return Grade.GOOD
        if self.ratio is not None and self.high <= BETTER_RATIO:
            return Grade.BETTER
        return None if self.close and self.low < GOOD_RATIO_AT_FLOOR else Grade.NO_BETTER

    def record(self) -> dict[str, Any]:
        """For JSON; distances are square roots, so metrics."""
        squared = {"learnt": self.learnt, **self.references, "floor": self.floor}
        return {
            "distances": {name: float(np.sqrt(max(0.0, value))) for name, value in squared.items()},
            "left": self.ratio,
            "interval": None if self.ratio is None else [self.low, self.high if np.isfinite(self.high) else None],
            "rows": self.rows,
        }


def residual_ratio(
    real: Sample,
    learnt: Sample,
    references: Mapping[str, Sample],
    metric: Metric = "euclidean",
    tests: int = 1,
    seed: int = 0,
) -> ResidualRatio | None:
    """Compare samples with the real one; None where the learnt sample has too few rows of the real numbers.

    Args:
        references: such as the prior's; those with too few rows of the real numbers are left out.
        metric: of rows; both are of negative type.
        tests: how many such comparisons are made together: the confidence of each is raised (Bonferroni).
    """
    rng = np.random.default_rng(seed)
    if len(real.features) < MIN_ROWS:
        return None
    real_rows = _Rows.from_sample(real, real, rng)
    real_within = cdist(real.features, real.features, metric)
    measured: dict[str, tuple[NDArray[np.floating], float]] = {}
    for name, sample in {"learnt": learnt, **references}.items():
        if len(sample.features) < MIN_ROWS:
            continue
        rows = _Rows.from_sample(sample, real, rng)
        across, within = cdist(sample.features, real.features, metric), cdist(sample.features, sample.features, metric)
        energies = _energies(rows, real_rows, across, within, real_within)
        if energies is not None:
            measured[name] = energies
    if "learnt" not in measured:
        return None
    tail = 0.025 / tests
    floor = max(0.0, float(np.quantile(_halves(real_within, seed), 1 - tail)))
    learnt_energies, _ = measured.pop("learnt")
    values = {name: float(energies[0]) for name, (energies, _) in measured.items()}
    nearest = min(values, key=values.__getitem__, default=None)
    ratio, low, high = None, 0.0, float("inf")
    if nearest is not None:
        energies, size = measured[nearest]
        # Under the null a squared distance is as 1 / N + 1 / L; between the halves that is 4 / L.
        if values[nearest] > floor * (1 / size + 1 / len(real_within)) * len(real_within) / 4:
            ratio = float(learnt_energies[0] / energies[0])
            with np.errstate(divide="ignore", invalid="ignore"):
                ratios = np.where(energies > 0, learnt_energies / energies, np.inf)[1:]
            low, high = (float(np.quantile(ratios, q, method="inverted_cdf")) for q in (tail, 1 - tail))
    return ResidualRatio(float(learnt_energies[0]), values, floor, ratio, low, high, len(real.features))


class _Rows(NamedTuple):
    """Of a sample: the bin of each row ``(N, B)``, and how often it was drawn ``(1 + R, N)``, once at first."""

    bins: NDArray[np.floating]
    drawn: NDArray[np.floating]

    @staticmethod
    def from_sample(sample: Sample, real: Sample, rng: np.random.Generator) -> "_Rows":
        N = len(sample.features)
        drawn = np.concatenate([np.ones((1, N)), rng.multinomial(N, np.full(N, 1 / N), RESAMPLES).astype(float)])
        if sample.number is None or real.number is None:
            return _Rows(np.ones((N, 1)), drawn)
        return _Rows(_bins(sample.number, real.number), drawn)


def _bins(number: NDArray[np.floating], real: NDArray[np.floating]) -> NDArray[np.floating]:
    """The bin of each number ``(N, B)``: one for each number of the real rows; where there are many, bins of about as
    many real rows each. None for numbers beyond the real ones."""
    values = np.unique(real)
    if len(values) <= MAX_BINS:
        return (number[:, None] == values).astype(float)
    values = np.unique(np.quantile(real, np.linspace(0, 1, MAX_BINS + 1), method="inverted_cdf"))
    inside = (number >= values[0]) & (number <= values[-1])
    index = np.searchsorted(values[1:-1], number)
    return np.eye(len(values) - 1)[index] * inside[:, None]


def _energies(
    rows: _Rows,
    real: _Rows,
    across: NDArray[np.floating],
    within: NDArray[np.floating],
    real_within: NDArray[np.floating],
) -> tuple[NDArray[np.floating], float] | None:
    """Squared distances ``(1 + R,)``, of the samples and of resamples, and the sample's effective number of rows; None
    where too few have common numbers."""
    own, others = rows.drawn @ rows.bins, real.drawn @ real.bins  # (1 + R, B)
    both = (own > 0) & (others > 0)
    ratio = np.divide(others, own, out=np.zeros_like(own), where=both)
    weight, real_weight = rows.drawn * (ratio @ rows.bins.T), real.drawn * (both @ real.bins.T)
    common = real_weight[0].sum() / len(real_weight[0])
    size = _effective_size(weight[0])
    if common < MIN_COMMON_SHARE or size < MIN_ROWS or _effective_size(real_weight[0]) < MIN_ROWS:
        return None
    weight, real_weight = (each / np.maximum(each.sum(1, keepdims=True), 1e-12) for each in (weight, real_weight))
    return weighted_energy(weight, real_weight, across, within, real_within, unbiased=True), size


def _effective_size(weight: NDArray[np.floating]) -> float:
    """The number of rows of equal weight with the same variance [2]."""
    return float(weight.sum() ** 2 / max((weight**2).sum(), 1e-12))


def _halves(real_within: NDArray[np.floating], seed: int) -> NDArray[np.floating]:
    """Squared distances between random halves of the real rows, ``(FLOOR_SPLITS,)``; the same whatever is compared."""
    L = len(real_within)
    halves = np.tile(np.arange(L) < L // 2, (FLOOR_SPLITS, 1))
    first = np.random.default_rng([seed, 1]).permuted(halves, axis=1).astype(float)
    second = 1 - first
    p, q = (half / half.sum(1, keepdims=True) for half in (first, second))
    return weighted_energy(p, q, real_within, real_within, real_within, unbiased=True)
