"""Labelled images that a trial trains or tests on: of COCO, as ``generate`` and others write it, of KITTI or of YOLO.

    FOLDER/annotations.json and FOLDER/images/, or the JSON file itself, with the images beside it or in images/
    FOLDER/image_2 and FOLDER/label_2
    FOLDER/data.yaml, FOLDER/images/ and FOLDER/labels/

Axis letters: N objects, H W.
"""

import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from probscene.dataset import is_image, listed
from probscene.decoding import quiet, read, stored
from probscene.errors import DataError
from probscene.image_bytes import Fault

from ..labels.annotations import Annotated, Annotation
from ..labels.kitti import DONT_CARE, TYPES, class_of
from ..labels.naming import composed, matched
from ..labels.reading import read_annotations
from ..labels.yolo import images_beside

Progress = Callable[[int, int], None]

EASY, MODERATE, HARD, BEYOND = range(4)
"""From which of KITTI's levels on an object counts; ``BEYOND``: from none. Objects of COCO are all ``EASY``."""
LEVELS = {EASY: (40.0, 0, 0.15), MODERATE: (25.0, 1, 0.30), HARD: (25.0, 2, 0.50)}
"""KITTI's levels: least height in pixels, most occluded, most truncated."""
ALIKE = {"Van": "Car", "Person_sitting": "Pedestrian"}
"""Whom KITTI's protocol does not count as the other, nor as a mistake."""
MAX_NAMED_IMAGES = 5  # images in a message


class Example(NamedTuple):
    """An image's file and what is in it.

    Attributes:
        boxes: ``(N, 4)`` float32, left top right bottom, pixels of the file.
        classes: ``(N,)`` int64, indices of the set's classes; -1 for a region where what is found counts neither way:
            crowds, KITTI's DontCare.
        levels: ``(N,)`` int64, of ``LEVELS``, or ``BEYOND``.
        real: ``(N,)`` bool: are objects of their class; else they are only like it, see ``ALIKE``, or regions.
        size: height and width.
        digest: of its pixels as they are stored, upright and in RGB.
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
        notes: what a person should know, one sentence each.
    """

    path: Path
    classes: tuple[str, ...]
    examples: tuple[Example, ...]
    kitti: bool = False
    notes: tuple[str, ...] = ()


def read_set(
    path: Path,
    classes: Iterable[str] | None = None,
    progress: Progress = lambda *_: None,
    same: bool = False,
    photographs: Path | None = None,
) -> LabelledSet:
    """All of a set, its images decoded and its labels checked. Labels of images that are not there are not read, which
    a note says.

    Args:
        classes: those to keep; all that it has where None. KITTI's types count as classes of their names, whatever the
            case, or by ``labels.kitti.TYPES``.
        same: a set of COCO or YOLO must have no others.
        progress: called with the number of images read, and of all.
        photographs: the folder of the images, of which only some may be labelled; where None, they lie where the format
            has them.

    Raises:
        DataError: no such set; labels that cannot be read, of unknown classes, or with boxes that are none or lie off
            their image; no image, or one that cannot be decoded, or has no label file or another size than its labels
            say; a class that the set does not have.
    """
    wanted = None if classes is None else tuple(sorted(map(composed, classes)))
    labels = read_annotations(path)
    files = _images(labels) if photographs is None else listed(photographs)[0]
    if not labels.images or not files:
        actual = f"no image such as {labels.images[0].name}" if labels.images else "none of them"
        raise DataError(
            f"expected labelled images in {path}: annotations.json (COCO) with its images, KITTI's image_2 and "
            f"label_2, or YOLO's data.yaml, images and labels, got {actual}; name the folder of a data set."
        )
    found = matched(labels.images, files, files[0].parent, stems=labels.stems)
    lacking = [file for i, file in enumerate(files) if i not in found.entries] if labels.stems else []
    if lacking and photographs is None:
        raise DataError(
            f"expected a label file for each image in {labels.path}, got none of {lacking[0]}; write an empty one "
            "where it shows nothing, or take it out."
        )
    if not found.entries:
        raise DataError(
            f"expected labels of images in {files[0].parent}, got {path} with none of them, but of "
            f"{labels.images[0].name}; name the folder of its images."
        )
    # In the order of COCO's list, and in that of the files of others.
    order = list(found.entries) if labels.stems else sorted(found.entries, key=lambda i: found.entries[i])
    if labels.kitti:
        occurring = {one.name for i in order for one in labels.read(found.entries[i], (0, 0))} - {DONT_CARE}
        named = wanted or tuple(sorted({type.casefold() for type in occurring}))
        of_name = {type: class_of(type, named) for type in {*TYPES, *occurring}}
        there = tuple(sorted({name for name in of_name.values() if name}))
    else:
        there = tuple(sorted(map(composed, labels.classes)))
        of_name = {name: composed(name) for name in labels.classes if composed(name) in (wanted or there)}
    kept = _kept(path, wanted, there, same and not labels.kitti)
    examples, bad = list[Example](), list[str]()
    for number, i in enumerate(order, 1):
        try:
            with quiet():
                pixels, size = stored(read(files[i]))
        except Fault as fault:
            bad.append(f"{files[i].name} {fault}")
            continue
        entries = [
            entry for one in labels.read(found.entries[i], size) for entry in _entries(one, of_name, labels.kitti)
        ]
        examples.append(_example(files[i], pixels, entries, kept))
        progress(number, len(order))
    if bad:
        more = f" and {len(bad) - MAX_NAMED_IMAGES} more" if len(bad) > MAX_NAMED_IMAGES else ""
        raise DataError(
            f"expected images that decode in {path}, got {len(bad)} of {len(order)} bad: "
            f"{', '.join(bad[:MAX_NAMED_IMAGES])}{more}; fix or delete them."
        )
    return LabelledSet(path, kept, tuple(examples), labels.kitti, found.notes)


