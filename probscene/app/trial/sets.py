"""Labelled images that a trial trains or tests on: a folder of COCO, as ``generate`` and others write it, or of KITTI.

    FOLDER/annotations.json and FOLDER/images/, or the JSON file itself, with the images beside it or in images/
    FOLDER/image_2 and FOLDER/label_2

Axis letters: N objects, H W.
"""

import hashlib
import json
import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from probscene.decoding import read_rgb
from probscene.errors import DataError

from ..labelling.kitti import DONT_CARE, TYPES, Object, read_objects

Progress = Callable[[int, int], None]

SUFFIXES = (".png", ".jpg", ".jpeg")
EASY, MODERATE, HARD, BEYOND = range(4)
"""From which of KITTI's levels on an object counts; ``BEYOND``: from none. Objects of COCO are all ``EASY``."""
LEVELS = {EASY: (40.0, 0, 0.15), MODERATE: (25.0, 1, 0.30), HARD: (25.0, 2, 0.50)}
"""KITTI's levels: least height in pixels, most occluded, most truncated."""
ALIKE = {"Van": "Car", "Person_sitting": "Pedestrian"}
"""Whom KITTI's protocol does not count as the other, nor as a mistake."""


class Example(NamedTuple):
    """An image's file and what is in it.

    Attributes:
        boxes: ``(N, 4)`` float32, left top right bottom, pixels of the file.
        classes: ``(N,)`` int64, indices of the set's classes; -1 for a region where what is found counts neither way:
            crowds, KITTI's DontCare.
        levels: ``(N,)`` int64, of ``LEVELS``, or ``BEYOND``.
        real: ``(N,)`` bool: are objects of their class; else they are only like it, see ``ALIKE``, or regions.
        size: height and width.
        digest: of its pixels.
    """

    path: Path
    boxes: NDArray[np.float32]
    classes: NDArray[np.int64]
    levels: NDArray[np.int64]
    real: NDArray[np.bool_]
    size: tuple[int, int]
    digest: str


class LabelledSet(NamedTuple):
    """Images with labels.

    Attributes:
        path: where from.
        classes: their names, sorted.
        kitti: whether its labels have KITTI's levels.
    """

    path: Path
    classes: tuple[str, ...]
    examples: tuple[Example, ...]
    kitti: bool = False


def read_set(
    path: Path,
    classes: Iterable[str] | None = None,
    progress: Progress = lambda *_: None,
    same: bool = False,
) -> LabelledSet:
    """All of a set, its images decoded and its labels checked.

    Args:
        classes: those to keep; all that it has where None. KITTI's types count as classes of their names, whatever the
            case, or by ``labelling.kitti.TYPES``.
        same: a set of COCO must have no others.
        progress: called with the number of images read, and of all.

    Raises:
        DataError: no such set; labels that cannot be read, of unknown images or classes, or with boxes that are none or
            lie off their image; an image that is missing, cannot be decoded, or has another size than its labels say;
            a class that the set does not have.
    """
    if (path / "label_2").is_dir() and (path / "image_2").is_dir():
        return _read_kitti(path, None if classes is None else tuple(sorted(classes)), progress)
    file = path / "annotations.json" if path.is_dir() else path
    if not file.is_file():
        raise DataError(
            f"Expected labelled images in {path}: annotations.json (COCO) with its images, or KITTI's image_2 and "
            "label_2, actual neither; name the folder of a data set."
        )
    return _read_coco(path, file, None if classes is None else tuple(sorted(classes)), progress, same)


def read_image(path: Path) -> NDArray[np.uint8]:
    """Its pixels ``(H, W, 3)``, see ``decoding.read_rgb``.

    Raises:
        DataError: it is missing or cannot be decoded.
    """
    return read_rgb(path)


def digest_of(found: LabelledSet) -> str:
    """Of all that a set says, not where it lies."""
    made = hashlib.sha256(repr(found.classes).encode())
    for example in found.examples:
        made.update(example.digest.encode())
        for array in (example.boxes, example.classes, example.levels, example.real):
            made.update(array.tobytes())
    return made.hexdigest()


