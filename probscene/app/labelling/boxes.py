"""Boxes of a target's images, from whatever format, where the model's canvas has them. Axis letters: K images, C
classes, n boxes of one image.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from probscene.dataset import Images
from probscene.errors import DataError


class Box(NamedTuple):
    """One object in pixels of its image's file, from the outer edges of its first to those of its last pixel.

    Attributes:
        name: of its class.
        height: as its format has it.
        where: it is in its file, for messages.
    """

    name: str
    x0: float
    y0: float
    x1: float
    y1: float
    height: float
    where: str


class Boxes(NamedTuple):
    """The boxes of K of a target's images.

    Attributes:
        rows: the K numbers of the images, ascending.
        boxes: of each image ``(n, 5)`` float32: the number of its class in ``classes``, then x0, y0, x1, y1 in pixels
            of the canvas, clipped to it.
        classes: the C that are labelled, in the model's order.
        notes: what a person should know, one sentence each.
    """

    rows: list[int]
    boxes: tuple[Tensor, ...]
    classes: tuple[str, ...]
    notes: tuple[str, ...] = ()

    @property
    def counts(self) -> NDArray[np.int64]:
        """``(K, C)``."""
        each = [torch.bincount(found[:, 0].long(), minlength=len(self.classes)) for found in self.boxes]
        return torch.stack(each).numpy() if each else np.zeros((0, len(self.classes)), np.int64)


def on_canvas(
    target: Images,
    rows: list[int],
    found: list[list[Box]],
    classes: tuple[str, ...],
    notes: tuple[str, ...],
    min_height: float = 0.0,
) -> Boxes:
    """Boxes of files' pixels, moved as the images are when they are read.

    What sticks out of its image is clipped. What has its middle where the image is cut is left out, which a note says.

    Args:
        found: of each of the K images, its boxes.
        min_height: of a box that is kept, pixels of its file.

    Raises:
        DataError: a box entirely beside its image.
    """
    small, cut, boxes = 0, 0, []
    for row, each in zip(rows, found, strict=True):
        size, seen, (H, W) = target.sizes[row], target.windows[row], target.canvas
        top, left, height, width = (0, 0, *size) if seen is None else seen
        kept = []
        for box in each:
            if not (box.x0 < size[1] and box.x1 > 0 and box.y0 < size[0] and box.y1 > 0):
                raise DataError(
                    f"Expected boxes on the image of {size[1]}x{size[0]} {box.where}, actual {box.name} from "
                    f"{box.x0:g}, {box.y0:g} to {box.x1:g}, {box.y1:g}; give the labels of these images, not of images "
                    "of another size."
                )
            x0, x1 = (min(max(x, 0), size[1]) - left for x in (box.x0, box.x1))
            y0, y1 = (min(max(y, 0), size[0]) - top for y in (box.y0, box.y1))
            if seen is not None and not (0 <= (x0 + x1) / 2 < width and 0 <= (y0 + y1) / 2 < height):
                cut += 1
            elif box.height < min_height:
                small += 1
            else:
                x0, x1 = (min(max(x, 0), width) * W / width for x in (x0, x1))
                y0, y1 = (min(max(y, 0), height) * H / height for y in (y0, y1))
                kept.append([classes.index(box.name), x0, y0, x1, y1])
        boxes.append(torch.tensor(kept, dtype=torch.float32).reshape(-1, 5))
    if cut:
        notes += (f"{cut} objects that lie where images are cut are not counted.",)
    if small:
        notes += (f"{small} objects of less than {min_height:g} pixels' height are not counted.",)
    return Boxes(rows, tuple(boxes), classes, notes)


def finite(values: list[float]) -> bool:
    """Whether all are numbers of pixels."""
    return all(type(value) in (int, float) and abs(value) < 1e9 for value in values)


def place(path: Path, key: str, i: int) -> str:
    """Where an entry of a list in a JSON file is, for messages."""
    return f"in {key}[{i}] of {path}"
