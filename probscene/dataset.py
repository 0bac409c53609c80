"""A folder of unlabelled images, read as a model's renders are: uint8, one canvas size, grey or RGB.

Axis letters: L images of the folder, B images of a batch, C H W.
"""

import hashlib
import io
import os
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from PIL import Image, ImageOps, UnidentifiedImageError
from torch import Tensor

from probscene.ahead import ahead
from probscene.errors import DataError

SUFFIXES = (".png", ".jpg", ".jpeg")
_LAST_CHUNK = b"IEND\xaeB`\x82"  # of a PNG; neither Pillow nor OpenCV misses it
_ORIENTATION = 0x0112  # EXIF tag; values from 5 on swap width and height


class ImageFolder:
    """The PNG and JPEG files that lie directly in a folder, sorted by name; hidden files and subfolders are not read.

    Every file is decoded once when the folder is opened, so that nothing fails later; no image is kept. A truncated
    file is always found, altered bytes are in a PNG but not always in a JPEG, which has no checksum. Photos are
    turned upright by their EXIF tag, transparent pixels lie on black, 16-bit channels keep their upper byte, palettes
    and CMYK become RGB. An image of another size is stretched to the canvas, by area where it shrinks and linearly
    where it grows.

    Args:
        path: the folder.
        canvas: height and width, pixels.
        channels: 1 for grey (``grey``), 3 for RGB.
        skip_bad: leave out files that do not decode.
        progress: called with the files checked so far and their number.

    Attributes:
        paths: the L files.
        resized: how many of them are of another size.
        distinct: how many of them are left without those that equal another one in every pixel.
        bad: the files left out, each with the fault.
        notes: what a person should know, one sentence each.
        fingerprint: SHA-256, hexadecimal, of the names, the bytes of the files, the canvas and the channels: equal
            fingerprints mean equal tensors.

    Raises:
        DataError: no such folder, one without images, or files that do not decode, each named with its fault.
    """

    def __init__(
        self,
        path: Path,
        canvas: tuple[int, int],
        channels: int,
        skip_bad: bool = False,
        progress: Callable[[int, int], None] | None = None,
    ):
        self.path, self.canvas, self.channels = Path(path), tuple(canvas), channels
        files, others = _listed(self.path)
        digest = hashlib.sha256(repr((self.canvas, channels)).encode())
        self.paths: list[Path] = []
        self.bad: dict[Path, str] = {}
        sizes, pictures = Counter(), set()
        with _quiet(), closing(ahead(self._checked, files, len(os.sched_getaffinity(0)))) as checked:
            for i, (file, found) in enumerate(zip(files, checked, strict=True)):
                if isinstance(found, _Bad):
                    self.bad[file] = str(found)
                else:
                    self.paths.append(file)
                    digest.update(hashlib.sha256(os.fsencode(file.name)).digest() + found.data)
                    sizes[found.size] += 1
                    pictures.add(found.picture)
                if progress is not None:
                    progress(i + 1, len(files))
        self._judge(skip_bad)
        self.fingerprint = digest.hexdigest()
        self.distinct = len(pictures)
        sizes.pop(self.canvas, None)
        self.resized = sizes.total()
        self.notes = self._notes(sizes, others)

    def __len__(self) -> int:
        return len(self.paths)

    def load(self, i: int) -> Tensor:
        """Image number ``i``, ``(C, H, W)`` uint8.

        Raises:
            DataError: the file has gone bad since the folder was opened.
        """
        try:
            with _quiet():
                image, _ = _decoded(_read(self.paths[i]), self.canvas, self.channels)
        except _Bad as fault:
            raise DataError(f"Expected the image {self.paths[i]} as it was, actual a file that {fault}.") from fault
        return torch.from_numpy(image)

    def batches(self, size: int) -> Iterator[Tensor]:
        """All images in order, ``(B, C, H, W)`` uint8 with B = ``size``, fewer in the last batch; one is in memory at
        a time.

        Raises:
            DataError: see ``load``; a size that is not positive.
        """
        if size < 1:
            raise DataError(f"Expected a positive batch size, actual {size}.")
        for start in range(0, len(self), size):
            yield torch.stack([self.load(i) for i in range(start, min(start + size, len(self)))])

    def _checked(self, file: Path) -> "_Checked | _Bad":
        try:
            data = _read(file)
            picture, size = _decoded(data, self.canvas, self.channels)
        except _Bad as fault:
            return fault
        return _Checked(size, hashlib.sha256(data).digest(), hashlib.blake2b(picture, digest_size=16).digest())

    def _judge(self, skip_bad: bool) -> None:
        if self.bad and not (skip_bad and self.paths):
            remedy = "there is no other image in the folder" if not self.paths else "mend or delete them, or skip them"
            total = len(self.paths) + len(self.bad)
            raise DataError(
                f"Expected images that decode in {self.path}, actual {len(self.bad)} of {total} bad: "
                f"{_first(f'{file.name} {fault}' for file, fault in self.bad.items())}; {remedy}"
                f"{' with --skip-bad' if self.paths else ''}."
            )

    def _notes(self, sizes: Counter, others: list[str]) -> tuple[str, ...]:
        notes = []
        if self.resized:
            height, width = sizes.most_common(1)[0][0]
            notes.append(
                f"{self.resized} of {len(self)} images in {self.path} have another size, most often {width}x{height}; "
                f"they are resized to {self.canvas[1]}x{self.canvas[0]}."
            )
        if self.bad:
            faults = _first(f"{file.name} {fault}" for file, fault in self.bad.items())
            notes.append(f"{len(self.bad)} bad files in {self.path} are left out: {faults}.")
        if others:
            notes.append(f"{len(others)} files in {self.path} are neither PNG nor JPEG and not read: {_first(others)}.")
        return tuple(notes)


