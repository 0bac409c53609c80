"""The energy distance between two samples [1], and the tests that rest on it.

- ``energy_test``, ``marginal_test``: a distance beside its noise floor, the distance between two disjoint sets of real
  images of the same size. All features together, and the worst single feature.
- ``permutation_p_value``: whether two samples differ at all.
- ``bootstrap_test``: which of two samples is farther from the real one.

``residual_ratio`` and ``difference_test`` have files of their own. The energy distance as a loss, with gradients, is in
``inference.parameters.energy``. Axis letters: N, P generated, L real, D features, S splits, R resamples, I, J images.

References:
    [1] Székely, Rizzo, *Energy statistics: a class of statistics based on distances*, 2013.
    [2] Phipson, Smyth, *Permutation p-values should never be zero*, 2010.
    [3] Westfall, Young, *Resampling-based multiple testing*, 1993: the maximum over features and its null.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array
from scipy.spatial.distance import cdist

from probscene.errors import DataError

Features = NDArray[np.float64]
MIN_IMAGES = 40  # on a side: two halves of twenty
MAX_IMAGES = 2000  # on a side: all pairs are compared
MAX_SPLIT_SIZE = MAX_IMAGES // 2  # images on a side of one split
MAX_BOOTSTRAP_ROWS, RESAMPLES = 1000, 2000
CONFIDENCE = 0.9  # of the bootstrap test


class EnergyTest(NamedTuple):
    """The distance of two samples beside its noise floor.

    Attributes:
        distance: between ``split_size`` images on each side, mean over the splits.
        floor: the same between two disjoint real sets of that size, mean over the splits.
        low, high: the range that holds 95 % of the floor's splits.
        rank: share of the floor's splits with at least this distance: about 0.5 for a sample of the real distribution,
            0 for one that is farther than all of them.
        split_size: images on each side.
    """

    distance: float
    floor: float
    low: float
    high: float
    rank: float
    split_size: int

    @property
    def ratio(self) -> float:
        """The distance in floors."""
        return self.distance / self.floor if self.floor > 0 else float(self.distance > 0) * np.inf

    @property
    def close(self) -> bool:
        """Whether the distance is within the floor's 95 %."""
        return self.distance <= self.high


class MarginalTest(NamedTuple):
    """Every feature by itself.

    Attributes:
        distances: ``(D,)`` energy distances, in floors.
        largest: the largest of them, in floors, beside the null of the largest.
        feature: its index.
    """

    distances: Features
    largest: EnergyTest
    feature: int


class BootstrapTest(NamedTuple):
    """Whether a sample is farther from the real one than a baseline.

    Attributes:
        distance, baseline_distance: energy distances from the real sample.
        probability: share of the resamples in which the sample is farther than the baseline.
    """

    distance: float
    baseline_distance: float
    probability: float

    @property
    def significant(self) -> bool:
        """Whether the sample is farther, with a probability of at least ``CONFIDENCE``."""
        return self.distance > self.baseline_distance and self.probability >= CONFIDENCE