def digest_of(found: LabelledSet) -> str:
    """Of all that a set says, not where it lies."""
    made = hashlib.sha256(repr(found.classes).encode())
    for example in found.examples:
        made.update(example.digest.encode())
        for array in (example.boxes, example.classes, example.levels, example.real):
            made.update(array.tobytes())
    return made.hexdigest()


def digest_of_pixels(pixels: NDArray) -> str:
    """Of ``(H, W)`` or ``(H, W, 3)`` as ``decoding.stored`` gives them, grey the same as in RGB."""
    height, width = pixels.shape[:2]
    pixels = np.dstack([pixels] * 3) if pixels.ndim == 2 else pixels
    return hashlib.sha256(f"{height}x{width}".encode() + pixels.tobytes()).hexdigest()


class _Object(NamedTuple):
    """What an annotation stands for; its class is None for a region, see ``Example``."""

    one: Annotation
    name: str | None
    level: int
    real: bool


def _images(labels: Annotated) -> list[Path]:
    """The image files that labels may be of."""
    if labels.kitti:
        return _pictures([labels.path.parent / "image_2"])
    if labels.stems:
        return _pictures(images_beside(labels))
    names = [one.name.replace("\\", "/") for one in labels.images]
    for root in (labels.path.parent / "images", labels.path.parent):
        folders = sorted({(root / name).parent for name in names} | {root})
        files = [file for folder in folders if folder.is_dir() for file in sorted(folder.iterdir()) if file.is_file()]
        if matched(labels.images, files, root).entries:
            return files
    return []


def _pictures(folders: Sequence[Path]) -> list[Path]:
    """The image files of folders; hidden ones are none."""
    return [file for folder in folders if folder.is_dir() for file in sorted(folder.iterdir()) if is_image(file)]


def _entries(one: Annotation, of_name: Mapping[str, str | None], kitti: bool) -> Iterable[_Object]:
    """What an annotation stands for: of KITTI as its protocol has it."""
    if not kitti:
        if one.name in of_name:
            yield _Object(one, None if one.crowd else one.name, EASY, not one.crowd)
        return
    one = one._replace(right=max(one.right, one.left + 1e-3), bottom=max(one.bottom, one.top + 1e-3))
    if one.name == DONT_CARE:
        yield _Object(one, None, BEYOND, False)
        return
    own, like = of_name[one.name], of_name.get(ALIKE.get(one.name, ""))
    if own is not None and own != like:
        yield _Object(one, own, level(one), True)
    if like is not None:
        yield _Object(one, like, BEYOND, False)


def level(one: Annotation) -> int:
    """The first of KITTI's levels that an object belongs to."""
    high = one.bottom - one.top
    for number, (least, occluded, truncated) in LEVELS.items():
        if high >= least and one.occluded <= occluded and one.truncated <= truncated:
            return number
    return BEYOND


def _kept(path: Path, wanted: tuple[str, ...] | None, there: tuple[str, ...], same: bool = False) -> tuple[str, ...]:
    """The classes that are wanted of those there are."""
    more = sorted(set(there) - set(wanted or there)) if same else []
    lacking = [] if wanted is None else sorted(set(wanted) - set(there))
    if lacking:
        near = {name.casefold(): name for name in there}
        hints = [f"{near[name.casefold()]!r} differs in case" for name in lacking if name.casefold() in near]
        raise DataError(
            f"expected the classes {', '.join(wanted or ())} in {path}, got {', '.join(there) or 'none'}"
            f"{' (' + '; '.join(hints) + ')' if hints else ''}; rename {', '.join(lacking)} there, or name the classes "
            "that all sets have by --classes."
        )
    if more:
        raise DataError(
            f"expected the classes {', '.join(wanted or ())} in {path}, got {', '.join(more)}, too; name the "
            "classes that all sets have by --classes."
        )
    return there if wanted is None else wanted


def _example(path: Path, pixels: NDArray, objects: list[_Object], classes: tuple[str, ...]) -> Example:
    """An example whose boxes are on its image, and cut to it; ``pixels`` are those of ``decoding.stored``."""
    height, width = pixels.shape[:2]
    sides = [[one.left, one.top, one.right, one.bottom] for one, *_ in objects]
    boxes = np.array(sides, np.float32).reshape(-1, 4)
    cut = np.clip(boxes, 0, np.array([width, height, width, height], np.float32))
    real = np.array([each.real for each in objects], bool)
    off = np.flatnonzero(((cut[:, 2] <= cut[:, 0]) | (cut[:, 3] <= cut[:, 1])) & real)
    if len(off):
        (x0, y0, x1, y1), one = boxes[off[0]], objects[off[0]].one
        raise DataError(
            f"expected boxes on the image {path} of {width}x{height} {one.where}, got {one.name} from {x0:g}, "
            f"{y0:g} to {x1:g}, {y1:g}; fix it."
        )
    of_class = np.array([-1 if name is None else classes.index(name) for _, name, *_ in objects], np.int64)
    levels = np.array([each.level for each in objects], np.int64)
    return Example(path, cut, of_class, levels, real, (height, width), digest_of_pixels(pixels))
