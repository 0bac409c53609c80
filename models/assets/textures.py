"""Pictures that repeat without a seam: noise, paving, bricks, leaves, all from fixed seeds.

Every texture is ``(h, w, 3)`` uint8 sRGB whose sides are powers of two; those of meshes are light, because the colour
of a face multiplies them.
"""

import math

import cv2
import numpy as np


def noise(rng: np.random.Generator, height: int, width: int, *lengths: float | tuple[float, float]) -> np.ndarray:
    """Seamless noise ``(height, width)`` of mean 0 and standard deviation 1, layers of these lengths in texels.

    A pair is a length along the rows' axis and one along the columns'.
    """
    down, along = np.fft.fftfreq(height)[:, None], np.fft.fftfreq(width)[None]
    total = np.zeros((height, width))
    for length in lengths:
        tall, wide = length if isinstance(length, tuple) else (length, length)
        low = np.exp(-2 * (math.pi**2) * ((down * tall) ** 2 + (along * wide) ** 2))
        layer = np.fft.ifft2(np.fft.fft2(rng.normal(size=(height, width))) * low).real
        total += (layer - layer.mean()) / max(layer.std(), 1e-9)
    return total / max(total.std(), 1e-9)


def painted(colour, shade: np.ndarray) -> np.ndarray:
    """A colour ``(3,)`` or ``(h, w, 3)`` with ``shade (h, w)`` added, of 255."""
    return np.rint(np.clip(np.asarray(colour, float) + shade[..., None], 0, 255)).astype(np.uint8)


def cracks(rng: np.random.Generator, height: int, width: int, number: int, thick: float = 1.0) -> np.ndarray:
    """How much of a crack there is, ``(height, width)`` in 0..1: random walks that go on at the opposite edge."""
    fine = np.zeros((height, width), np.float32)
    for _ in range(number):
        steps = int(rng.integers(40, 160))
        angle = rng.uniform(0, 2 * math.pi) + np.cumsum(rng.normal(0, 0.25, steps))
        path = rng.uniform(0, (width, height)) + np.cumsum(1.6 * np.stack([np.cos(angle), np.sin(angle)], 1), 0)
        x, y = np.rint(path).astype(int).T
        fine[y % height, x % width] = rng.uniform(0.5, 1.0)
    padded = np.pad(fine, 8, mode="wrap")
    soft = cv2.GaussianBlur(padded, (0, 0), thick)[8:-8, 8:-8]
    return np.clip(soft * 2.2 * thick, 0, 1)


def courses(rng, height: int, width: int, rows: int, columns: int, joint: float, vary: float, bond: bool = True):
    """Stones in rows: ``(shade of each texel's stone, share of joint)``, both ``(height, width)``.

    Args:
        rows, columns: how many stones; every second row is shifted by half a stone where there is ``bond``.
        joint: width of the joint in texels.
        vary: standard deviation of the stones' shades.
    """
    y, x = np.mgrid[:height, :width] + 0.5
    row = (y * rows / height).astype(int)
    x = (x + (row % 2) * bond * width / columns / 2) % width
    column = (x * columns / width).astype(int)
    shade = rng.normal(0, vary, (rows, columns))[row, column]
    inside_y = np.abs(y * rows / height % 1 - 0.5) * height / rows
    inside_x = np.abs(x * columns / width % 1 - 0.5) * width / columns
    reach = np.minimum(height / rows / 2 - inside_y, width / columns / 2 - inside_x)
    return shade, np.clip(joint / 2 + 0.5 - reach, 0, 1)


def paving(seed: int, size: int = 128, rows: int = 4, columns: int = 4, bond: bool = True) -> np.ndarray:
    """Slabs with dark joints, light grey."""
    rng = np.random.default_rng(seed)
    shade, joint = courses(rng, size, size, rows, columns, 1.4, 7.0, bond)
    shade = shade + 5 * noise(rng, size, size, 0.7) + 4 * noise(rng, size, size, 12.0) - 50 * joint
    return painted((206, 204, 200), shade)


def bricks(seed: int, size: int = 128, rows: int = 16, columns: int = 6) -> np.ndarray:
    """Courses of bricks, light, to be multiplied by their colour."""
    rng = np.random.default_rng(seed)
    shade, joint = courses(rng, size, size, rows, columns, 1.2, 12.0)
    return painted((214, 214, 214), shade + 6 * noise(rng, size, size, 0.8) + 24 * joint)


def leaves(seed: int, size: int = 128, needle: bool = False) -> np.ndarray:
    """Clumps of leaves with dark gaps between, near white."""
    rng = np.random.default_rng(seed)
    lengths = ((2.2, 0.7), (5.0, 1.6)) if needle else (1.3, 3.0)
    rough = noise(rng, size, size, *lengths) + 0.5 * noise(rng, size, size, 9.0)
    shade = 34 * np.tanh(rough) - 40 * (rough < -1.1)
    picture = np.stack([shade * 1.05, shade, shade * 0.8], 2) + 205
    return np.rint(np.clip(picture, 0, 255)).astype(np.uint8)
