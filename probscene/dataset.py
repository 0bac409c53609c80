"""A folder of unlabelled images, read as a model's renders are: uint8, one canvas size, grey or RGB.

Axis letters: L images of the folder, B images of a batch, C H W.
"""

import hashlib
import os
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from .decoding import (
    Part,
    Window,
    checked_range,
    decoded,
    full_range,
    largest_of_file,
    quiet,
    read,
    window,
)
from .errors import DataError
from .image_bytes import Fault
from .prefetch import ahead
from .threads import cores

SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
LEAST_PART = 0.75  # of either side of an image, in its further views


class Images:
    """L images as a model's renders are, from wherever they come: an ``ImageFolder`` or an ``ImageArray``.

    Attributes:
        path: their folder; of others what they are called in messages.
        paths: their files; of others what they are called.
        canvas: height and width, pixels.
        channels: 1 for grey (``grey``), 3 for RGB.
        sizes: of each of them, the height and width that it had.
        windows: of each of them, what is seen of it, see ``window``; None where that is all.
        distinct: how many of them are left without those that equal another one in every pixel.
        bad: the files left out, each with the fault.
        value_range: the values of images of 16 bits that are read as 0 and 255, see ``decoding.eight_bit``; None where
            there are none, and none was given.
        notes: what a person should know, one sentence each.
        fingerprint: SHA-256, hexadecimal: equal fingerprints mean equal tensors.
    """

    path: Path
    paths: list[Path]
    canvas: tuple[int, int]
    channels: int
    sizes: list[tuple[int, int]]
    windows: list[Window | None]
    distinct: int
    bad: dict[Path, str]
    value_range: tuple[float, float] | None = None
    notes: tuple[str, ...]
    fingerprint: str

    def __len__(self) -> int:
        return len(self.paths)

    @property
    def scales(self) -> list[float]:
        """Of each of the files, how many of the canvas's rows a row of it becomes."""
        each = zip(self.sizes, self.windows, strict=True)
        return [self.canvas[0] / (size[0] if seen is None else seen.height) for size, seen in each]

    def load(self, i: int, view: int = 0) -> Tensor:
        """Image number ``i``, ``(C, H, W)`` uint8.

        Args:
            view: 0 for the image as it is. Any other number is a part of it, at least ``LEAST_PART`` of either side and
                anywhere in it, resized to the canvas: which one depends on ``i`` and the number alone.
        """
        raise TypeError(f"expected images with a 'load' method, got {type(self).__name__}.")

    def subset(self, max_images: int) -> Tensor:
        """At most so many of the images, ``(l, C, H, W)`` uint8, evenly spread over all."""
        number = min(max_images, len(self))
        return torch.stack([self.load(i * len(self) // number) for i in range(number)])

    def batches(self, size: int, view: int = 0) -> Iterator[Tensor]:
        """All images in order, ``(B, C, H, W)`` uint8 with B = ``size``, fewer in the last batch; one is in memory at
        a time.

        Args:
            view: of each image, see ``load``.

        Raises:
            DataError: see ``load``; a size that is not positive.
        """
        if size < 1:
            raise DataError(f"expected a positive batch size, got {size}.")
        for start in range(0, len(self), size):
            yield torch.stack([self.load(i, view) for i in range(start, min(start + size, len(self)))])


class ImageFolder(Images):
    """The PNG, JPEG and TIFF files that lie directly in a folder, sorted by name; hidden files and subfolders are not
    read.

    Every file is decoded once when the folder is opened, so that nothing fails later; no image is kept. Truncated files
    are always detected, altered pixels always in a PNG but not always in the others, which have no checksum. Photos are
    turned upright by their EXIF tag, transparent pixels are put on black, palettes and CMYK become RGB; channels of 16
    bits are read over one range of values for all images. An image of another size is resized to the canvas, by area
    where it shrinks and linearly where it grows. If its shape is the canvas's to within 2 % it is stretched; from any
    other the largest part in the middle that has the canvas's shape is cut out (``window``).

    Args:
        path: the folder; or several files, wherever they lie.
        canvas: height and width, pixels.
        channels: 1 for grey (``grey``), 3 for RGB.
        skip_bad: leave out files that do not decode.
        progress: called with the files checked so far and their number.
        value_range: the values of images of 16 bits that are read as 0 and 255; where None, from 0 to the largest value
            of as many bits as the largest one in the folder has.

    Attributes:
        paths: the L files.
        sizes: of each of them, the height and width that it has in its file.
        windows: of each of them, what is seen of it, see ``window``; None where that is all.
        resized: how many of them are of another size.
        cropped: how many of them are of another shape.
        distinct: how many of them are left without those that equal another one in every pixel.
        bad: the files left out, each with the fault.
        listed: whether the files were named, and not their folder.
        value_range: see ``Images``.
        notes: what a person should know, one sentence each.
        fingerprint: SHA-256, hexadecimal, of the names, the bytes of the files, the canvas, the channels, of what is
            seen where that is not all, and of the range where images have 16 bits: equal fingerprints mean equal
            tensors.

    Raises:
        DataError: no such folder, one without images, or files that do not decode, each named with its fault; a range
            that is none.
    """

    def __init__(
        self,
        path: Path | Sequence[Path],
        canvas: tuple[int, int],
        channels: int,
        skip_bad: bool = False,
        progress: Callable[[int, int], None] | None = None,
        value_range: Sequence[float] | None = None,
    ):
        self.canvas, self.channels = (canvas[0], canvas[1]), channels
        if isinstance(path, str | os.PathLike):
            self.path = Path(path)
            files, others, below = listed(self.path)
        else:
            files, others, below = [Path(file) for file in path], [], {}
            self.path = _place(files)
        self.listed = bool(isinstance(path, list | tuple))
        self.value_range, of_range = range_of(files, value_range)
        digest = hashlib.sha256(repr((self.canvas, channels)).encode())
        self.paths, self.sizes, self.windows = [], [], []
        self.bad = {}
        pictures = set()
        with quiet(), closing(ahead(self._checked, files, cores())) as checked:
            for i, (file, found) in enumerate(zip(files, checked, strict=True)):
                if isinstance(found, Fault):
                    self.bad[file] = str(found)
                else:
                    self.paths.append(file)
                    digest.update(hashlib.sha256(os.fsencode(file.name)).digest() + found.data)
                    self.sizes.append(found.size)
                    pictures.add(found.picture)
                    seen = window(found.size, self.canvas)
                    self.windows.append(seen)
                    if seen is not None:
                        digest.update(repr(tuple(seen)).encode())
                if progress is not None:
                    progress(i + 1, len(files))
        self._judge(skip_bad)
        if of_range:
            digest.update(repr(self.value_range).encode())
        self.fingerprint = digest.hexdigest()
        self.distinct = len(pictures)
        sizes = Counter(self.sizes)
        cut = Counter((size, seen) for size, seen in zip(self.sizes, self.windows, strict=True) if seen is not None)
        sizes.pop(self.canvas, None)
        self.resized, self.cropped = sizes.total(), cut.total()
        self.notes = (*self._notes(sizes, cut, others, below), *of_range)

    def load(self, i: int, view: int = 0) -> Tensor:
        """Image number ``i``, ``(C, H, W)`` uint8.

        Args:
            view: 0 for the image as it is. Any other number is a part of it, at least ``LEAST_PART`` of either side and
                anywhere in it, resized to the canvas: which one depends on ``i`` and the number alone.

        Raises:
            DataError: the file has gone bad since the folder was opened.
        """
        try:
            with quiet():
                part = part_of(i, view) if view else None
                image, _ = decoded(read(self.paths[i]), self.canvas, self.channels, part, self.value_range)
        except Fault as fault:
            raise DataError(f"expected the image {self.paths[i]} as it was, got a file that {fault}.") from fault
        return torch.from_numpy(image)

    def _checked(self, file: Path) -> "_Checked | Fault":
        try:
            data = read(file)
            picture, size = decoded(data, self.canvas, self.channels, value_range=self.value_range)
        except Fault as fault:
            return fault
        return _Checked(size, hashlib.sha256(data).digest(), hashlib.blake2b(picture.data, digest_size=16).digest())

    def _judge(self, skip_bad: bool) -> None:
        if self.bad and not (skip_bad and self.paths):
            remedy = "there is no other image in the folder" if not self.paths else "fix or delete them, or skip them"
            total = len(self.paths) + len(self.bad)
            raise DataError(
                f"expected images that decode in {self.path}, got {len(self.bad)} of {total} bad: "
                f"{_first(f'{file.name} {fault}' for file, fault in self.bad.items())}; {remedy}"
                f"{' with --skip-bad' if self.paths else ''}."
            )

    def _notes(self, sizes: Counter, cut: Counter, others: list[str], below: dict[str, int]) -> tuple[str, ...]:
        notes = []
        if self.resized:
            height, width = sizes.most_common(1)[0][0]
            notes.append(
                f"{self.resized} of {len(self)} images in {self.path} have another size, most often {width}x{height}; "
                f"they are resized to {self.canvas[1]}x{self.canvas[0]}."
            )
        if self.cropped:
            (height, width), (_, _, rows, columns) = cut.most_common(1)[0][0]
            notes.append(
                f"{self.cropped} of {len(self)} images in {self.path} have another shape, of which only the middle is "
                f"seen, mostly {columns}x{rows} of {width}x{height}; cut them before where it should be another part."
            )
        if self.bad:
            faults = _first(f"{file.name} {fault}" for file, fault in self.bad.items())
            notes.append(f"{len(self.bad)} bad files in {self.path} are left out: {faults}.")
        if others:
            notes.append(f"{len(others)} files in {self.path} are no PNG, JPEG or TIFF and not read: {_first(others)}.")
        if below:
            named = _first(f"{name}/ ({number})" for name, number in below.items())
            notes.append(
                f"{sum(below.values())} images in subfolders of {self.path} are not read: {named}; name a subfolder, "
                "or put all images in one folder."
            )
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


class _Checked(NamedTuple):
    """A file that decodes: its height and width, and digests of its bytes and of its pixels."""

    size: tuple[int, int]
    data: bytes
    picture: bytes


def range_of(
    files: Sequence[Path], value_range: Sequence[float] | None
) -> tuple[tuple[float, float] | None, tuple[str, ...]]:
    """The range over which files of 16 bits are read, the one that is given or the one that is found in them; and what
    a person should know, where there are such files.

    Raises:
        DataError: what is given is none.
    """
    with quiet(), closing(ahead(largest_of_file, files, cores())) as found:
        return common_range(list(found), value_range)


def common_range(
    values: Sequence[int | None], value_range: Sequence[float] | None
) -> tuple[tuple[float, float] | None, tuple[str, ...]]:
    """See ``range_of``; ``values`` are the largest of each image, None of one that has not 16 bits."""
    given = None if value_range is None else checked_range(value_range)
    largest = [value for value in values if value is not None]
    if not largest:
        return given, ()
    low, high = given or full_range(max(largest))
    note = (
        f"{len(largest)} of {len(values)} images have 16 bits a channel and values up to {max(largest)}; "
        f"{low:g} to {high:g} are read as black to white. Give another range with --range LOW,HIGH."
    )
    return (low, high), (note,)


def is_image(file: Path) -> bool:
    """Whether a file counts as an image by its name; hidden files do not."""
    return file.suffix.lower() in SUFFIXES and not file.name.startswith(".")


def listed(folder: Path) -> tuple[list[Path], list[str], dict[str, int]]:
    """The image files of a folder, sorted by name; the names of its other files; and by name of its subfolders how many
    images are in them.

    Raises:
        DataError: no such folder, or one without images.
    """
    if not folder.exists():
        raise DataError(f"expected a folder of PNG, JPEG or TIFF images, got {folder}, which is not there.")
    if not folder.is_dir():
        raise DataError(
            f"expected a folder of PNG, JPEG or TIFF images, got {folder}, which is a file; name its folder."
        )
    try:
        entries = [entry for entry in folder.iterdir() if not entry.name.startswith(".")]
    except OSError as error:
        raise DataError(f"expected a folder that can be read, got {folder}: {error.strerror}.") from error
    entries.sort(key=lambda entry: entry.name)  # paths of Windows would be sorted without regard to case
    folders = [entry.name + "/" for entry in entries if entry.is_dir()]
    files = [entry for entry in entries if not entry.is_dir()]
    images = [entry for entry in files if is_image(entry)]
    others = [entry.name for entry in files if not is_image(entry)]
    if not images:
        there = f"only {_first(folders + others)}" if folders or others else "an empty folder"
        remedy = "; images in subfolders are not read, name the subfolder" if folders else ""
        raise DataError(f"expected PNG, JPEG or TIFF images in {folder}, got {there}{remedy}.")
    below = {entry.name: _images_below(entry) for entry in entries if entry.is_dir()}
    return images, others, {name: number for name, number in below.items() if number}


def _images_below(folder: Path) -> int:
    number = 0
    for _, folders, files in os.walk(folder):
        folders[:] = [name for name in folders if not name.startswith(".")]
        number += sum(is_image(Path(name)) for name in files)
    return number


def _place(files: list[Path]) -> Path:
    """The folder of a list of files, or the one that has all of theirs."""
    if not files:
        raise DataError("expected PNG, JPEG or TIFF images, got an empty list of files.")
    return Path(os.path.commonpath([file.resolve().parent for file in files]))


def part_of(i: int, view: int) -> Part:
    """The part of image number ``i`` that one of its further views shows."""
    share, down, along = np.random.default_rng([view, i]).random(3).tolist()
    return Part(LEAST_PART + (1 - LEAST_PART) * share, down, along)


def _first(names, number: int = 5) -> str:
    """The first few of many names, for a message."""
    names = list(names)
    return ", ".join(names[:number]) + (f" and {len(names) - number} more" if len(names) > number else "")
