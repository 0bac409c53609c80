"""Camera effects on rendered images: the host's side of ``kernels``, for sprites and meshes alike.

Tables are computed in float64 from the values of one scene alone, so that an image does not depend on its batch.
"""

import numpy as np
import torch
from torch import Tensor

from probscene.camera_effects import CameraEffects, check_camera_effects
from probscene.errors import ModelError

from .. import engine
from ..kernels import tone
from ..kernels.finish import blur_images, compress_images, develop_images

_CHUNK = 1 << 28  # pixels of one launch; the kernel's offsets are 32-bit
_GREY = np.array([0.299, 0.587, 0.114])
_WIDTHS = 4  # standard deviations that a blur reaches

# Quantisation steps, ITU-T T.81 (1992), tables K.1 and K.2.
_LUMINANCE = """
    16 11 10 16 24 40 51 61  12 12 14 19 26 58 60 55  14 13 16 24 40 57 69 56  14 17 22 29 51 87 80 62
    18 22 37 56 68 109 103 77  24 35 55 64 81 104 113 92  49 64 78 87 103 121 120 101  72 92 95 98 112 100 103 99"""
_COLOUR = """
    17 18 24 47 99 99 99 99  18 21 26 66 99 99 99 99  24 26 56 99 99 99 99 99  47 66 99 99 99 99 99 99
    99 99 99 99 99 99 99 99  99 99 99 99 99 99 99 99  99 99 99 99 99 99 99 99  99 99 99 99 99 99 99 99"""
_STEPS = np.array([_LUMINANCE.split(), _COLOUR.split()]).astype(np.int64).reshape(1, 128)