def _read_coco(path: Path, file: Path, wanted: tuple[str, ...] | None, progress: Progress, same: bool) -> LabelledSet:
    try:
        record = json.loads(file.read_text(encoding="utf-8-sig"))
        names = {category["id"]: category["name"] for category in record["categories"]}
        images = {image["id"]: image for image in record["images"]}
        files = [str(image["file_name"]) for image in record["images"]]
        of_image: dict[Any, list[dict[str, Any]]] = {key: [] for key in images}
        unknown = [a for a in record["annotations"] if a["image_id"] not in images or a["category_id"] not in names]
        for annotation in record["annotations"] if not unknown else ():
            of_image[annotation["image_id"]].append(annotation)
    except (OSError, ValueError, KeyError, TypeError) as error:
        about = f"no {error}" if isinstance(error, KeyError) else str(error)
        raise DataError(f"Expected COCO's images, annotations and categories in {file}, actual {about}.") from error
    _check_once(file, "image files", files)
    _check_once(file, "images", [f"id {image['id']}" for image in record["images"]])
    if unknown:
        one = unknown[0]
        raise DataError(
            f"Expected annotations of images and categories that {file} lists, actual annotation {one.get('id')} of "
            f"image {one['image_id']} and category {one['category_id']}."
        )
    _check_once(file, "categories", list(map(str, names.values())))
    if not images:
        raise DataError(f"Expected images in {file}, actual none.")
    classes = _kept(path, wanted, tuple(sorted(map(str, names.values()))), same)
    folder = next(
        (f for f in (file.parent / "images", file.parent) if (f / files[0]).is_file()), file.parent / "images"
    )
    examples = []
    for number, (key, image) in enumerate(images.items(), 1):
        kept = [a for a in of_image[key] if str(names[a["category_id"]]) in classes]
        boxes = np.array([_corners(a, file) for a in kept], np.float32).reshape(-1, 4)
        crowd = np.array([bool(a.get("iscrowd", 0)) for a in kept], bool)
        of_class = np.array([classes.index(str(names[a["category_id"]])) for a in kept], np.int64)
        said = (image.get("height"), image.get("width"))
        levels = np.zeros(len(kept), np.int64)
        where = folder / str(image["file_name"])
        examples.append(_example(where, boxes, np.where(crowd, -1, of_class), levels, ~crowd, said, file))
        progress(number, len(images))
    return LabelledSet(path, classes, tuple(examples))


def _corners(annotation: Mapping[str, Any], file: Path) -> list[float]:
    box: Any = annotation.get("bbox")
    try:
        x, y, w, h = map(float, box)
        if not (all(map(math.isfinite, (x, y, w, h))) and w > 0 and h > 0):
            raise ValueError
    except (TypeError, ValueError):
        raise DataError(
            f"Expected a bbox of x, y, width and height, the last two positive, in {file}, actual {box} in annotation "
            f"{annotation.get('id')}."
        ) from None
    return [x, y, x + w, y + h]


def _read_kitti(path: Path, wanted: tuple[str, ...] | None, progress: Progress) -> LabelledSet:
    images = sorted(file for file in (path / "image_2").iterdir() if file.suffix.lower() in SUFFIXES)
    if not images:
        raise DataError(f"Expected PNG or JPEG images in {path / 'image_2'}, actual none.")
    lines = {image: read_objects(path / "label_2" / f"{image.stem}.txt") for image in images}
    occurring = {one.type for each in lines.values() for one in each} - {DONT_CARE}
    classes = wanted or tuple(sorted({type.casefold() for type in occurring}))
    of_type = {type: _class_of(type, classes) for type in {*TYPES, *occurring}}
    _kept(path, wanted, tuple(sorted({name for name in of_type.values() if name})))
    examples = []
    for number, (image, objects) in enumerate(lines.items(), 1):
        found = [entry for one in objects for entry in _entries(one, of_type)]
        boxes = np.array([entry[0] for entry in found], np.float32).reshape(-1, 4)
        of_class = [-1 if name is None else classes.index(name) for _, name, _, _ in found]
        levels, real = ([entry[i] for entry in found] for i in (2, 3))
        where = path / "label_2" / f"{image.stem}.txt"
        arrays = np.array(of_class, np.int64), np.array(levels, np.int64), np.array(real, bool)
        examples.append(_example(image, boxes, *arrays, (None, None), where))
        progress(number, len(lines))
    return LabelledSet(path, classes, tuple(examples), kitti=True)