def grey(image: Tensor) -> Tensor:
    """RGB ``(..., 3, H, W)`` uint8 to luma ``(..., 1, H, W)`` (ITU-R 601), which leaves grey as it is.

    Pillow's weights, so that a colour file read as grey and a colour render turned grey agree to the bit.
    """
    red, green, blue = image.split(1, -3)
    if torch.equal(red, green) and torch.equal(green, blue):  # most renders of a grey model, and much faster
        return red.contiguous()
    red, green, blue = (channel.to(torch.int32) for channel in (red, green, blue))
    return ((19595 * red + 38470 * green + 7471 * blue + 32768) >> 16).to(torch.uint8)


class _Bad(Exception):
    """A file that does not decode; the text completes 'a file that ...'."""


class _Checked(NamedTuple):
    """A file that decodes: its height and width, and digests of its bytes and of its pixels."""

    size: tuple[int, int]
    data: bytes
    picture: bytes


@contextmanager
def _quiet() -> Iterator[None]:
    """Without Pillow's warnings about odd metadata; they are the whole process's, so no thread can do it alone."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def _listed(folder: Path) -> tuple[list[Path], list[str]]:
    """The image files of a folder, sorted by name, and the names of its other files."""
    if not folder.exists():
        raise DataError(f"Expected a folder of PNG or JPEG images, actual {folder}, which is not there.")
    if not folder.is_dir():
        raise DataError(f"Expected a folder of PNG or JPEG images, actual {folder}, which is a file; name its folder.")
    try:
        entries = sorted(entry for entry in folder.iterdir() if not entry.name.startswith("."))
    except OSError as error:
        raise DataError(f"Expected a folder that can be read, actual {folder}: {error.strerror}.") from error
    folders = [entry.name + "/" for entry in entries if entry.is_dir()]
    files = [entry for entry in entries if not entry.is_dir()]
    images = [entry for entry in files if entry.suffix.lower() in SUFFIXES]
    others = [entry.name for entry in files if entry.suffix.lower() not in SUFFIXES]
    if not images:
        there = f"only {_first(folders + others)}" if folders or others else "an empty folder"
        remedy = "; images in subfolders are not read, name the subfolder" if folders else ""
        raise DataError(f"Expected PNG or JPEG images in {folder}, actual {there}{remedy}.")
    return images, others


def _read(file: Path) -> bytes:
    try:
        return file.read_bytes()
    except OSError as error:
        raise _Bad(f"cannot be read ({error.strerror})") from error


def _decoded(data: bytes, canvas: tuple[int, int], channels: int) -> tuple[np.ndarray, tuple[int, int]]:
    """The image ``(C, H, W)`` uint8 at the canvas's size, and the height and width that it had."""
    if not data:
        raise _Bad("is empty")
    try:
        with Image.open(io.BytesIO(data), formats=("PNG", "JPEG")) as image:
            if image.format == "PNG":
                if _LAST_CHUNK not in data:
                    raise _Bad("is truncated")
                with Image.open(io.BytesIO(data)) as again:
                    again.verify()  # decoding alone does not compare the checksums
            turned = image.getexif().get(_ORIENTATION, 1) >= 5
            size = image.size if turned else image.size[::-1]
            image.draft(None, (max(canvas), max(canvas)))  # a large JPEG is decoded at a half, a fourth, an eighth
            pixels = np.array(_eight_bit(ImageOps.exif_transpose(image)).convert("L" if channels == 1 else "RGB"))
    except _Bad:
        raise
    except UnidentifiedImageError as error:
        raise _Bad("is not a PNG or JPEG image") from error
    except Exception as error:  # what Pillow raises on bad bytes: OSError, SyntaxError, ValueError, struct.error, ...
        truncated = "truncated" in str(error).lower()
        raise _Bad("is truncated" if truncated else f"does not decode ({error})") from error
    pixels = _resized(pixels, canvas)
    return np.ascontiguousarray(pixels[None] if channels == 1 else pixels.transpose(2, 0, 1)), size


def _eight_bit(image: Image.Image) -> Image.Image:
    """An opaque image of at most 8 bits a channel."""
    if image.mode.startswith("I"):
        return Image.fromarray((np.asarray(image).astype(np.uint16) >> 8).astype(np.uint8))
    if image.has_transparency_data:
        image = image.convert("RGBA")
        return Image.alpha_composite(Image.new("RGBA", image.size, (0, 0, 0, 255)), image).convert("RGB")
    return image if image.mode == "L" else image.convert("RGB")


def _resized(pixels: np.ndarray, canvas: tuple[int, int]) -> np.ndarray:
    """``(h, w)`` or ``(h, w, 3)`` to the canvas's height and width."""
    height, width = canvas
    shrunk = (min(height, pixels.shape[0]), min(width, pixels.shape[1]))
    for (h, w), how in ((shrunk, cv2.INTER_AREA), ((height, width), cv2.INTER_LINEAR)):
        if pixels.shape[:2] != (h, w):
            pixels = cv2.resize(pixels, (w, h), interpolation=how)
    return pixels


def _first(names, number: int = 5) -> str:
    """The first few of many names, for a message."""
    names = list(names)
    return ", ".join(names[:number]) + (f" and {len(names) - number} more" if len(names) > number else "")
