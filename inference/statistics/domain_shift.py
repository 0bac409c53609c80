"""Images outside the support of the other side, by nearest neighbours, and images of another domain.

An image is covered by a set if a member of the set lies in the ball that holds the image's k nearest neighbours of its
own side [2]. Where the other side is r times as dense, such a ball is empty with probability ``(1 + r)^-k``: with k =
10, in 1 of 1000 where the two agree, in 39 of 100 where the other side has a tenth. Axis letters: N generated, L real,
D features, K patches.

References:
    [1] Kynkäänniemi et al., *Improved precision and recall metric for assessing generative models*, 2019.
    [2] Naeem et al., *Reliable fidelity and diversity metrics for generative models*, 2020: density and coverage.
    [3] Roth et al., *Towards total recall in industrial anomaly detection*, 2022: a memory bank of patch features.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.distance import cdist

from .energy import Features

NEIGHBOURS = 10
INLIER_QUANTILE = 0.95  # of scenes, up to which an image is no outlier
Mask = NDArray[np.bool_]
Patches = NDArray[np.floating]


class Coverage(NamedTuple):
    """Of some images by a set.

    Attributes:
        covered: ``(N,)`` whether the ball of an image holds a member of the set.
        nearest: ``(N,)`` distance to the nearest member.
    """

    covered: Mask
    nearest: Features


class Fidelity(NamedTuple):
    """Precision and recall [1], density and coverage [2]."""

    precision: float
    recall: float
    density: float
    coverage: float


def knn_radii(images: Features, k: int, resolution: float = 0.0) -> Features:
    """Distance ``(N,)`` of every image to its k-th nearest other one, at least ``resolution``: features that differ by
    less mean the same, and dense cells of near-duplicates would have balls of no size."""
    distances = cdist(images, images)
    k = min(k, len(images) - 1)
    return np.maximum(np.partition(distances, k, 1)[:, k], resolution)  # column 0 holds the image itself


def coverage(images: Features, others: Features, k: int = NEIGHBOURS, resolution: float = 0.0) -> Coverage:
    """Of each image by a set of others. Where there are fewer others the balls grow, so that k of them are expected."""
    k = max(k, round(k * len(images) / len(others)))
    radius = knn_radii(images, k, resolution)
    nearest = cdist(images, others).min(1)
    return Coverage(nearest <= radius, nearest)


def uncovered_floor(
    real: Features, k: int = NEIGHBOURS, resolution: float = 0.0, splits: int = 10, seed: int = 0
) -> float:
    """The largest share of one half of the real images that the other half does not cover, over the splits."""
    rng = np.random.default_rng(seed)
    n = len(real) // 2
    largest = 0.0
    for _ in range(splits):
        order = rng.permutation(len(real))
        largest = max(largest, 1 - coverage(real[order[:n]], real[order[n : 2 * n]], k, resolution).covered.mean())
    return float(largest)


def fidelity(generated: ArrayLike, real: ArrayLike, k: int = 5) -> Fidelity:
    """Precision, recall, density and coverage with k neighbours, of two sets of one size for their usual reading."""
    generated, real = np.asarray(generated, np.float64), np.asarray(real, np.float64)
    distances = cdist(real, generated)
    inside = distances <= knn_radii(real, k)[:, None]  # (L, N)
    return Fidelity(
        precision=float(inside.any(0).mean()),
        recall=float((distances <= knn_radii(generated, k)).any(1).mean()),
        density=float(inside.sum(0).mean() / k),
        coverage=float(inside.any(1).mean()),
    )


def support_outliers(images: Features, others: Features, k: int) -> Mask:
    """``(L,)`` whether an image lies in none of the balls that hold the k nearest others of one of the others: those of
    precision [1], but none larger than their median, as the ball of an outlier would hold what resembles none.

    Args:
        images, others: ``(L, D)`` and ``(N, D)``.
        k: neighbours.
    """
    radius = knn_radii(others, k)
    return (cdist(images, others) - np.minimum(radius, np.median(radius))).min(1) > 0


def distance_outliers(real: Features, scenes: Features) -> Mask:
    """``(L,)`` whether an image is farther from its nearest scene than the median distance of two random scenes."""
    within = cdist(scenes, scenes)
    spread = np.median(within[np.triu_indices(len(scenes), 1)])
    return cdist(real, scenes).min(1) > spread


def patch_outliers(real: Patches, scenes: Patches, seed: int = 0) -> Mask:
    """``(L,)`` whether the patches of an image resemble none in any scene, wherever they stand and however many there
    are.

    The score of an image is the share of its patches' deviation from the image's median patch, in squares, that the
    nearest patches of a memory bank leave unexplained [3]. The bank are three quarters of the scenes; an outlier has a
    higher score than ``INLIER_QUANTILE`` of the other quarter.

    Args:
        real, scenes: ``(L, 1 + K, E)`` and ``(N, 1 + K, E)``: of each image first its median feature, then those of
            patches.
    """
    order = np.random.default_rng(seed).permutation(len(scenes))
    bank, held_out = scenes[order[len(order) // 4 :]], scenes[order[: len(order) // 4]]
    rows = bank[:, 1:].reshape(-1, bank.shape[2])
    scale = np.where(rows.std(0) > 0, rows.std(0), 1.0)
    rows = (rows / scale).astype(np.float32)
    squares = (rows**2).sum(1)

    def sums(images: Patches) -> Features:
        """The unexplained and the whole deviation, ``(2, L)``."""
        found = []
        for image in (images / scale).astype(np.float32):
            median, patches = image[0], image[1:]
            nearest = ((patches**2).sum(1)[:, None] - 2 * patches @ rows.T + squares).min(1)
            found.append((nearest.clip(min=0).sum(), ((patches - median) ** 2).sum()))
        return np.array(found, np.float64).T

    unexplained, whole = sums(held_out)
    smallest = 1e-3 * max(float(whole.mean()), 1e-12)  # an image that shows nothing is no outlier
    limit = np.quantile(unexplained / np.maximum(whole, smallest), INLIER_QUANTILE)
    unexplained, whole = sums(real)
    return unexplained / np.maximum(whole, smallest) > limit
