"""The one reader of image files: a file as an array, as large as it is, or cut to a canvas's shape and resized.

Axis letters: C H W.
"""

import io
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from PIL import Image, JpegImagePlugin, PngImagePlugin, TiffImagePlugin

from .errors import DataError
from .image_bytes import Fault, PixelFile, may_have_16_bits, pixel_file

ALIKE = 1.02  # ratio of two shapes that count as one: the frames of KITTI's cameras differ by 0.4 %
MAX_PIXELS = 2**29 // 3  # of an image; it takes up to 2 GB while it is read
_PLUGINS = {
    "PNG": PngImagePlugin.PngImageFile,
    "JPEG": JpegImagePlugin.JpegImageFile,
    "TIFF": TiffImagePlugin.TiffImageFile,
}


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


@contextmanager
def quiet() -> Iterator[None]:
    """Without Pillow's warnings; they are the whole process's, so no thread can do it alone."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def read_rgb(path: Path, value_range: tuple[float, float] | None = None) -> np.ndarray:
    """A PNG, JPEG or TIFF file's pixels ``(H, W, 3)`` uint8: upright, transparent ones on black.

    Args:
        value_range: of a file of 16 bits a channel, see ``eight_bit``.

    Raises:
        DataError: it is missing, is another file, or does not decode.
    """
    if not Path(path).is_file():
        raise DataError(f"expected a PNG, JPEG or TIFF image at {path}, got none.")
    try:
        with quiet():
            found = eight_bit(stored(read(Path(path)))[0], value_range)
    except Fault as fault:
        raise DataError(f"expected a PNG, JPEG or TIFF image at {path}, got a file that {fault}.") from fault
    return _of_channels(found, 3)


def decoded(
    data: bytes,
    canvas: tuple[int, int],
    channels: int,
    part: Part | None = None,
    value_range: tuple[float, float] | None = None,
) -> tuple[np.ndarray, tuple[int, int]]:
    """The image ``(C, H, W)`` uint8 at the canvas's size, and the height and width that it had.

    Args:
        part: of it that is shown, as large as the canvas; all of it where None.
        value_range: see ``eight_bit``.

    Raises:
        Fault: what does not decode.
    """
    pixels, size = stored(data, max(canvas))
    return fitted(_of_channels(eight_bit(pixels, value_range), channels), canvas, part, size), size


def stored(data: bytes, near: int | None = None, opacity: bool = False) -> tuple[np.ndarray, tuple[int, int]]:
    """A file's pixels, upright, and their height and width.

    Args:
        near: a large JPEG may come at a half, a fourth or an eighth of its size, but no smaller than this.
        opacity: keep that of 8 bits, too.

    Returns:
        ``(h, w)`` or ``(h, w, 3)`` uint8, transparent pixels on black, or ``(h, w, 4)`` where opacity is kept; of 16
        bits a channel ``(h, w)``, ``(h, w, 3)`` or, with opacity, ``(h, w, 4)`` uint16. The height and width are those
        of the whole image.

    Raises:
        Fault: what does not decode.
    """
    file = pixel_file(data)
    try:
        # The plugins themselves: Image.open warns of large images, and refuses what is larger, in words of its own.
        with _PLUGINS[file.format](io.BytesIO(file.data)) as image:
            w, h = image.size
            if w * h > MAX_PIXELS:
                raise Fault(
                    f"has {w}x{h} pixels, where at most {MAX_PIXELS:,} are read: cut it into parts, or make it smaller"
                )
            if near is not None:
                image.draft(None, (near, near))
            if file.bits == 16:
                image.load()  # finds what is cut
                pixels = _sixteen_bit(file)
            elif opacity and image.has_transparency_data:
                pixels = np.array(image.convert("RGBA"))
            else:
                pixels = opaque(image)
    except Fault:
        raise
    except Exception as error:  # what Pillow raises on bad bytes: OSError, SyntaxError, ValueError, struct.error, ...
        truncated = "truncated" in str(error).lower()
        raise Fault("is truncated" if truncated else f"does not decode ({error})") from error
    return turned(pixels, file.orientation), (w, h) if file.orientation >= 5 else (h, w)


def opaque(image: Image.Image) -> np.ndarray:
    """``(h, w)`` or ``(h, w, 3)`` uint8 of an image of at most 8 bits a channel, transparent pixels on black."""
    if image.has_transparency_data:
        image = image.convert("RGBA")
        image = Image.alpha_composite(Image.new("RGBA", image.size, (0, 0, 0, 255)), image).convert("RGB")
    return np.array(image if image.mode in ("L", "RGB") else image.convert("RGB"))


def turned(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """``(h, w)`` or ``(h, w, C)`` upright, by EXIF's orientation, 1 to 8."""
    if orientation >= 5:
        pixels = pixels.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    return np.ascontiguousarray(pixels)


