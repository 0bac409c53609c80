"""Is one sample farther from the real one than another, beyond chance?

Axis letters: N, P generated, L real, D features, R resamples.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from .two_sample import Features

RESAMPLES, SURE = 2000, 0.9
EXAMINED = 1000  # rows of each sample


class Farther(NamedTuple):
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


def farther(
    one: Features, other: Features, real: Features, seed: int = 0, images: tuple[Features, ...] | None = None
) -> Farther:
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
    kernels = [(cdist(x, real), cdist(x, x)) for x in (one, other)]
    within = cdist(real, real)
    whole = [np.ones(len(x)) / len(x) for x in (one, other, real)]
    found = [_energy(*kernels[i], within, whole[i], whole[2]) for i in (0, 1)]
    drawn = [_resampled(rng, image) for image in of]
    resampled, others = (_energy(*kernels[i], within, drawn[i], drawn[2]) for i in (0, 1))
    distance, of_other = (float(np.sqrt(max(0.0, value))) for value in found)
    return Farther(distance, of_other, float((resampled > others).mean()))


def _resampled(rng: np.random.Generator, image: NDArray[np.integer]) -> NDArray[np.floating]:
    """Weights of rows ``(R, N)``, each as often as its image is drawn."""
    number = int(image.max()) + 1
    weight = rng.multinomial(number, np.full(number, 1 / number), RESAMPLES)[:, image]
    return weight / weight.sum(1, keepdims=True)


def _energy(
    across: NDArray[np.floating],
    theirs: NDArray[np.floating],
    within: NDArray[np.floating],
    weight: NDArray[np.floating],
    of_real: NDArray[np.floating],
) -> NDArray[np.floating]:
    """Squared, of samples of weights ``(..., N)`` and ``(..., L)``; a pair of an image and its copy is left out of
    neither side, so that both compared distances are off by the same."""
    return ((2 * weight @ across - of_real @ within) * of_real).sum(-1) - (weight @ theirs * weight).sum(-1)
