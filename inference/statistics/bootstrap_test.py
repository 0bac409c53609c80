"""Is one sample farther from the real one than another, beyond chance?

Axis letters: N, P generated, L real, D features, R resamples, I and J images.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial.distance import cdist

from .two_sample import Features

RESAMPLES, SURE = 2000, 0.9
EXAMINED = 1000  # rows of each sample


class BootstrapTest(NamedTuple):
    """Two distances from the same real sample.

    Attributes:
        one, other: energy distances.
        share: of the resamples in which one is the larger.
    """

    one: float
    other: float
    share: float

    @property
    def sure(self) -> bool:
        """Whether one is the larger beyond chance."""
        return self.one > self.other and self.share >= SURE


def bootstrap_test(
    one: Features, other: Features, real: Features, seed: int = 0, images: tuple[Features, ...] | None = None
) -> BootstrapTest:
    """Energy distances of two samples ``(N, D)`` and ``(P, D)`` from ``real (L, D)``, and the bootstrap's doubt.

    Args:
        images: of each of the three, which image each row is of: whole images are resampled. A row is an image where
            not said otherwise.
    """
    rng = np.random.default_rng(seed)
    of = [np.arange(len(x)) for x in (one, other, real)] if images is None else list(images)
    chosen = [
        rng.permutation(len(x))[:EXAMINED] if len(x) > EXAMINED else np.arange(len(x)) for x in (one, other, real)
    ]
    one, other, real = (x[rows] for x, rows in zip((one, other, real), chosen, strict=True))
    of = [np.unique(x[rows], return_inverse=True)[1] for x, rows in zip(of, chosen, strict=True)]
    rows, number = [_of_images(image) for image in of], [np.bincount(image) for image in of]
    samples = (one, other, real)
    kernels = [
        (_summed(samples[i], real, rows[i], rows[2]), _summed(samples[i], samples[i], rows[i], rows[i])) for i in (0, 1)
    ]
    within = _summed(real, real, rows[2], rows[2])
    whole = [np.ones(len(each)) / each.sum() for each in number]
    found = [_energy(*kernels[i], within, whole[i], whole[2]) for i in (0, 1)]
    drawn = [_resampled(rng, each) for each in number]
    resampled, others = (_energy(*kernels[i], within, drawn[i], drawn[2]) for i in (0, 1))
    distance, of_other = (float(np.sqrt(max(0.0, value))) for value in found)
    return BootstrapTest(distance, of_other, float((resampled > others).mean()))


def _of_images(image: NDArray[np.integer]) -> csr_array:
    """``(I, N)`` 1 where a row is of an image."""
    return csr_array((np.ones(len(image)), (image, np.arange(len(image)))))


def _summed(one: Features, other: Features, of_one: csr_array, of_other: csr_array) -> NDArray[np.floating]:
    """Distances between rows, summed over those of two images: a resample takes all of an image or none."""
    return of_one @ (of_other @ cdist(other, one)).T


def _resampled(rng: np.random.Generator, rows: NDArray[np.integer]) -> NDArray[np.floating]:
    """What a row of each image weighs, ``(R, I)``, where images with so many ``rows (I,)`` are drawn again."""
    weight = rng.multinomial(len(rows), np.full(len(rows), 1 / len(rows)), RESAMPLES)
    return weight / (weight @ rows)[:, None]


def _energy(
    across: NDArray[np.floating],
    theirs: NDArray[np.floating],
    within: NDArray[np.floating],
    weight: NDArray[np.floating],
    of_real: NDArray[np.floating],
) -> NDArray[np.floating]:
    """Squared, where a row of each image weighs ``(..., I)`` and ``(..., J)``; a pair of a row and its copy is left out
    of neither side, so that both compared distances are off by the same."""
    return ((2 * weight @ across - of_real @ within) * of_real).sum(-1) - (weight @ theirs * weight).sum(-1)