def _entries(one: Object, of_type: Mapping[str, str | None]) -> Iterable[tuple[list[float], str | None, int, bool]]:
    """What a line stands for: a box, its class, its level, and whether it is an object of that class."""
    box = [one.left, one.top, max(one.right, one.left + 1e-3), max(one.bottom, one.top + 1e-3)]
    if one.type == DONT_CARE:
        yield box, None, BEYOND, False
        return
    own, like = of_type[one.type], of_type.get(ALIKE.get(one.type, ""))
    if own is not None and own != like:
        yield box, own, level(one), True
    if like is not None:
        yield box, like, BEYOND, False


def level(one: Object) -> int:
    """The first of KITTI's levels that an object belongs to."""
    high = one.bottom - one.top
    for number, (least, occluded, truncated) in LEVELS.items():
        if high >= least and one.occluded <= occluded and one.truncated <= truncated:
            return number
    return BEYOND


def _class_of(type: str, classes: tuple[str, ...]) -> str | None:
    own = {name.casefold(): name for name in classes}
    return next((own[name] for name in (type.casefold(), *TYPES.get(type, ())) if name in own), None)


def _kept(path: Path, wanted: tuple[str, ...] | None, there: tuple[str, ...], same: bool = False) -> tuple[str, ...]:
    """The classes that are wanted of those there are."""
    more = sorted(set(there) - set(wanted or there)) if same else []
    lacking = [] if wanted is None else sorted(set(wanted) - set(there))
    if lacking:
        near = {name.casefold(): name for name in there}
        hints = [f"{near[name.casefold()]!r} differs in case" for name in lacking if name.casefold() in near]
        raise DataError(
            f"Expected the classes {', '.join(wanted or ())} in {path}, actual {', '.join(there) or 'none'}"
            f"{' (' + '; '.join(hints) + ')' if hints else ''}; rename {', '.join(lacking)} there, or name the classes "
            "that all sets have by --classes."
        )
    if more:
        raise DataError(
            f"Expected the classes {', '.join(wanted or ())} in {path}, actual {', '.join(more)}, too; name the "
            "classes that all sets have by --classes."
        )
    return there if wanted is None else wanted


def _check_once(file: Path, what: str, names: list[str]) -> None:
    twice = [name for name, number in Counter(names).items() if number > 1]
    if twice:
        raise DataError(f"Expected {what} with a name each in {file}, actual {twice[0]!r} more than once.")


def _example(
    path: Path,
    boxes: NDArray[np.float32],
    classes: NDArray[np.int64],
    levels: NDArray[np.int64],
    real: NDArray[np.bool_],
    said: tuple[Any, Any],
    labels: Path,
) -> Example:
    """An example whose image is decoded and whose boxes are on it, and cut to it."""
    pixels = read_image(path)
    height, width = pixels.shape[:2]
    if None not in said and said != (height, width):
        raise DataError(
            f"Expected {path} as large as {labels} says, {said[1]}x{said[0]}, actual {width}x{height}; give the labels "
            "of these images."
        )
    cut = np.clip(boxes, 0, np.array([width, height, width, height], np.float32))
    off = np.flatnonzero(((cut[:, 2] <= cut[:, 0]) | (cut[:, 3] <= cut[:, 1])) & real)
    if len(off):
        x0, y0, x1, y1 = boxes[off[0]]
        raise DataError(
            f"Expected boxes on the image {path} of {width}x{height}, actual one from {x0:g}, {y0:g} to {x1:g}, "
            f"{y1:g} in {labels}; mend it."
        )
    digest = hashlib.sha256(f"{height}x{width}".encode() + pixels.tobytes()).hexdigest()
    return Example(path, cut, classes, levels, real, (height, width), digest)
