"""Photographs without their objects: what is left, filled in from around. Axis letters: H W."""

import cv2
import numpy as np
from numpy.typing import NDArray

RADIUS = 4  # pixels from which a pixel is filled in
MAX_INPAINTED = 0.35  # of a photograph; where objects cover more, a smooth surface is fitted to what they leave
REFITS = 5
MIN_LEFT = 0.02  # of a photograph, to fit one to
BLUR = 1.5  # pixels: what varies faster is noise
MAD = 1.4826  # standard deviations of a normal distribution for its median absolute deviation


def light_of(image: NDArray[np.uint8], there: NDArray[np.bool_]) -> float:
    """The median of an image ``(H, W, 3)`` beside its objects; of all of it where they leave nothing."""
    return float(np.median(image[~there] if not there.all() else image))


def ground_of(image: NDArray[np.uint8], there: NDArray[np.bool_], rng: np.random.Generator) -> NDArray[np.uint8]:
    """An image ``(H, W, 3)`` as it may be without what is ``there (H, W)``, with noise like that of the rest."""
    if not there.any():
        return image
    filled = (
        cv2.inpaint(np.ascontiguousarray(image), there.astype(np.uint8), RADIUS, cv2.INPAINT_TELEA)
        if there.mean() <= MAX_INPAINTED
        else _surface(image, there)
    )
    left = image[~there].astype(np.float64) - cv2.GaussianBlur(image, (0, 0), BLUR)[~there]
    noise = MAD * np.median(np.abs(left), 0) if len(left) else np.zeros(3)
    # Channels share most of their noise, and all of it where the image is grey.
    noisy = filled + rng.normal(size=(*there.shape, 1)) * noise
    return np.where(there[..., None], np.rint(np.clip(noisy, 0, 255)), image).astype(np.uint8)


def _surface(image: NDArray[np.uint8], there: NDArray[np.bool_]) -> NDArray[np.float64]:
    """A quadratic surface, by least squares of what is left and is like most of it: again and again without what lies
    far from the last one. The median colour where nearly nothing is left."""
    height, width = there.shape
    y, x = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], -1)
    if (~there).mean() < MIN_LEFT:
        return np.broadcast_to(np.median(image.reshape(-1, 3), 0), image.shape).astype(np.float64)
    basis, pixels = terms[~there], image[~there].astype(np.float64)
    off = np.abs(pixels - np.median(pixels, 0)).sum(1)
    fitted = terms[..., :1] * 0.0
    for _ in range(REFITS):
        near = off <= max(2 * float(np.median(off)), 1.0)
        weights, _, _, _ = np.linalg.lstsq(basis[near], pixels[near], rcond=None)
        off = np.abs(pixels - basis @ weights).sum(1)
        fitted = terms @ weights
    return np.clip(fitted, pixels.min(0), pixels.max(0)).astype(np.float64)
