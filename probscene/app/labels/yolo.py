"""YOLO's label files: a folder ``labels`` of text files, one an image of the same name, one line an object.

    class x y width height          the middle and the sides of a box
    class x1 y1 x2 y2 x3 y3 ...     a polygon, such as a segment or an oriented box

All but the number of the class are shares of the image's width and height. What the classes are called is in
``data.yaml`` (``names``; with ``kpt_shape`` keypoints follow each box, which are not read) or, one a line, in
``classes.txt`` or ``obj.names``; these lie in the folder of the files or up to two above it. An image without a file is
not labelled, one with an empty file shows nothing.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from probscene.errors import DataError

from .annotations import Annotated, Annotation, Size
from .naming import Entry
from .text import lines_of, number_of, text_of

LABELS, IMAGES = "labels", "images"
DATA = ("data.yaml", "data.yml")
LISTS = ("classes.txt", "obj.names")


def names_file(folder: Path) -> Path | None:
    """The file beside a folder's labels that names the classes."""
    folders = (folder, *folder.absolute().parents[:2])
    return next((file for at in folders for name in (*DATA, *LISTS) if (file := at / name).is_file()), None)


def read_yolo(path: Path, names: Path) -> Annotated:
    """What the files of a folder say; each is read when its image is asked for.

    Args:
        path: the folder ``labels``, one in it or above it, or the ``data.yaml``.
        names: the file that names the classes.

    Raises:
        DataError: there are no names.
    """
    folder = path if path.is_dir() else path.parent
    classes, keypoints = _classes(names)
    files = _label_files(folder)
    entries = [Entry((_images_of(file.parent) / file.stem).as_posix(), f"in {file}") for file in files]

    def read(i: int, size: Size) -> list[Annotation]:
        return [_object(fields, where, classes, keypoints, size) for where, fields in lines_of(files[i])]

    return Annotated(path, (names, *files), entries, read, tuple(dict.fromkeys(classes.values())), stems=True)


def images_beside(labels: Annotated) -> list[Path]:
    """The folders that may hold the images of label files: where YOLO looks, ``images`` for ``labels``, or beside."""
    folders = dict.fromkeys(file.parent for file in labels.files[1:])
    return list(dict.fromkeys(_images_of(folder) for folder in folders))


def _images_of(folder: Path) -> Path:
    parts = folder.absolute().parts
    if LABELS not in parts:
        return folder
    last = len(parts) - 1 - parts[::-1].index(LABELS)
    images = Path(*parts[:last], IMAGES, *parts[last + 1 :])
    return images if images.is_dir() else folder


def _label_files(folder: Path) -> list[Path]:
    roots = [folder / LABELS] if (folder / LABELS).is_dir() else sorted(folder.glob(f"*/{LABELS}"))
    found = [file for root in roots for file in sorted(root.rglob("*.txt"))] or sorted(folder.rglob("*.txt"))
    return [file for file in found if not file.name.startswith(".") and file.name not in LISTS]


def _classes(file: Path) -> tuple[dict[int, str], int]:
    """The classes' names by number, and how many numbers of keypoints follow each box."""
    if file.name in LISTS:
        return dict(enumerate(" ".join(words) for _, words in lines_of(file))), 0
    try:
        whole: Any = yaml.safe_load(text_of(file))
    except yaml.YAMLError as error:
        about = " ".join(str(error).split())
        raise DataError(f"expected YAML with names of classes in {file}, got something else ({about}).") from error
    names = whole.get("names") if isinstance(whole, Mapping) else None
    numbered = dict(enumerate(names)) if isinstance(names, list) else names
    if not isinstance(numbered, Mapping) or not numbered or not all(str(key).isdecimal() for key in numbered):
        raise DataError(f"expected names: a list of the classes, in {file}, got {names!r}; write it.")
    shape = whole.get("kpt_shape") or [0, 0]
    if not isinstance(shape, list) or [type(number) for number in shape] != [int, int]:
        raise DataError(
            f"expected kpt_shape: how many keypoints, and numbers each, in {file}, got {shape!r}; fix or delete it."
        )
    return {int(key): str(name) for key, name in numbered.items()}, shape[0] * shape[1]


def _object(fields: list[str], where: str, classes: dict[int, str], keypoints: int, size: Size) -> Annotation:
    number, *shares = (number_of(text) for text in fields)
    if number not in classes:
        raise DataError(
            f"expected the number of a class, {min(classes)} to {max(classes)}, {where}, got {fields[0]!r}; fix it."
        )
    boxed = len(shares) in (4, 4 + keypoints)
    if not boxed and (len(shares) < 6 or len(shares) % 2):
        remedy = "labels have no score" if len(shares) == 5 else "fix the line"
        raise DataError(
            f"expected a class and x y width height, or at least three corners x y, {where}, got {len(fields)} "
            f"numbers; {remedy}."
        )
    shares = shares[:4] if boxed else shares
    if not all(-1 <= share <= 2 for share in shares):
        raise DataError(
            f"expected shares of the image's sides, 0 to 1, {where}, got {' '.join(fields[1:])[:80]}; divide pixels "
            "by the width and height."
        )
    if boxed:
        x, y, width, height = shares
        left, top, right, bottom = x - width / 2, y - height / 2, x + width / 2, y + height / 2
    else:
        left, top, right, bottom = min(shares[::2]), min(shares[1::2]), max(shares[::2]), max(shares[1::2])
    if right <= left or bottom <= top:
        raise DataError(
            f"expected a width and height above 0 {where}, got {' '.join(fields[1:])[:80]}; fix or delete the line."
        )
    name, (height, width) = classes[int(number)], size
    return Annotation(name, left * width, top * height, right * width, bottom * height, where=where)
