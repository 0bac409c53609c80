"""Renders as cameras would have taken them: exposure, colour, focus, noise and compression, drawn at random.

Heads that have seen every render in one light rely on it, and find less in photographs. Axis letters: N images.
"""

import cv2
import numpy as np
import torch
from torch import Tensor

CHANNEL, SATURATION, GAMMA, CONTRAST = 0.08, 0.3, 0.2, 0.2  # standard deviations of logarithms
EXPOSURE = 0.05  # standard deviation, of the range
BLUR, NOISE, QUALITY = 1.2, 0.04, (40, 96)  # largest blur in pixels, largest noise of the range, JPEG's quality


def augment(images: Tensor, rng: np.random.Generator) -> Tensor:
    """Each image in a light, focus and quality of its own.

    Args:
        images: ``(N, 1 or 3, H, W)`` uint8.
    """
    return torch.from_numpy(np.stack([_one(image, rng) for image in images.permute(0, 2, 3, 1).numpy()]))


def _one(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """``(C, H, W)`` of ``(H, W, C)``."""

    def normal(spread: float, *shape: int) -> np.ndarray:
        return np.asarray(rng.normal(0, spread, shape), np.float32)  # doubles would make all pixels doubles

    x = image.astype(np.float32) / 255
    if x.shape[2] == 3:
        x = x * np.exp(normal(CHANNEL, 3))
        grey = x @ np.full((3, 1), 1 / 3, np.float32)  # numpy's mean of so few takes twenty times as long
        x = grey + (x - grey) * np.exp(normal(SATURATION))
    x = cv2.pow(np.clip(x, 0, 1), float(np.exp(normal(GAMMA)))).reshape(x.shape)
    mean = x.mean()
    x = mean + (x - mean) * np.exp(normal(CONTRAST)) + normal(EXPOSURE)
    blur = rng.uniform(0, BLUR)
    if blur > 0.3:
        x = cv2.GaussianBlur(x, (0, 0), blur).reshape(x.shape)
    x = x + normal(rng.uniform(0, NOISE), *x.shape)
    x = np.rint(np.clip(x, 0, 1) * 255).astype(np.uint8)
    _, coded = cv2.imencode(".jpg", x, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(*QUALITY))])
    return np.asarray(cv2.imdecode(coded, cv2.IMREAD_UNCHANGED)).reshape(x.shape).transpose(2, 0, 1)