def check_features(real: ArrayLike, needed: int = MIN_IMAGES) -> Features:
    """Real features that can be learnt from, as float64 ``(L, D)``.

    Raises:
        DataError: fewer than ``needed`` images, features without variance, or values that are not finite.
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


def weighted_energy(
    weight: Features,
    real_weight: Features,
    across: NDArray[np.floating],
    within: NDArray[np.floating],
    real_within: NDArray[np.floating],
    unbiased: bool = False,
) -> Features:
    """Squared energy distances ``2 E|X - Y| - E|X - X'| - E|Y - Y'|`` [1] of R weighted samples, ``(R,)``.

    Args:
        weight, real_weight: ``(R, N)`` and ``(R, L)`` of the rows, each 1 in all.
        across, within, real_within: distances ``(N, L)``, ``(N, N)`` and ``(L, L)`` of the rows.
        unbiased: no row is paired with itself or with a copy of itself; 0 in expectation for equal distributions.
    """

    def mean(rows: Features, distances: NDArray[np.floating], columns: Features) -> Features:
        return ((rows @ distances) * columns).sum(1)

    own, real = mean(weight, within, weight), mean(real_weight, real_within, real_weight)
    if unbiased:
        own, real = (each / np.maximum(1 - (w**2).sum(1), 1e-12) for each, w in ((own, weight), (real, real_weight)))
    return 2 * mean(weight, across, real_weight) - own - real


def energy_distance(a: ArrayLike, b: ArrayLike) -> float:
    """The energy distance of ``(N, D)`` and ``(L, D)``: a metric between distributions, in the features' unit to the
    power of a half."""
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    p, q = (np.full((1, len(x)), 1 / len(x)) for x in (a, b))
    return float(_root(weighted_energy(p, q, cdist(a, b), cdist(a, a), cdist(b, b)))[0])


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
    generated: Features, real: Features, split_size: int = MAX_SPLIT_SIZE, splits: int = 100, seed: int = 0
) -> EnergyTest:
    """The energy distance between generated ``(N, D)`` and real ``(L, D)`` features beside its floor."""
    rng = np.random.default_rng(seed)
    n = min(split_size, len(generated), len(real) // 2)
    most = min(8 * n, MAX_IMAGES)
    real, generated = subsample(real, most, rng), subsample(generated, most, rng)
    across, within, real_within = cdist(real, generated), cdist(generated, generated), cdist(real, real)
    a, b, g = (np.zeros((splits, number)) for number in (len(real), len(real), len(generated)))
    for s in range(splits):
        order = rng.permutation(len(real))
        a[s, order[:n]], b[s, order[n : 2 * n]], g[s, rng.permutation(len(generated))[:n]] = 1 / n, 1 / n, 1 / n
    floor = _root(weighted_energy(a, b, real_within, real_within, real_within))
    distances = _root(weighted_energy(a, g, across, real_within, within))
    return _energy_test(distances, floor, n)


def marginal_test(
    generated: Features, real: Features, split_size: int = MAX_SPLIT_SIZE, splits: int = 100, seed: int = 0
) -> MarginalTest:
    """The energy distance of every feature; the largest is held against the largest of two sets that are mixed at
    random [3].

    The floor is of mixed sets and not of real halves, so that a feature that is constant in the real images has one.
    """
    rng = np.random.default_rng(seed)
    n = min(split_size, len(generated), len(real) // 2)
    distances, floor = np.empty((splits, real.shape[1])), np.empty((splits, real.shape[1]))
    for s in range(splits):
        mixed = np.concatenate([subsample(real, n, rng), subsample(generated, n, rng)])
        distances[s] = marginal_distances(mixed[:n], mixed[n:])
        mixed = mixed[rng.permutation(2 * n)]
        floor[s] = marginal_distances(mixed[:n], mixed[n:])
    scale = np.where(floor.mean(0) > 0, floor.mean(0), 1.0)  # 0 only where a feature is one constant on both sides
    scaled = distances / scale
    mean = scaled.mean(0)
    largest = int(mean.argmax())
    return MarginalTest(mean, _energy_test(scaled[:, largest], (floor / scale).max(1), n), largest)


def permutation_p_value(
    generated: Features, real: Features, permutations: int = 199, most: int = 1000, seed: int = 0
) -> float:
    """p-value of the energy distance under relabelling [1, 2], by up to ``most`` images of each side."""
    rng = np.random.default_rng(seed)
    real, generated = subsample(real, most, rng), subsample(generated, most, rng)
    pooled = np.concatenate([generated, real])
    label = np.repeat([1 / len(generated), -1 / len(real)], [len(generated), len(real)])
    energy = signed_energy(
        np.stack([label, *(rng.permutation(label) for _ in range(permutations))]), cdist(pooled, pooled)
    )
    return float((energy >= energy[0] - 1e-12).mean())


def signed_energy(weight: NDArray[np.floating], distances: NDArray[np.floating]) -> Features:
    """Squared energy distances ``(R,)`` of two samples of the same M rows, whose weights ``(R, M)`` are subtracted from
    one another: the form that takes one product."""
    return -((weight @ distances) * weight).sum(1, dtype=np.float64)


def bootstrap_test(
    sample: Features,
    baseline: Features,
    real: Features,
    seed: int = 0,
    images: tuple[NDArray[np.integer], ...] | None = None,
) -> BootstrapTest:
    """Compare the energy distances of ``sample (N, D)`` and ``baseline (P, D)`` from ``real (L, D)``.

    Args:
        images: of each of the three, which image each row is of: whole images are resampled. None: a row is an image.
    """
    rng = np.random.default_rng(seed)
    samples, owners = [sample, baseline, real], images or [np.arange(len(x)) for x in (sample, baseline, real)]
    chosen = [
        rng.permutation(len(x))[:MAX_BOOTSTRAP_ROWS] if len(x) > MAX_BOOTSTRAP_ROWS else np.arange(len(x))
        for x in samples
    ]
    samples = [x[rows] for x, rows in zip(samples, chosen, strict=True)]
    owners = [np.unique(x[rows], return_inverse=True)[1] for x, rows in zip(owners, chosen, strict=True)]
    sums, sizes = [_image_sums(image) for image in owners], [np.bincount(image) for image in owners]

    def summed(i: int, j: int) -> NDArray[np.floating]:
        """Distances between rows, summed over those of two images: a resample takes all of an image or none."""
        return sums[i] @ (sums[j] @ cdist(samples[j], samples[i])).T

    real_within = summed(2, 2)
    whole = [np.ones(len(size)) / size.sum() for size in sizes]
    drawn = [_resampled_weights(rng, size) for size in sizes]
    distances, resampled = list[float](), list[NDArray[np.floating]]()
    for i in (0, 1):
        kernels = summed(i, 2), summed(i, i), real_within
        distances.append(float(_root(_image_energy(*kernels, whole[i], whole[2]))))
        resampled.append(_image_energy(*kernels, drawn[i], drawn[2]))
    return BootstrapTest(distances[0], distances[1], float((resampled[0] > resampled[1]).mean()))


def principal_components(sets: list[Features], most: int = 32) -> list[Features]:
    """The leading principal components of wide features, common to all sets; narrow ones are left as they are."""
    if sets[0].shape[1] <= most:
        return sets
    pooled = np.concatenate(sets)
    centre = pooled.mean(0)
    values, axes = np.linalg.eigh(np.cov(pooled - centre, rowvar=False))
    axes = axes[:, np.argsort(values)[::-1][:most]]
    return [(features - centre) @ axes for features in sets]


def subsample(rows: Features, most: int, rng: np.random.Generator) -> Features:
    """At most so many of ``rows (N, D)``, drawn at random."""
    return rows if len(rows) <= most else rows[rng.permutation(len(rows))[:most]]


def _root(squared: NDArray[np.floating]) -> NDArray[np.floating]:
    return np.sqrt(np.maximum(squared, 0.0))


def _energy_test(distances: NDArray[np.floating], floor: NDArray[np.floating], split_size: int) -> EnergyTest:
    distance = float(distances.mean())
    low, high = np.quantile(floor, [0.025, 0.975])
    return EnergyTest(
        distance, float(floor.mean()), float(low), float(high), float((floor >= distance).mean()), split_size
    )


def _image_sums(image: NDArray[np.integer]) -> csr_array:
    """``(I, N)`` 1 where a row is of an image."""
    return csr_array((np.ones(len(image)), (image, np.arange(len(image)))))


def _resampled_weights(rng: np.random.Generator, rows: NDArray[np.integer]) -> NDArray[np.floating]:
    """The weight of a row of each image, ``(R, I)``, in resamples of images with so many ``rows (I,)``."""
    weight = rng.multinomial(len(rows), np.full(len(rows), 1 / len(rows)), RESAMPLES)
    return weight / (weight @ rows)[:, None]


def _image_energy(
    across: NDArray[np.floating],
    within: NDArray[np.floating],
    real_within: NDArray[np.floating],
    weight: NDArray[np.floating],
    real_weight: NDArray[np.floating],
) -> NDArray[np.floating]:
    """``weighted_energy`` of images that weigh ``(..., I)`` and ``(..., J)``. The order of its sums is that of the
    distances that runs have on record: with another the last bits differ."""
    return ((2 * weight @ across - real_weight @ real_within) * real_weight).sum(-1) - (weight @ within * weight).sum(
        -1
    )
