"""KITTI's label files: a folder of text files, one an image of the same name, fifteen columns an object.

    type  truncated  occluded  alpha  left top right bottom  height width length  x y z  rotation_y

Boxes are in 0-based pixels of the image as it is in its file. A type counts as the class that has its name, whatever
the case, else by ``TYPES``. What stands in a region marked DontCare is not labelled.
"""

import math
from collections.abc import Iterable
from pathlib import Path

from probscene.errors import DataError

from .annotations import Annotated, Annotation, Size
from .naming import Entry
from .text import lines_of, number_of

COLUMNS = (
    "type", "truncated", "occluded", "alpha", "left", "top", "right", "bottom", "height", "width", "length",
    "x", "y", "z", "rotation_y",
)  # fmt: skip
TYPES = {
    "Car": ("car",),
    "Van": ("van",),
    "Truck": ("truck",),
    "Pedestrian": ("pedestrian", "person"),
    "Person_sitting": ("pedestrian", "person"),
    "Cyclist": ("cyclist", "bike", "bicycle", "bicyclist"),
    "Tram": ("tram",),
}
"""Of KITTI's types, what a model may call them, the likeliest first."""
DONT_CARE = "DontCare"


def read_kitti(folder: Path) -> Annotated:
    """What a folder's files say; each is read when its image is asked for."""
    files = [file for file in sorted(folder.glob("*.txt")) if not file.name.startswith(".")]
    entries = [Entry(file.stem, f"in {file}") for file in files]

    def read(i: int, _: Size) -> list[Annotation]:
        return read_objects(files[i])

    return Annotated(folder, tuple(files), entries, read, stems=True, kitti=True)


def read_objects(file: Path) -> list[Annotation]:
    """What a label file says, in the order of its lines.

    Raises:
        DataError: a file that is no text, another number of columns, what is no finite number, or a box whose ends
            are swapped; its line is named.
    """
    return [_object(fields, where) for where, fields in lines_of(file)]


def class_of(type: str, classes: Iterable[str]) -> str | None:
    """The class that a type counts as."""
    own = {name.casefold(): name for name in reversed(tuple(classes))}
    names = (type.casefold(), *TYPES.get(type, ()))
    return next((own[name] for name in names if name in own), None)


def _object(fields: list[str], where: str) -> Annotation:
    if len(fields) != len(COLUMNS):
        remedy = "fix the line"
        if len(fields) == len(COLUMNS) + 1:
            remedy = "a type is one word, and labels have no score"
        elif fields[0].isdecimal():
            remedy = "for YOLO's labels put their data.yaml or classes.txt beside them"
        raise DataError(f"expected {len(COLUMNS)} columns ({' '.join(COLUMNS)}) {where}, got {len(fields)}; {remedy}.")
    values = [number_of(text) for text in fields[1:]]
    for name, text, value in zip(COLUMNS[1:], fields[1:], values, strict=True):
        if not math.isfinite(value):
            raise DataError(f"expected a number for {name} {where}, got {text!r}; fix the line.")
    truncated, occluded, _, left, top, right, bottom, *_ = values
    if right < left or bottom < top:
        raise DataError(
            f"expected a box from left to right and top to bottom {where}, got {' '.join(fields[4:8])}; fix the line."
        )
    return Annotation(fields[0], left, top, right, bottom, truncated, occluded, where=where)
