"""An image file as an array of a canvas's size: decoded in full, seen where it has the canvas's shape, and resized.

Axis letters: C H W.
"""

import io
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from PIL import Image, ImageOps, UnidentifiedImageError

ALIKE = 1.02  # ratio of two shapes that count as one: the frames of KITTI's cameras differ by 0.4 %
_LAST_CHUNK = b"IEND\xaeB`\x82"  # of a PNG; neither Pillow nor OpenCV misses it
_ORIENTATION = 0x0112  # EXIF tag; values from 5 on swap width and height


class Fault(Exception):
    """A file that does not decode; the text completes 'a file that ...'."""


class Window(NamedTuple):
    """What is seen of an image, in its own pixels from its upper left corner."""

    top: int
    left: int
    height: int
    width: int


def window(size: tuple[int, int], canvas: tuple[int, int]) -> Window | None:
    """What is seen of an image on a canvas, both given by height and width: all, None, where the ratios of the sides
    differ by no more than ``ALIKE``, else the largest part in the middle that has the canvas's ratio, to the pixel.
    """
    (h, w), (H, W) = size, canvas
    longer = w * H / (h * W)
    if 1 / ALIKE <= longer <= ALIKE:
        return None
    height, width = (h, max(round(h * W / H), 1)) if longer > 1 else (max(round(w * H / W), 1), w)
    return None if (height, width) == (h, w) else Window((h - height) // 2, (w - width) // 2, height, width)


class Part(NamedTuple):
    """A part of what is seen: its share of either side, and where it lies, 0 at the top and left, 1 at the ends."""

    share: float
    down: float
    along: float


def read(file: Path) -> bytes:
    """A file's bytes.

    Raises:
        Fault: it cannot be read.
    """
    try:
        return file.read_bytes()
    except OSError as error:
        raise Fault(f"cannot be read ({error.strerror})") from error


def decoded(
    data: bytes, canvas: tuple[int, int], channels: int, part: Part | None = None
) -> tuple[np.ndarray, tuple[int, int]]:
    """The image ``(C, H, W)`` uint8 at the canvas's size, and the height and width that it had.

    Args:
        part: of it that is shown, as large as the canvas; all of it where None.

    Raises:
        Fault: what does not decode.
    """
    if not data:
        raise Fault("is empty")
    try:
        with Image.open(io.BytesIO(data), formats=("PNG", "JPEG")) as image:
            if image.format == "PNG":
                if _LAST_CHUNK not in data:
                    raise Fault("is truncated")
                with Image.open(io.BytesIO(data)) as again:
                    again.verify()  # decoding alone does not compare the checksums
            turned = image.getexif().get(_ORIENTATION, 1) >= 5
            w, h = image.size
            size = (w, h) if turned else (h, w)
            image.draft(None, (max(canvas), max(canvas)))  # a large JPEG is decoded at a half, a fourth, an eighth
            pixels = np.array(eight_bit(ImageOps.exif_transpose(image)).convert("L" if channels == 1 else "RGB"))
    except Fault:
        raise
    except UnidentifiedImageError as error:
        raise Fault("is not a PNG or JPEG image") from error
    except Exception as error:  # what Pillow raises on bad bytes: OSError, SyntaxError, ValueError, struct.error, ...
        truncated = "truncated" in str(error).lower()
        raise Fault("is truncated" if truncated else f"does not decode ({error})") from error
    return fitted(pixels, canvas, part, size), size


def fitted(
    pixels: np.ndarray, canvas: tuple[int, int], part: Part | None = None, size: tuple[int, int] | None = None
) -> np.ndarray:
    """``(h, w)`` or ``(h, w, 1 or 3)`` uint8 as ``(C, H, W)`` of the canvas's size.

    Args:
        part: of what is seen, all of it where None.
        size: that the image had in its file, where it was decoded at a smaller one.
    """
    pixels = _seen(pixels, pixels.shape[:2] if size is None else size, canvas)
    if part is not None:
        h, w = (max(round(part.share * side), 1) for side in pixels.shape[:2])
        top, left = round(part.down * (pixels.shape[0] - h)), round(part.along * (pixels.shape[1] - w))
        pixels = pixels[top : top + h, left : left + w]
    pixels = _resized(pixels, canvas)
    return np.ascontiguousarray(pixels[None] if pixels.ndim == 2 else pixels.transpose(2, 0, 1))


def eight_bit(image: Image.Image) -> Image.Image:
    """An opaque image of at most 8 bits a channel."""
    if image.mode.startswith("I"):
        return Image.fromarray((np.asarray(image).astype(np.uint16) >> 8).astype(np.uint8))
    if image.has_transparency_data:
        image = image.convert("RGBA")
        return Image.alpha_composite(Image.new("RGBA", image.size, (0, 0, 0, 255)), image).convert("RGB")
    return image if image.mode == "L" else image.convert("RGB")


def _seen(pixels: np.ndarray, size: tuple[int, int], canvas: tuple[int, int]) -> np.ndarray:
    """The part of an image in its window, which is that of the size that it has in its file."""
    seen = window(size, canvas)
    if seen is None:
        return pixels
    down, along = pixels.shape[0] / size[0], pixels.shape[1] / size[1]
    top, left = round(seen.top * down), round(seen.left * along)
    return pixels[top : top + max(round(seen.height * down), 1), left : left + max(round(seen.width * along), 1)]


def _resized(pixels: np.ndarray, canvas: tuple[int, int]) -> np.ndarray:
    """``(h, w)`` or ``(h, w, 3)`` to the canvas's height and width."""
    height, width = canvas
    shrunk = (min(height, pixels.shape[0]), min(width, pixels.shape[1]))
    for (h, w), how in ((shrunk, cv2.INTER_AREA), ((height, width), cv2.INTER_LINEAR)):
        if pixels.shape[:2] != (h, w):
            pixels = cv2.resize(pixels, (w, h), interpolation=how)
    return pixels
