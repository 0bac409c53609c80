"""The slow twin of what a camera makes of images, in plain numpy, float64 and SciPy's transforms. Axis letters: H W."""

from typing import NamedTuple

import numpy as np
import torch
from scipy.fft import dctn, idctn
from scipy.ndimage import binary_dilation

from probscene.camera_effects import CameraEffects

from .rays import noise

GREY = [0.299, 0.587, 0.114]
# ITU-T T.81 (1992), tables K.1 and K.2, by rows of the frequency down the image.
LUMINANCE = [
    [16, 11, 10, 16, 24, 40, 51, 61],
    [12, 12, 14, 19, 26, 58, 60, 55],
    [14, 13, 16, 24, 40, 57, 69, 56],
    [14, 17, 22, 29, 51, 87, 80, 62],
    [18, 22, 37, 56, 68, 109, 103, 77],
    [24, 35, 55, 64, 81, 104, 113, 92],
    [49, 64, 78, 87, 103, 121, 120, 101],
    [72, 92, 95, 98, 112, 100, 103, 99],
]
COLOUR = np.full((8, 8), 99)
COLOUR[:4, :4] = [[17, 18, 24, 47], [18, 21, 26, 66], [24, 26, 56, 99], [47, 66, 99, 99]]

# JFIF 1.02; libjpeg counts in 65536ths.
TO_PLANES = np.array([[0.299, -0.16874, 0.5], [0.587, -0.33126, -0.41869], [0.114, 0.5, -0.08131]])
FROM_PLANES = np.array([[0.0, -0.34414, 1.772], [1.402, -0.71414, 0.0]])


class Coded(NamedTuple):
    """What JPEG leaves ``(H, W, 3)`` uint8, and ``(H, W)`` where rounding may have gone either way."""

    image: np.ndarray
    doubtful: np.ndarray


def values_of(photo: CameraEffects, n: int) -> dict[str, float]:
    """A scene's values."""
    return {name: float(value[n]) for name, value in vars(photo).items()}


def apply_camera_effects(colours: np.ndarray, photo: CameraEffects, n: int) -> Coded:
    """Bytes of the colours ``(H, W, 3)`` in 0..1 of scene ``n``."""
    value, seed = values_of(photo, n), int(photo.seed[n])
    image = toned(colours, value)
    grain = value["noise"] / 255 * noise(seed, image[..., 0].size).reshape(image.shape)
    if value["blur"] > 0:
        image = blurred(to_bytes(image), value["blur"])
    image = to_bytes(to_bytes(image) / 255 + grain if value["blur"] > 0 else image + grain)
    if value["jpeg_quality"] == torch.inf:
        return Coded(image, np.zeros(image.shape[:2], bool))
    return coded(image, round(value["jpeg_quality"]))


def to_bytes(colours: np.ndarray) -> np.ndarray:
    return np.clip(np.floor(colours * 255 + 0.5), 0, 255).astype(np.uint8)


def toned(colours: np.ndarray, value: dict[str, float]) -> np.ndarray:
    """Vignette, exposure, white balance, saturation, contrast, one after the other."""
    height, width = colours.shape[:2]
    y, x = np.mgrid[:height, :width] - np.array([(height - 1) / 2, (width - 1) / 2])[:, None, None]
    away = (x**2 + y**2) / max(1e-12, ((width - 1) / 2) ** 2 + ((height - 1) / 2) ** 2)
    colours = colours * (1 - value["vignette"] * away)[..., None] * value["exposure"]
    colours = colours * [value["red_gain"], 1, value["blue_gain"]]
    grey = (colours @ GREY)[..., None]
    colours = grey + value["saturation"] * (colours - grey)
    return 0.5 + value["contrast"] * (colours - 0.5)


def blurred(image: np.ndarray, sigma: float) -> np.ndarray:
    """Colours of blurred bytes: one row, and then one column, after the other."""
    radius = int(np.ceil(4 * sigma))
    kernel = np.exp(-0.5 * (np.arange(-radius, radius + 1) / sigma) ** 2)
    kernel /= kernel.sum()
    wide = np.pad(image / 255, ((radius, radius), (radius, radius), (0, 0)), mode="edge")
    for axis in (0, 1):
        wide = np.apply_along_axis(np.convolve, axis, wide, kernel, "valid")
    return wide


def coded(image: np.ndarray, quality: int) -> Coded:
    """Through JPEG's transforms and back."""
    height, width = image.shape[:2]
    percent = 5000 // quality if quality < 50 else 200 - 2 * quality
    luminance, colour = (np.clip((np.array(t) * percent + 50) // 100, 1, 255) for t in (LUMINANCE, COLOUR))
    whole = np.pad(image, ((0, -height % 16), (0, -width % 16), (0, 0)), mode="edge").astype(int)
    y, *both = np.moveaxis(whole @ np.rint(65536 * TO_PLANES).astype(int) + [32768, 32767, 32767] >> 16, 2, 0)
    y, unsure = _quantised(y - 128, luminance)
    doubtful = unsure.reshape(whole.shape[0] // 16, 2, -1, 2).any((1, 3))
    cell_rows, cells = -(-height // 2), -(-width // 2)
    bias = 1 + np.arange(whole.shape[1] // 2) % 2
    found = []
    for c in both:
        plane, unsure = _quantised((c[::2, ::2] + c[1::2, ::2] + c[::2, 1::2] + c[1::2, 1::2] + bias) // 4, colour)
        doubtful |= unsure
        found.append(_enlarged(plane[:cell_rows, :cells])[:height, :width])
    colours = np.rint(65536 * FROM_PLANES).astype(int)
    rgb = y[:height, :width, None] + 128 + (np.stack(found, 2).astype(int) @ colours + 32768 >> 16)
    near = binary_dilation(np.kron(doubtful, np.ones((16, 16), bool)), np.ones((3, 3)), 2)
    return Coded(np.clip(rgb, 0, 255).astype(np.uint8), near[:height, :width])


def _quantised(plane: np.ndarray, steps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Each block in whole steps, and whether one of a block's might be another."""
    rows, columns = plane.shape[0] // 8, plane.shape[1] // 8
    blocks = plane.reshape(rows, 8, columns, 8).swapaxes(1, 2)
    counted = dctn(blocks, axes=(2, 3), norm="ortho") / steps
    back = idctn(np.floor(counted + 0.5) * steps, axes=(2, 3), norm="ortho")
    doubtful = (np.abs(counted - np.floor(counted) - 0.5) < 1e-4).any((2, 3))
    return np.clip(np.floor(back + 0.5), -128, 127).swapaxes(1, 2).reshape(plane.shape), doubtful


def _enlarged(plane: np.ndarray) -> np.ndarray:
    """Twice as wide and high: of each value three quarters, of the next one a quarter, in either axis."""
    rows, columns = plane.shape
    near = np.pad(plane, 1, mode="edge")
    tall = np.empty((2 * rows, columns + 2))
    tall[::2], tall[1::2] = 3 * near[1:-1] + near[:-2], 3 * near[1:-1] + near[2:]
    wide = np.empty((2 * rows, 2 * columns))
    wide[:, ::2] = (3 * tall[:, 1:-1] + tall[:, :-2] + 8) // 16
    wide[:, 1::2] = (3 * tall[:, 1:-1] + tall[:, 2:] + 7) // 16
    return wide
