"""KITTI's label files as the truth: a folder of text files, one an image of the same name, fifteen columns an object.

    type  truncated  occluded  alpha  left top right bottom  height width length  x y z  rotation_y

Boxes are in 0-based pixels of the image as it is in its file. A type counts as the class of the model that has its
name, whatever the case, else by ``TYPES``; types that the model has no class for are left out, which the notes say. So
are objects whose middle lies where the target's image is cut, see ``Images``. What stands in a region marked DontCare
is not labelled: the notes say how many images have such regions. Labelled are the classes that one of KITTI's own types
counts as, and those that occur.
"""

import math
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from probscene.dataset import Images
from probscene.errors import DataError
from probscene.model import SceneModel

from .boxes import Box, Boxes, on_canvas

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


class Object(NamedTuple):
    """One line: its type, its box in pixels, and how much of it is cut by the image (a share) and hidden (0 to 3)."""

    type: str
    left: float
    top: float
    right: float
    bottom: float
    truncated: float = 0.0
    occluded: float = 0.0


def read_objects(file: Path) -> list[Object]:
    """What a label file says, in the order of its lines.

    Raises:
        DataError: a file that is no text, another number of columns, what is no finite number, or a box whose ends
            are swapped; its line is named.
    """
    try:
        lines = file.read_text(encoding="utf-8-sig").split("\n")
    except OSError as error:
        raise DataError(f"Expected a label file at {file}, actual none to be read: {error.strerror}.") from error
    except UnicodeDecodeError as error:
        raise DataError(f"Expected a text file in UTF-8, actual {file}: {error}.") from error
    return [
        _object(line.split(), f"in line {number} of {file}") for number, line in enumerate(lines, 1) if line.strip()
    ]


def read_kitti(folder: Path, model: SceneModel, target: Images, some: bool = False, min_height: float = 0.0) -> Boxes:
    """The boxes of a target's images.

    Files of images that are not in the target are not read, which the notes say.

    Args:
        some: there need not be one for every image; those without are left out.
        min_height: of a box that is kept, pixels.

    Raises:
        DataError: see ``read_objects``; an image without a file, an object beside its image, or no type that the model
            has a class for.
    """
    files = {i: folder / f"{path.stem}.txt" for i, path in enumerate(target.paths)}
    found = {i: read_objects(file) for i, file in files.items() if file.is_file()}
    missing = [file.name for file in files.values() if not file.is_file()]
    if missing and not (some and found):
        names = missing[0] + (f" and {len(missing) - 1} more" if len(missing) > 1 else "")
        raise DataError(
            f"Expected a label file in {folder} for every image of {target.path}, actual none named {names}"
            f"{'' if some else '; if only some are labelled, add --some-labels'}."
        )
    occurring = Counter(one.type for objects in found.values() for one in objects if one.type != DONT_CARE)
    of_type = {name: _class(name, model.classes) for name in (*TYPES, *occurring)}
    classes = tuple(name for name in model.classes if name in of_type.values())
    if not classes:
        raise DataError(
            f"Expected types in {folder} that model {model.name!r} has classes for ({', '.join(model.classes)}), "
            f"actual {', '.join(occurring) or 'no object'}."
        )
    boxes = [
        [_box(one, name, files[i]) for one in objects if (name := of_type.get(one.type))]
        for i, objects in found.items()
    ]
    notes = (*_unread(folder, target), *_notes(occurring, of_type), *_marked(found.values(), min_height))
    return on_canvas(target, list(found), boxes, classes, notes, min_height)


def _box(one: Object, name: str, file: Path) -> Box:
    """Pixels have numbers, and the last one is part of the box."""
    height = one.bottom - one.top
    return Box(name, one.left, one.top, one.right + 1, one.bottom + 1, height, f"in {file}")


def _object(fields: list[str], where: str) -> Object:
    if len(fields) != len(COLUMNS):
        longer = len(fields) == len(COLUMNS) + 1
        remedy = "a type is one word, and labels have no score" if longer else "mend the line"
        raise DataError(
            f"Expected {len(COLUMNS)} columns ({' '.join(COLUMNS)}) {where}, actual {len(fields)}; {remedy}."
        )
    values = []
    for name, text in zip(COLUMNS[1:], fields[1:], strict=True):
        try:
            values.append(float("nan" if "_" in text else text))  # Python reads 1_0 as 10
        except ValueError:
            values.append(math.nan)
        if not math.isfinite(values[-1]):
            raise DataError(f"Expected a number for {name} {where}, actual {text!r}; mend the line.")
    found = Object(fields[0], *values[3:7], *values[:2])
    if found.right < found.left or found.bottom < found.top:
        raise DataError(
            f"Expected a box from left to right and top to bottom {where}, actual {' '.join(fields[4:8])}; mend the "
            "line."
        )
    return found


def _class(type: str, classes: tuple[str, ...]) -> str | None:
    """The class that a type counts as."""
    own = {name.casefold(): name for name in reversed(classes)}
    names = (type.casefold(), *TYPES.get(type, ()))
    return next((own[name] for name in names if name in own), None)


def _unread(folder: Path, target: Images) -> list[str]:
    """Which files are of no image."""
    images = {path.stem for path in (*target.paths, *target.bad)}
    others = sorted(file.name for file in folder.glob("*.txt") if file.stem not in images)
    more = f" and {len(others) - 1} more" if len(others) > 1 else ""
    return [f"Not read, since {target.path} has no such image: {others[0]}{more}."] if others else []


def _notes(occurring: Counter, of_type: dict[str, str | None]) -> list[str]:
    """Which types count as something of another name, and which not at all."""
    renamed = [f"{name} as {own}" for name in occurring if (own := of_type[name]) and own.casefold() != name.casefold()]
    out = [f"{number} {name}" for name, number in occurring.most_common() if of_type[name] is None]
    notes = [f"Counted are {', '.join(sorted(renamed))}."] if renamed else []
    return notes + ([f"Not counted, since the model has no such class: {', '.join(out)}."] if out else [])


def _marked(found: Iterable[list[Object]], min_height: float) -> list[str]:
    """How many images have a region without labels that could hold an object which counts."""
    each = [[one.bottom - one.top for one in objects if one.type == DONT_CARE] for objects in found]
    marked = sum(max(heights, default=-1.0) >= min_height for heights in each)
    high = f" that are at least {min_height:g} pixels high" if min_height else ""
    note = (
        f"{marked} of {len(each)} images have regions marked {DONT_CARE}{high}; objects there are not labelled, so "
        "that these images may show more than their labels say."
    )
    return [note] if marked else []
