"""What labels with boxes say of images, whatever their format."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .naming import Entry

Size = tuple[int, int]
"""Height and width, pixels."""


class Annotation(NamedTuple):
    """One object, its box in pixels of its image's file as its format has it.

    Attributes:
        name: of its class.
        left, top, right, bottom: of its box.
        truncated: KITTI's share that the image cuts.
        occluded: KITTI's level of what is hidden, 0 to 3.
        crowd: it stands for an unknown number of objects.
        where: it is in its file, for messages.
        score: of a detection; None of a label.
        mask: ``mask()``, its pixels ``(H, W)`` bool; None where only its box is known.
    """

    name: str
    left: float
    top: float
    right: float
    bottom: float
    truncated: float = 0.0
    occluded: float = 0.0
    crowd: bool = False
    where: str = ""
    score: float | None = None
    mask: Callable[[], NDArray[np.bool_]] | None = None


class Annotated(NamedTuple):
    """Labels of images.

    Attributes:
        path: of the file or folder.
        files: that they are read from.
        images: of each image its name, and where it stands.
        read: the objects of image number i, for an image of a size; raises ``DataError`` where they are no objects, or
            of an image of another size.
        classes: names that the format lists; of KITTI none.
        stems: the images' names have no ending, since each has a file of its own.
        kitti: whether types, levels and regions are KITTI's, and boxes end with the number of their last pixel.
    """

    path: Path
    files: tuple[Path, ...]
    images: Sequence[Entry]
    read: Callable[[int, Size], list[Annotation]]
    classes: tuple[str, ...] = ()
    stems: bool = False
    kitti: bool = False