class EffectsProcessor:
    """Applies camera effects to images, in place.

    A call allocates about 12 bytes a pixel and thread where it blurs, 6 where there is JPEG, and keeps them.

    Args:
        canvas: height and width of the images, pixels.
        threads: how many threads work.
    """

    def __init__(self, canvas: tuple[int, int], threads: int):
        self.canvas, self.threads = canvas, threads
        self._scratch = np.zeros(1, np.float32)

    def __call__(self, photo: CameraEffects, image: np.ndarray, number: int, toned: bool) -> None:
        """Apply the effects.

        Args:
            photo: every value ``(N,)``.
            image: flat uint8, contiguous, of at least 8 bytes; what is behind the images stays as it is.
            number: N, how many images.
            toned: whether the effects on colours have been applied already.

        Raises:
            ModelError: see ``effects_table``.
        """
        (height, width), pixels = self.canvas, self.canvas[0] * self.canvas[1]
        table = effects_table(photo, number, self.canvas, exposed=toned)
        late = table[:, tone.RADIUS] + table[:, tone.JPEG] > 0
        if not (late if toned else late | (table[:, tone.TONED] != 0) | (table[:, tone.NOISE] > 0)).any():
            return
        seeds, weights, steps = seeds_of(photo), _weights(photo, table), _steps(photo)
        most = int(table[:, tone.RADIUS].max())
        blurred = 3 * (height + 2) * width + 6 * most if most else 0
        coded = _coded(height, width) if table[:, tone.JPEG].any() else 0
        scratch = max(1, blurred, coded)
        step = max(8, _CHUNK // pixels // 8 * 8)  # images begin at whole words
        for start in range(0, number, step):
            part = slice(start, min(start + step, number))
            workers = max(1, min(self.threads, part.stop - start, ((1 << 31) - 1) // scratch))
            if self._scratch.size < workers * scratch:
                self._scratch = np.zeros(workers * scratch, np.float32)
            some = image[3 * start * pixels : 3 * part.stop * pixels + 8]
            words = some[: some.size // 8 * 8].view(np.uint64)
            rows, size = table[part], (workers, part.stop - start, height, width)
            photos = rows.ravel()
            if not toned and ((rows[:, tone.TONED] != 0) | (rows[:, tone.NOISE] > 0)).any():
                develop_images(0, *size, np.zeros(1, np.int32), photos, seeds[part], some, words)
            if most:
                queue = np.zeros(1, np.int32)
                blur_images(*size, scratch, weights.shape[1], queue, photos, weights[part].ravel(), self._scratch, some)
                if (rows[:, tone.LATER] > 0).any():
                    develop_images(1, *size, np.zeros(1, np.int32), photos, seeds[part], some, words)
            if coded:
                queue = np.zeros(1, np.int32)
                compress_images(*size, scratch, queue, photos, steps[part].ravel(), _COSINES, self._scratch, some)


def apply_camera_effects(photo: CameraEffects, image: Tensor, threads: int = 1) -> Tensor:
    """Images ``(N, 3, H, W)`` uint8 with camera effects, for a user's own renderer.

    Args:
        photo: every value ``(N,)``, as a drawing has it.
        image: without the effects.
        threads: how many threads work.

    Raises:
        ModelError: images of another shape; see ``effects_table``.
    """
    if image.dtype != torch.uint8 or image.ndim != 4 or image.shape[1] != 3:
        raise ModelError(f"expected images as uint8 (N, 3, H, W), got {image.dtype} {tuple(image.shape)}.")
    number, _, height, width = image.shape
    flat = np.append(image.permute(0, 2, 3, 1).flatten().numpy(), np.zeros(8, np.uint8))
    engine.start()
    EffectsProcessor((height, width), threads)(photo, flat, number, toned=False)
    return torch.from_numpy(flat[:-8]).view(number, height, width, 3).permute(0, 3, 1, 2)


def effects_table(photo: CameraEffects, number: int, canvas: tuple[int, int], exposed: bool) -> np.ndarray:
    """``(N, NUM_COLUMNS)`` float64, see ``kernels.tone``.

    Args:
        photo: every value ``(N,)``.
        number: N.
        canvas: height and width, pixels.
        exposed: whether the exposure has been applied already.

    Raises:
        ModelError: values of another shape, or beyond their limits.
    """
    values = {name: torch.as_tensor(value).detach().cpu() for name, value in vars(photo).items()}
    shapes = {name: tuple(value.shape) for name, value in values.items() if value.shape != (number,)}
    if shapes:
        raise ModelError(
            f"expected camera effects with one value for each of {number} scenes, got {shapes}; make them with "
            "probscene.world.resolve_scene."
        )
    check_camera_effects(values)
    value = {name: tensor.numpy().astype(np.float64) for name, tensor in values.items()}
    table = np.zeros((number, tone.NUM_COLUMNS))
    gains = np.stack([value["red_gain"], np.ones(number), value["blue_gain"]], 1)
    if not exposed:
        gains *= value["exposure"][:, None]
    contrast, saturation = value["contrast"][:, None, None], value["saturation"][:, None, None]
    matrix = contrast * (saturation * np.eye(3) + (1 - saturation) * _GREY) * gains[:, None, :]
    table[:, tone.MATRIX : tone.MATRIX + 9] = matrix.reshape(-1, 9)
    table[:, tone.BIAS] = 0.5 * (1 - value["contrast"])
    height, width = canvas
    corner = max(1, (width - 1) ** 2 + (height - 1) ** 2) / 4
    table[:, tone.VIGNETTE] = value["vignette"] / corner
    table[:, tone.MIDDLE_U], table[:, tone.MIDDLE_V] = (width - 1) / 2, (height - 1) / 2
    same = (value["contrast"] == 1) & (value["saturation"] == 1) & (value["vignette"] == 0) & (gains == 1).all(1)
    table[:, tone.TONED] = ~same
    table[:, tone.RADIUS] = np.ceil(_WIDTHS * value["blur"])
    blurred = table[:, tone.RADIUS] > 0
    table[:, tone.NOISE] = np.where(blurred, 0, value["noise"]) / 255
    table[:, tone.LATER] = np.where(blurred, value["noise"], 0) / 255
    table[:, tone.JPEG] = np.isfinite(value["jpeg_quality"])
    return table


def seeds_of(photo: CameraEffects) -> np.ndarray:
    """``(N,)`` int64."""
    return torch.as_tensor(photo.seed).cpu().numpy().astype(np.int64)


def _weights(photo: CameraEffects, table: np.ndarray) -> np.ndarray:
    """``(N, reach)`` float32 of the middle, halved, and of each distance from it; they count twice."""
    sigma = torch.as_tensor(photo.blur).detach().cpu().numpy().astype(np.float64)[:, None]
    away = np.arange(int(table[:, tone.RADIUS].max(initial=0)) + 1.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        weights = np.exp(-0.5 * (away / sigma) ** 2)
    weights = np.where(away <= table[:, tone.RADIUS, None], weights, 0)
    weights[:, 0] = 0.5
    total = np.zeros(len(weights))
    for column in weights.T:  # one after the other, however many other scenes need
        total += 2 * column
    return (weights / total[:, None]).astype(np.float32)


def _steps(photo: CameraEffects) -> np.ndarray:
    """``(N, 128)`` float32, quantisation steps of luminance and colours, as libjpeg takes them from the quality."""
    quality = torch.as_tensor(photo.jpeg_quality).detach().cpu().numpy().astype(np.float64)
    quality = np.rint(np.where(np.isfinite(quality), quality, 100)).astype(np.int64)[:, None]
    percent = np.where(quality < 50, 5000 // quality, 200 - 2 * quality)
    return np.clip((_STEPS * percent + 50) // 100, 1, 255).astype(np.float32)


def _cosines() -> np.ndarray:
    """The cosine transform of eight numbers and its inverse, orthonormal, ``(128,)`` float32."""
    k, j = np.arange(8)[:, None], np.arange(8)
    forward = np.where(k == 0, np.sqrt(0.5), 1) * np.cos((2 * j + 1) * k * np.pi / 16) / 2
    return np.concatenate([forward.ravel(), forward.T.ravel()]).astype(np.float32)


def _coded(height: int, width: int) -> int:
    """Numbers that JPEG needs of scratch, see ``kernels.jpeg.compress``."""
    high, wide = -(-height // 16) * 16, -(-width // 16) * 16
    return high * wide * 3 // 2 + 16 * wide


_COSINES = _cosines()
