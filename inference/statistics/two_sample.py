"""Are two sets of features samples of one distribution? A distance, and the floor that chance alone leaves.

The floor is that of a judge who sees ``judged`` images of each side, as many as there are: the distance between so many
real images and as many other real ones. A distance is stated in floors, with its rank among those of the halves. What a
good verdict goes by is in ``difference_test``. Axis letters: N, L images, D features, S splits.

References:
    [1] Székely, Rizzo, *Energy statistics: a class of statistics based on distances*, 2013.
    [2] Phipson, Smyth, *Permutation p-values should never be zero*, 2010.
    [3] Westfall, Young, *Resampling-based multiple testing*, 1993: the maximum over features and its null.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.distance import cdist

from probscene.errors import DataError

Features = NDArray[np.float64]
NEEDED = 40  # real images: two halves of twenty
EXAMINED = 2000  # images of each side, at most: distances are between all pairs
JUDGED = EXAMINED // 2  # images that the judge sees of each side, where there are so many


class EnergyTest(NamedTuple):
    """How far two sets are apart.

    Attributes:
        distance: between ``judged`` images of each side, mean over the splits.
        floor: the same between two disjoint real sets of that size, mean over the splits.
        low, high: the range that holds 95 % of the floor's splits.
        rank: share of the floor's splits that are at least as far apart; a sample of the real distribution has about
            one half, 0 is farther than all.
        judged: how many images of each side.
    """

    distance: float
    floor: float
    low: float
    high: float
    rank: float
    judged: int

    @property
    def ratio(self) -> float:
        """The distance in floors."""
        return self.distance / self.floor if self.floor > 0 else float(self.distance > 0) * np.inf

    @property
    def close(self) -> bool:
        """Whether the judge takes the one side for the other."""
        return self.distance <= self.high


def check_features(real: ArrayLike, needed: int = NEEDED) -> Features:
    """Real features that something can be learnt from or judged by, as float64 ``(L, D)``.

    Raises:
        DataError: fewer than ``needed``, values that are not finite, or the same features in all images.
    """
    real = np.asarray(real, np.float64)
    if real.ndim != 2:
        raise DataError(f"expected real features (L, D), got {real.shape}.")
    if len(real) < needed:
        raise DataError(f"expected at least {needed} real images, got {len(real)}; add images to the target folder.")
    if not np.isfinite(real).all():
        raise DataError("expected finite features of the real images, got NaN or infinity; train the network again.")
    if (np.ptp(real, 0) <= 1e-5 * (1 + np.abs(real).max(0))).all():
        raise DataError(
            f"expected real images that differ, got {len(real)} images with the same features (zero variance in all "
            f"{real.shape[1]} features): the images are identical, or the feature network sees no difference in them; "
            "look at the target folder, or train the feature network longer."
        )
    return real


def energy_distance(a: ArrayLike, b: ArrayLike) -> float:
    """``sqrt(2 E|a - b| - E|a - a'| - E|b - b'|)`` of two samples ``(N, D)`` and ``(L, D)`` [1]: a metric between
    distributions, in the features' unit to the power of a half; 0 only where they agree."""
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    return float(np.sqrt(max(0.0, 2 * cdist(a, b).mean() - cdist(a, a).mean() - cdist(b, b).mean())))


def marginal_distances(a: ArrayLike, b: ArrayLike) -> Features:
    """The energy distance of every single feature, ``(D,)``: ``sqrt(2 integral (F - G)^2)`` of the two distribution
    functions, by sorting."""
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    pooled = np.concatenate([a, b])
    order = pooled.argsort(0, kind="stable")
    step = np.where(order < len(a), 1 / len(a), -1 / len(b)).cumsum(0)[:-1]
    width = np.diff(np.take_along_axis(pooled, order, 0), axis=0)
    return np.sqrt(2 * (step**2 * width).sum(0))