def eight_bit(pixels: np.ndarray, value_range: tuple[float, float] | None = None) -> np.ndarray:
    """``(h, w)`` or ``(h, w, 3)`` uint8 of what ``stored`` gives; 8 bits stay as they are.

    Args:
        value_range: the values of 16 bits that become 0 and 255, in equal steps between them, so that of 0 to 65535 the
            upper byte is left; where None, ``full_range`` of these pixels alone.
    """
    if pixels.dtype == np.uint8:
        return pixels
    low, high = value_range or full_range(largest(pixels))
    steps = np.floor((np.arange(2**16) - low) * 256 / (high - low)).clip(0, 255).astype(np.uint8)
    if pixels.shape[2:] != (4,):
        return steps[pixels]
    return opaque(Image.fromarray(np.dstack([steps[pixels[..., :3]], (pixels[..., 3:] >> 8).astype(np.uint8)])))


def largest(pixels: np.ndarray) -> int:
    """The largest value of a channel of ``stored``, but for opacity."""
    return int(pixels[..., :3].max() if pixels.ndim == 3 else pixels.max())


def full_range(value: int) -> tuple[float, float]:
    """From 0 to the largest value of the least number of bits, at least 8, that holds a value: of 4080, 0 to 4095."""
    return 0.0, 2.0 ** max(int(value).bit_length(), 8) - 1


def largest_of_file(file: Path) -> int | None:
    """The largest value in a file of 16 bits a channel; None of any other, and of what does not decode."""
    try:
        with file.open("rb") as opened:
            if not may_have_16_bits(opened.read(26)):
                return None
        data = read(file)
        return largest(stored(data)[0]) if pixel_file(data).bits == 16 else None
    except (OSError, Fault):
        return None


def checked_range(value_range: Sequence[float]) -> tuple[float, float]:
    """A range of values of 16 bits.

    Raises:
        DataError: it is none.
    """
    try:
        low, high = map(float, value_range)
        if 0 <= low < high <= 2**16 - 1:
            return low, high
    except (TypeError, ValueError):
        pass
    raise DataError(
        f"expected as range of 16-bit images two values from 0 to 65535, the lower first, got {value_range}; leave "
        "it out to take the one that is found in the images."
    )


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


def _sixteen_bit(file: PixelFile) -> np.ndarray:
    """By OpenCV: of colours, Pillow leaves the upper byte."""
    pixels = cv2.imdecode(np.frombuffer(file.data, np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None or pixels.dtype != np.uint16 or pixels.shape[2:] not in ((), (3,), (4,)):
        raise Fault("does not decode")
    if pixels.ndim == 3:
        pixels = pixels[..., [2, 1, 0, 3][: pixels.shape[2]]]
    if pixels.shape[2:] == (4,) and not file.opacity:
        pixels = pixels[..., :3]
    if file.transparent:
        colours = pixels if pixels.ndim == 3 else np.repeat(pixels[..., None], 3, 2)
        opacity = (colours != np.array(file.transparent)).any(2, keepdims=True) * np.uint16(2**16 - 1)
        pixels = np.concatenate([colours, opacity], 2)
    return pixels


def _of_channels(pixels: np.ndarray, channels: int) -> np.ndarray:
    """``(h, w)`` for 1, ``(h, w, 3)`` for 3."""
    if (pixels.ndim == 2) == (channels == 1):
        return pixels
    return np.array(Image.fromarray(pixels).convert("L" if channels == 1 else "RGB"))


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
