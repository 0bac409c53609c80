"""Which images have no like on the other side: support gaps by nearest neighbours.

An image is like a set if one of the set lies in the ball that holds its k nearest neighbours of its own kind. Where
the other side is r times as dense, such a ball is empty with probability ``(1 + r)^-k``: with k = 10, in 1 of 1000
where the two agree, in 39 of 100 where the other side has a tenth. Axis letters: N generated, L real, D features.

References:
    [1] Kynkäänniemi et al., *Improved precision and recall metric for assessing generative models*, 2019.
    [2] Naeem et al., *Reliable fidelity and diversity metrics for generative models*, 2020: density and coverage.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.distance import cdist

from .two_sample import Features

NEIGHBOURS = 10
COMMON = 0.95  # of scenes are no stranger than what is not strange
Mask = NDArray[np.bool_]
Places = NDArray[np.floating]


class Likeness(NamedTuple):
    """Of some images to a set.

    Attributes:
        like: ``(N,)`` whether the ball of an image holds one of the set.
        nearest: ``(N,)`` distance to the nearest of the set.
    """

    like: Mask
    nearest: Features


class Fidelity(NamedTuple):
    """The field's own figures: precision and recall [1], density and coverage [2]."""

    precision: float
    recall: float
    density: float
    coverage: float


def radii(images: Features, k: int, resolution: float = 0.0) -> Features:
    """Distance of every image to the k-th nearest other one, at least ``resolution``: features that differ by less mean
    the same, and dense cells of near-duplicates would have balls of no size."""
    distances = cdist(images, images)
    k = min(k, len(images) - 1)
    return np.maximum(np.partition(distances, k, 1)[:, k], resolution)  # column 0 holds the image itself


def likeness(images: Features, others: Features, k: int = NEIGHBOURS, resolution: float = 0.0) -> Likeness:
    """Of each image to a set of others. Where there are fewer others the balls grow, so that k of them are expected."""
    k = max(k, round(k * len(images) / len(others)))
    radius = radii(images, k, resolution)
    nearest = cdist(images, others).min(1)
    return Likeness(nearest <= radius, nearest)


def unlike_floor(
    real: Features, k: int = NEIGHBOURS, resolution: float = 0.0, splits: int = 10, seed: int = 0
) -> float:
    """The largest share of one half of the real images that is not like the other, over the splits."""
    rng = np.random.default_rng(seed)
    n = len(real) // 2
    worst = 0.0
    for _ in range(splits):
        order = rng.permutation(len(real))
        worst = max(worst, 1 - likeness(real[order[:n]], real[order[n : 2 * n]], k, resolution).like.mean())
    return float(worst)


def fidelity(generated: ArrayLike, real: ArrayLike, k: int = 5) -> Fidelity:
    """Precision, recall, density and coverage with k neighbours, of two sets of one size for their usual reading."""
    generated, real = np.asarray(generated, np.float64), np.asarray(real, np.float64)
    distances = cdist(real, generated)
    inside = distances <= radii(real, k)[:, None]  # (L, N)
    return Fidelity(
        precision=float(inside.any(0).mean()),
        recall=float((distances <= radii(generated, k)).any(1).mean()),
        density=float(inside.sum(0).mean() / k),
        coverage=float(inside.any(1).mean()),
    )


def outside(images: Features, others: Features, k: int) -> Mask:
    """``(L,)`` whether an image lies in none of the balls that hold the k nearest others of one of the others: those of
    precision [1], but none larger than their median, as the ball of an outlier would hold what resembles none.

    Args:
        images, others: ``(L, D)`` and ``(N, D)``.
        k: neighbours.
    """
    radius = radii(others, k)
    return (cdist(images, others) - np.minimum(radius, np.median(radius))).min(1) > 0


def foreign(real: Features, scenes: Features) -> Mask:
    """``(L,)`` whether an image is farther from its nearest scene than two random scenes are from one another (their
    median): the scenes' own spread says what a large distance is."""
    within = cdist(scenes, scenes)
    spread = np.median(within[np.triu_indices(len(scenes), 1)])
    return cdist(real, scenes).min(1) > spread


def strange(real: Places, scenes: Places, seed: int = 0) -> Mask:
    """``(L,)`` whether what an image shows is unlike what any scene shows, wherever that stands and however much there
    is of it: more of it is left unexplained than in ``COMMON`` of a quarter of the scenes. Unexplained is what the most
    similar place of the others leaves of how much a place differs from the rest of its image, in squares.

    Args:
        real, scenes: ``(L, 1 + K, E)`` and ``(N, 1 + K, E)``: of each image first the feature that is usual in it, then
            those of places.
    """
    order = np.random.default_rng(seed).permutation(len(scenes))
    bank, others = scenes[order[len(order) // 4 :]], scenes[order[: len(order) // 4]]
    rows = bank[:, 1:].reshape(-1, bank.shape[2])
    scale = np.where(rows.std(0) > 0, rows.std(0), 1.0)
    rows = (rows / scale).astype(np.float32)
    squares = (rows**2).sum(1)

    def sums(images: Places) -> Features:
        """What is left, and what there is to explain, ``(2, L)``."""
        found = []
        for image in (images / scale).astype(np.float32):
            usual, places = image[0], image[1:]
            nearest = ((places**2).sum(1)[:, None] - 2 * places @ rows.T + squares).min(1)
            found.append((nearest.clip(min=0).sum(), ((places - usual) ** 2).sum()))
        return np.array(found, np.float64).T

    left, whole = sums(others)
    least = 1e-3 * max(float(whole.mean()), 1e-12)  # in an image that shows nothing there is nothing strange
    limit = np.quantile(left / np.maximum(whole, least), COMMON)
    left, whole = sums(real)
    return left / np.maximum(whole, least) > limit