def energy_test(
    generated: Features, real: Features, judged: int = JUDGED, splits: int = 100, seed: int = 0
) -> EnergyTest:
    """The energy distance between generated ``(N, D)`` and real ``(L, D)`` features beside its floor."""
    rng = np.random.default_rng(seed)
    n = min(judged, len(generated), len(real) // 2)
    most = min(8 * n, EXAMINED)
    real, generated = some(real, most, rng), some(generated, most, rng)
    within, across, theirs = cdist(real, real), cdist(real, generated), cdist(generated, generated)
    a, b, g = (np.zeros((splits, number)) for number in (len(real), len(real), len(generated)))
    for s in range(splits):
        order = rng.permutation(len(real))
        a[s, order[:n]], b[s, order[n : 2 * n]], g[s, rng.permutation(len(generated))[:n]] = 1 / n, 1 / n, 1 / n
    aa = _means(within, a, a)
    floor = _roots(2 * _means(within, a, b) - aa - _means(within, b, b))
    found = _roots(2 * _means(across, a, g) - aa - _means(theirs, g, g))
    return _beside(found, floor, n)


class Marginals(NamedTuple):
    """The features one by one.

    Attributes:
        each: ``(D,)`` energy distances, in floors.
        largest: the most distant feature's, in floors, beside the null of the largest.
        worst: its index.
    """

    each: Features
    largest: EnergyTest
    worst: int


def marginals(generated: Features, real: Features, judged: int = JUDGED, splits: int = 100, seed: int = 0) -> Marginals:
    """Every feature's own distance; the largest is judged against the largest of two sets that are mixed at random [3].

    The floor is of mixed sets and not of real halves: a feature that is constant in the real images has a floor so.
    """
    rng = np.random.default_rng(seed)
    n = min(judged, len(generated), len(real) // 2)
    found, floor = np.empty((splits, real.shape[1])), np.empty((splits, real.shape[1]))
    for s in range(splits):
        mixed = np.concatenate([some(real, n, rng), some(generated, n, rng)])
        found[s] = marginal_distances(mixed[:n], mixed[n:])
        mixed = mixed[rng.permutation(2 * n)]
        floor[s] = marginal_distances(mixed[:n], mixed[n:])
    scale = np.where(floor.mean(0) > 0, floor.mean(0), 1.0)  # 0 only where a feature is one constant on both sides
    each = (found / scale).mean(0)
    worst = int(each.argmax())
    return Marginals(each, _beside((found / scale)[:, worst], (floor / scale).max(1), n), worst)


def permutation_p(
    generated: Features, real: Features, permutations: int = 199, most: int = 1000, seed: int = 0
) -> float:
    """p-value of the energy distance under relabelling [1, 2], on up to ``most`` images of each side: whether a
    difference can be detected at all, however small it is."""
    rng = np.random.default_rng(seed)
    real, generated = some(real, most, rng), some(generated, most, rng)
    N, L = len(generated), len(real)
    pooled = np.concatenate([generated, real])
    label = np.repeat([1 / N, -1 / L], [N, L])
    labels = np.stack([label, *(rng.permutation(label) for _ in range(permutations))], 1)
    energy = -(labels * (cdist(pooled, pooled) @ labels)).sum(0)
    return float((energy >= energy[0] - 1e-12).mean())


def principal(sets: list[Features], most: int = 32) -> list[Features]:
    """The leading principal components of wide features, common to all sets; narrow ones are left as they are."""
    if sets[0].shape[1] <= most:
        return sets
    pooled = np.concatenate(sets)
    centre = pooled.mean(0)
    values, axes = np.linalg.eigh(np.cov(pooled - centre, rowvar=False))
    axes = axes[:, np.argsort(values)[::-1][:most]]
    return [(each - centre) @ axes for each in sets]


def some(rows: Features, most: int, rng: np.random.Generator) -> Features:
    """At most so many of ``rows (N, D)``, drawn at random."""
    return rows if len(rows) <= most else rows[rng.permutation(len(rows))[:most]]


def _means(distances: NDArray[np.floating], rows: Features, columns: Features) -> Features:
    """Mean distances ``(S,)`` by weights of the rows ``(S, N)`` and of the columns ``(S, L)``."""
    return ((rows @ distances) * columns).sum(1)


def _roots(values: Features) -> Features:
    return np.sqrt(values.clip(min=0))


def _beside(found: Features, floor: Features, judged: int) -> EnergyTest:
    distance = float(found.mean())
    low, high = np.quantile(floor, [0.025, 0.975])
    return EnergyTest(distance, float(floor.mean()), float(low), float(high), float((floor >= distance).mean()), judged)
