"""Do two sets of features differ by more than is tolerated, and which difference would have been detected?

Differences are total variations (TV): of one feature's distribution, as of the number of cars. They are tested by two
statistics at once: the energy distance of all features, and the chi-squared of each feature's histogram. The null is
not that nothing differs, which is never so and which enough images would always show, but that one feature differs by
``TOLERATED_TV``. It comes from resamples of both sets as one, as do the resamples in which one feature differs by more:
a share t of its rows in some cells of its histogram is drawn in the other cells instead, so that t is the TV. For a TV
of t the chi-squared is at least 4 t^2, and near that where these cells hold half of the rows, as they do here.

Counts are measured with an error. Their cells are whole numbers, and features are jittered by up to half of the
resolution before they are rounded, so that nothing hangs on which side of a half they lie.

Axis letters: N generated, L real, M = N + L rows, D features, K cells of all histograms, R resamples.

References:
    [1] Westfall, Young, *Resampling-based multiple testing*, 1993: the maximum over statistics and its null.
    [2] Székely, Rizzo, *Energy statistics: a class of statistics based on distances*, 2013.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from .energy import MAX_IMAGES, Features, signed_energy, subsample

TOLERATED_TV = 0.03
LEVEL = 0.05  # of the test: the share of resamples of what is tolerated in which it rejects
POWER = 0.9  # with which the smallest detectable difference is detected
MIN_CELL_SHARE = 0.02  # of the rows, in a cell of a histogram
RESAMPLES, PILOT_RESAMPLES = 200, 30
BISECTION_STEPS = 4


class DifferenceTest(NamedTuple):
    """Of two sets.

    Attributes:
        significant: whether they differ by more than is tolerated.
        feature: in which they differ most; None where it is in all together.
        total_variation: between the histograms of that feature; of the one in which it is largest where that is None.
        detectable: TV in any one feature from which on it is detected in nine of ten resamples; None where none is.
        sample_sizes: rows of both that were compared.
    """

    significant: bool
    feature: int | None
    total_variation: float
    detectable: float | None
    sample_sizes: tuple[int, int]


def difference_test(generated: Features, real: Features, resolution: float = 0.0, seed: int = 0) -> DifferenceTest:
    """Compare ``(N, D)`` with ``(L, D)``, by up to ``MAX_IMAGES`` rows of each.

    Args:
        resolution: features that differ by less mean the same: 0.5 for counts; 0 where values are continuous.
    """
    rng = np.random.default_rng(seed)
    generated, real = subsample(generated, MAX_IMAGES, rng), subsample(real, MAX_IMAGES, rng)
    return _Test(generated, real, resolution, rng).result()


class _Test:
    def __init__(self, generated: Features, real: Features, resolution: float, rng: np.random.Generator):
        self.rng, self.N, self.L = rng, len(generated), len(real)
        rows = np.concatenate([generated, real])
        jittered = rows + 0.5 * resolution * rng.uniform(-1, 1, rows.shape)
        unit = 2 * resolution
        rounded, jittered = (np.round(x / unit) if resolution else x for x in (rows, jittered))
        self.cell = [_cells(column) for column in rounded.T]  # that a row is drawn by
        cells = [_cells(column) for column in jittered.T]  # that it is counted in
        self.feature_of_cell = np.repeat(np.arange(len(cells)), [1 + cell.max() for cell in cells])  # (K,)
        self.in_cell = np.concatenate([cell[:, None] == np.arange(1 + cell.max()) for cell in cells], 1).astype(
            np.float32
        )
        self.distances = cdist(rows, rows).astype(np.float32)
        null = self.resampled(TOLERATED_TV, RESAMPLES)
        self.null_mean, self.null_std = null.mean(0), null.std(0)
        self.limit = np.quantile(self.scores(null).max(1), 1 - LEVEL)

    def result(self) -> DifferenceTest:
        is_generated = np.arange(self.N + self.L) < self.N
        weights = is_generated[None] / self.N, ~is_generated[None] / self.L
        score = self.scores(self.statistics(*weights))[0]
        largest = int(score.argmax())
        variations = self.sums(np.abs((weights[0] - weights[1]) @ self.in_cell) / 2)[0]
        significant = bool(score[largest] > self.limit)
        variation = float(variations[largest - 1] if largest else variations.max())
        feature = largest - 1 if largest else None
        return DifferenceTest(significant, feature, variation, self.detectable(), (self.N, self.L))

    def detectable(self) -> float | None:
        """By bisection, for the feature in which differences are detected least."""
        varying = [j for j, cell in enumerate(self.cell) if cell.max() > 0]
        if not varying:
            return None
        low, high = 0.0, 2 * np.sqrt(1 / self.N + 1 / self.L)
        hardest = min(varying, key=lambda j: np.median(self.scores(self.resampled(high, PILOT_RESAMPLES, j)).max(1)))
        top = 1 - np.bincount(self.cell[hardest]).min() / len(self.distances)

        def detected(t: float) -> bool:
            return (self.scores(self.resampled(t, RESAMPLES, hardest)).max(1) > self.limit).mean() >= POWER

        while not detected(high := min(high, top)):
            if high == top:
                return None
            low, high = high, 1.5 * high
        for _ in range(BISECTION_STEPS):
            middle = (low + high) / 2
            low, high = (low, middle) if detected(middle) else (middle, high)
        return float(high)

    def resampled(self, t: float, number: int, feature: int | None = None) -> Features:
        """Statistics ``(R, 1 + D)`` of sets drawn from all rows, of which one has a feature that differs by a TV of t.

        Args:
            feature: which; None for any.
        """
        M = self.N + self.L
        real = self.rng.multinomial(self.L, np.full(M, 1 / M), number) / self.L
        varying = [j for j, cell in enumerate(self.cell) if cell.max() > 0] if feature is None else [feature]
        drawn = []
        for _ in range(number):
            probability = self.shifted(self.cell[self.rng.choice(varying)], t) if varying else np.full(M, 1 / M)
            drawn.append(self.rng.multinomial(self.N, probability) / self.N)
        return self.statistics(np.stack(drawn), real)

    def shifted(self, cell: NDArray[np.int64], t: float) -> Features:
        """Probabilities of the rows ``(M,)``, by which a share t moves from some values of ``cell (M,)`` to others."""
        share = np.bincount(cell) / len(cell)
        order = self.rng.permutation(len(share))
        taken = order[: 1 + np.searchsorted(share[order].cumsum(), max(t, 0.5) - 1e-9)]
        if len(taken) >= len(share):  # the last cell has to be left
            taken = np.delete(np.arange(len(share)), share.argmin())
        inside = np.isin(cell, taken)
        mass = inside.mean()
        t = min(t, mass)
        return np.where(inside, 1 - t / mass, 1 + t / (1 - mass)) / len(cell)

    def statistics(self, generated: Features, real: Features) -> Features:
        """The squared energy distance and the features' chi-squared, ``(R, 1 + D)``, of sets in which rows have weights
        ``(R, M)``."""
        energy = signed_energy((generated - real).astype(np.float32), self.distances)
        p, q = generated @ self.in_cell, real @ self.in_cell
        return np.column_stack([energy, self.sums((p - q) ** 2 / np.maximum(p + q, 1e-12))])

    def sums(self, cells: Features) -> Features:
        """Of each feature's cells, ``(R, D)`` of ``(R, K)``."""
        return np.add.reduceat(cells, np.unique(self.feature_of_cell, return_index=True)[1], 1)

    def scores(self, statistics: Features) -> Features:
        """Standard deviations above the mean of the null; 0 where a feature has one cell."""
        varies = self.null_std > 1e-12
        return np.where(varies, (statistics - self.null_mean) / np.where(varies, self.null_std, 1), 0.0)


def _cells(values: Features) -> NDArray[np.int64]:
    """Numbers of the cells ``(M,)`` of a histogram: neighbouring values in one until it holds ``MIN_CELL_SHARE`` of all
    rows."""
    _, index, count = np.unique(values, return_inverse=True, return_counts=True)
    cell, number, filled = np.zeros(len(count), np.int64), 0, 0
    for i, rows in enumerate(count):
        if filled >= MIN_CELL_SHARE * len(values):
            number, filled = number + 1, 0
        cell[i] = number
        filled += rows
    if filled < MIN_CELL_SHARE * len(values):
        cell[cell == number] = max(0, number - 1)
    return cell[index]
