"""COCO's JSON: ``images``, ``annotations`` with a ``bbox``, ``categories`` by name; other keys are not read.

An image that is listed and has no annotation shows nothing; one that is not listed is not labelled. A crowd
(``iscrowd``) is one annotation of an unknown number of objects. Annotations that are marked ``ignore`` or ``difficult``
are counted as all others. Where there is no ``bbox``, it is that of the ``segmentation``, polygons or run lengths.
Numbers may be written as text, ids as 1.0 for 1; a width or height of 0 is an unknown one.
"""

import json
import math
from collections import defaultdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probscene.errors import DataError

from .annotations import Annotated, Annotation, Size
from .naming import Entry
from .text import number_of, text_of

LISTS = ("images", "annotations", "categories")


def read_coco(path: Path) -> Annotated:
    """What a file says.

    Raises:
        DataError: no such file or no COCO; an image or category without a name, or with an id or a name that another
            one has; an annotation of no image or category. The first is named.
    """
    whole = _whole(path)
    categories = _by_id(path, "categories", whole["categories"], "name")
    twice = [name for name in categories.values() if list(categories.values()).count(name) > 1]
    if twice:
        raise DataError(f"expected categories with a name each in {path}, got {twice[0]!r} more than once.")
    names = _by_id(path, "images", whole["images"], "file_name")
    of_image: dict[str, list[tuple[str, str, dict[str, Any]]]] = defaultdict(list)
    for i, entry in enumerate(whole["annotations"]):
        where = _place(path, "annotations", i)
        image, category = _known(entry, "image_id", names, where), _known(entry, "category_id", categories, where)
        of_image[image].append((categories[category], where, entry))
    keys, images = list(names), [Entry(name, _place(path, "images", i)) for i, name in enumerate(names.values())]

    def read(i: int, size: Size) -> list[Annotation]:
        value = tuple(number_of(whole["images"][i].get(side)) for side in ("height", "width"))
        if all(side > 0 for side in value) and value != size:
            raise DataError(
                f"expected {images[i].name} to be {value[1]:.9g}x{value[0]:.9g} as {images[i].where}, got "
                f"{size[1]}x{size[0]}; give labels of these images, not of images of another size."
            )
        return [_annotation(*each, size) for each in of_image[keys[i]]]

    return Annotated(path, (path,), images, read, tuple(categories.values()))


def _whole(path: Path) -> dict[str, list[Any]]:
    try:
        read = json.loads(text_of(path))
    except (ValueError, RecursionError) as error:
        raise DataError(f"expected COCO's JSON in {path}, got something else ({error}).") from error
    if isinstance(read, list) and read:
        return _of_results(path, read)
    whole: dict[str, Any] = read if isinstance(read, dict) else {}
    missing = [key for key in LISTS if not isinstance(whole.get(key), list)]
    if missing:
        raise DataError(
            f"expected COCO's JSON with lists of {', '.join(LISTS)} in {path}, got none of {', '.join(missing)}."
        )
    return whole


def _of_results(path: Path, results: list[Any]) -> dict[str, list[Any]]:
    """COCO's results, a list of detections, whose images and categories are called by their names."""
    found: dict[str, list[Any]] = {"annotations": results}
    for key, of, named in (("images", "image_id", "file_name"), ("categories", "category_id", "name")):
        names = [entry.get(of) if isinstance(entry, dict) else None for entry in results]
        if not all(isinstance(name, str) for name in names):
            raise DataError(
                f"expected lists of images and categories beside the detections in {path}, or the names of files and "
                f"classes as image_id and category_id, got a list with {of} "
                f"{json.dumps(next(name for name in names if not isinstance(name, str)))}; write "
                '{"images": [...], "categories": [...], "annotations": [the detections]}.'
            )
        found[key] = [{"id": name, named: name} for name in dict.fromkeys(names)]
    return found


def _by_id(path: Path, key: str, entries: list[Any], named: str) -> dict[str, str]:
    """The names of images or categories by their ids, in the order of the file."""
    names: dict[str, str] = {}
    for i, entry in enumerate(entries):
        where = _place(path, key, i)
        value = entry.get("id") if isinstance(entry, dict) else None
        number, name = _id(value), entry.get(named) if isinstance(entry, dict) else None
        if number is None or number in names:
            raise DataError(f"expected an id that no other entry has {where}, got {json.dumps(value)}; fix the entry.")
        if isinstance(name, bool) or not isinstance(name, str | int) or name == "":
            raise DataError(f"expected a {named} {where}, got {json.dumps(name)}; fix the entry.")
        names[number] = str(name)
    return names


def _place(path: Path, key: str, i: int) -> str:
    return f"in {key}[{i}] of {path}"


def _id(value: Any) -> str | None:
    """An id as text: 1 for 1, 1.0, "1" and "1.0"; None for what is none."""
    if isinstance(value, str):
        return value.strip().removesuffix(".0") or None
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return None
    return str(int(value)) if value == int(value) else str(value)


def _known(entry: Any, key: str, known: dict[str, str], where: str) -> str:
    value = entry.get(key) if isinstance(entry, dict) else None
    found = _id(value)
    if found is None or found not in known:
        raise DataError(f"expected {key} to be an id that is listed {where}, got {json.dumps(value)}; fix it.")
    return found


def _annotation(name: str, where: str, entry: dict[str, Any], size: Size) -> Annotation:
    value = entry.get("bbox")
    box = _numbers(value, 4)
    if (value is None or value == [] or box == [0, 0, 0, 0]) and (shape := entry.get("segmentation")):
        box = around(shape, where)
        height, width = map(number_of, shape["size"]) if isinstance(shape, dict) else size
        if (height, width) != size:
            raise DataError(
                f"expected a mask of {size[1]}x{size[0]} {where}, as its image is, got {width:.9g}x{height:.9g}; "
                "fix or delete it."
            )
    if box is None or min(box[2:]) <= 0:
        raise DataError(
            f"expected bbox: x, y, and a width and height above 0 {where}, got {json.dumps(value)}; fix or delete it."
        )
    x, y, width, height = box
    crowd = number_of(entry.get("iscrowd")) > 0 or entry.get("iscrowd") is True
    mask = partial(_mask, shape, size, where) if (shape := entry.get("segmentation")) else None
    score = entry.get("score")
    if score is not None and not 0 <= number_of(score) <= 1:
        raise DataError(f"expected a score from 0 to 1 {where}, got {json.dumps(score)}; fix or delete it.")
    score = None if score is None else number_of(score)
    return Annotation(name, x, y, x + width, y + height, crowd=crowd, where=where, score=score, mask=mask)


def _mask(segmentation: Any, size: Size, where: str) -> NDArray[np.bool_]:
    """``(H, W)`` of polygons or run lengths."""
    from faster_coco_eval.core import mask as coder

    around(segmentation, where)
    if isinstance(segmentation, dict):
        if tuple(map(number_of, segmentation["size"])) != size:
            raise DataError(
                f"expected a mask of {size[1]}x{size[0]} {where}, as its image is, got one of "
                f"{segmentation['size'][1]}x{segmentation['size'][0]}; fix or delete it."
            )
    elif not isinstance(segmentation[0], list):
        segmentation = [segmentation]
    coded = coder.frPyObjects(segmentation, *size) if not _is_packed(segmentation) else segmentation
    return coder.decode(coder.merge(coded) if isinstance(coded, list) else coded).astype(bool)


def _is_packed(segmentation: Any) -> bool:
    return isinstance(segmentation, dict) and isinstance(segmentation["counts"], str)


def around(segmentation: Any, where: str) -> list[float]:
    """The x, y, width and height of polygons or of a mask of run lengths.

    Raises:
        DataError: it is neither.
    """
    if isinstance(segmentation, dict):
        return _around_runs(segmentation, where)
    parts = segmentation if isinstance(segmentation, list) and isinstance(segmentation[0], list) else [segmentation]
    corners = [_numbers(part) for part in parts]
    if any(part is None or len(part) < 6 or len(part) % 2 for part in corners):
        raise DataError(
            f"expected polygons of at least three corners x, y {where}, got {json.dumps(segmentation)[:80]}; fix "
            "or delete it."
        )
    x, y = ([value for part in corners if part for value in part[axis::2]] for axis in (0, 1))
    return [min(x), min(y), max(x) - min(x), max(y) - min(y)]


def _around_runs(coded: dict[str, Any], where: str) -> list[float]:
    """The same of a mask; pycocotools ends the process where one is broken."""
    counts, size = coded.get("counts"), _numbers(coded.get("size"), 2)
    runs = _decoded(counts) if isinstance(counts, str) else _numbers(counts)
    if not runs or size is None or min(runs) < 0 or sum(runs) != size[0] * size[1]:
        raise DataError(
            f"expected a mask with size and counts that add up to it {where}, got {json.dumps(coded)[:80]}; fix or "
            "delete it."
        )
    ends = np.cumsum(runs).astype(np.int64)
    first, last = ends[:-1:2], ends[1::2] - 1  # pixels of each run that is not empty, down one column after the other
    first, last = first[last >= first], last[last >= first]
    if not len(first):
        return [0, 0, 0, 0]
    height = int(size[0])
    left, right = first // height, last // height
    top, bottom = np.where(left == right, [first % height, last % height], [[0], [height - 1]])
    x, y = int(left.min()), int(top.min())
    return [x, y, int(right.max()) + 1 - x, int(bottom.max()) + 1 - y]


def _decoded(text: str) -> list[float] | None:
    """The run lengths that COCO packs in text, five bits a character, as what they are more than the last but one."""
    runs, value, shift = list[float](), 0, 0
    for letter in text:
        bits = ord(letter) - 48
        if not 0 <= bits < 64:
            return None
        value |= (bits & 31) << shift
        shift += 5
        if not bits & 32:
            value -= (bits & 16) << shift - 4
            runs.append(value + runs[-2] if len(runs) > 2 else value)
            value, shift = 0, 0
    return None if shift else runs


def _numbers(value: Any, number: int | None = None) -> list[float] | None:
    """A list of numbers of pixels; None for all else."""
    if not isinstance(value, list) or (number is not None and len(value) != number):
        return None
    found = [number_of(each) for each in value]
    return found if all(abs(each) < 1e9 for each in found) else None
