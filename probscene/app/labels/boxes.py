"""Boxes of a target's images, from whatever format, where the model's canvas has them. Axis letters: K images, C
classes, n boxes of one image.
"""

from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from probscene.dataset import Images
from probscene.errors import DataError
from probscene.model import SceneModel

from .annotations import Annotation
from .kitti import DONT_CARE, TYPES, class_of
from .naming import labelled_classes, match_target
from .reading import read_annotations

MAX_NAMED_IMAGES = 5  # images in a note


class Boxes(NamedTuple):
    """The boxes of K of a target's images.

    Attributes:
        rows: the K numbers of the images, ascending.
        boxes: of each image ``(n, 5)`` float32: the number of its class in ``classes``, then x0, y0, x1, y1 in pixels
            of the canvas, clipped to it.
        classes: the C that are labelled, in the model's order.
        notes: what a person should know, one sentence each.
        scores: of detections, of each image ``(n,)`` float32; None of labels.
    """

    rows: list[int]
    boxes: tuple[Tensor, ...]
    classes: tuple[str, ...]
    notes: tuple[str, ...] = ()
    scores: tuple[Tensor, ...] | None = None

    def some(self, most: int) -> "Boxes":
        """Those of at most so many of the images, evenly spread."""
        at = np.linspace(0, len(self.rows) - 1, min(len(self.rows), most)).round().astype(int).tolist()
        scores = None if self.scores is None else tuple(self.scores[i] for i in at)
        return self._replace(rows=[self.rows[i] for i in at], boxes=tuple(self.boxes[i] for i in at), scores=scores)

    @property
    def counts(self) -> NDArray[np.int64]:
        """``(K, C)``."""
        each = [torch.bincount(found[:, 0].long(), minlength=len(self.classes)) for found in self.boxes]
        return torch.stack(each).numpy() if each else np.zeros((0, len(self.classes)), np.int64)


def read_boxes(
    path: Path, model: SceneModel, target: Images, allow_missing: bool = False, min_height: float = 0.0
) -> Boxes:
    """The boxes of a target's images, see ``read_annotations``. Labels of files that the target left out as bad, or
    that it has not, are not read.

    An image with a crowd of a labelled class has no known counts: it is taken as not labelled, which a note says. So
    the notes say which names are of no class, which of KITTI's types count as something of another name, and how many
    images have regions in which nothing is labelled. Labelled are the classes that the format names; of KITTI those
    that one of its own types counts as, and those that occur.

    Args:
        allow_missing: there need not be labels of every image; those without are left out.
        min_height: of a box that is kept, pixels of its file.

    Raises:
        DataError: see ``read_annotations``, ``match_target``, ``labelled_classes`` and ``on_canvas``.
    """
    path = Path(path)
    labels = read_annotations(path)
    classes, notes = dict[str, str](), tuple[str, ...]()
    if not labels.kitti:
        expected = f"categories among the classes of model {model.name!r} ({', '.join(model.classes)})"
        classes, notes = labelled_classes(labels.classes, model.classes, expected, path)
    found = match_target(path, labels.images, target, allow_missing, labels.stems)
    read = {i: labels.read(entry, target.sizes[i]) for i, entry in found.entries.items()}
    if labels.kitti:
        classes, notes = _classes_of_types(read.values(), model, path)
        notes += _regions(read.values(), min_height)
    crowded = [i for i, each in read.items() if any(one.crowd and one.name in classes for one in each)]
    if crowded:
        names = ", ".join(sorted(target.paths[i].name for i in crowded)[:MAX_NAMED_IMAGES])
        notes += (
            f"{len(crowded)} images are taken as not labelled, since a crowd (iscrowd) says not how many it has: "
            f"{names}{' ...' if len(crowded) > MAX_NAMED_IMAGES else ''}.",
        )
    boxes = {
        i: [one._replace(name=classes[one.name]) for one in each if one.name in classes]
        for i, each in read.items()
        if i not in crowded
    }
    if not boxes:
        raise DataError(f"expected labelled images of {target.path} in {path}, got crowds alone; label each object.")
    labelled = tuple(name for name in model.classes if name in classes.values())
    return on_canvas(target, boxes, labelled, (*found.notes, *notes), min_height, 1.0 if labels.kitti else 0.0)


def on_canvas(
    target: Images,
    found: Mapping[int, Sequence[Annotation]],
    classes: tuple[str, ...],
    notes: tuple[str, ...],
    min_height: float = 0.0,
    end: float = 0.0,
) -> Boxes:
    """Boxes of files' pixels, moved as the images are when they are read.

    What sticks out of its image is clipped. What has its middle where the image is cut is left out, which a note says.

    Args:
        found: by the numbers of the K images, their objects.
        min_height: of a box that is kept, pixels of its file.
        end: from the right and bottom of boxes to their outer edges: 1 where pixels have numbers, and the last one is
            part of the box.

    Raises:
        DataError: a box entirely beside its image.
    """
    small, cut, boxes, scores = 0, 0, [], []
    for row, each in found.items():
        kept, own = [], []
        for box in each:
            at = place_on_canvas(box, target, row, end)
            if at is None:
                cut += 1
            elif round(box.bottom - box.top, 6) < min_height:
                small += 1
            else:
                kept.append([classes.index(box.name), *at])
                own.append(box.score)
        scores.append(own)
        boxes.append(torch.tensor(kept, dtype=torch.float32).reshape(-1, 5))
    if cut:
        notes += (f"{cut} objects that lie where images are cut are not counted.",)
    if small:
        notes += (f"{small} objects of less than {min_height:g} pixels' height are not counted.",)
    of_detections = bool(found) and all(score is not None for own in scores for score in own)
    scored = tuple(torch.tensor(own, dtype=torch.float32) for own in scores) if of_detections else None
    return Boxes(list(found), tuple(boxes), classes, notes, scored)


def place_on_canvas(
    one: Annotation, target: Images, row: int, end: float = 0.0
) -> tuple[float, float, float, float] | None:
    """x0, y0, x1, y1 of a box of image number ``row``, pixels of the canvas, clipped to it; None where its middle lies
    where the image is cut.

    Args:
        end: see ``on_canvas``.

    Raises:
        DataError: it lies entirely beside its image.
    """
    size, seen, (H, W) = target.sizes[row], target.windows[row], target.canvas
    top, left, height, width = (0, 0, *size) if seen is None else seen
    right, bottom = one.right + end, one.bottom + end
    if not (one.left < size[1] and right > 0 and one.top < size[0] and bottom > 0):
        raise DataError(
            f"expected boxes on the image of {size[1]}x{size[0]} {one.where}, got {one.name} from "
            f"{one.left:g}, {one.top:g} to {right:g}, {bottom:g}; give the labels of these images, not of "
            "images of another size."
        )
    x0, x1 = (min(max(x, 0), size[1]) - left for x in (one.left, right))
    y0, y1 = (min(max(y, 0), size[0]) - top for y in (one.top, bottom))
    if seen is not None and not (0 <= (x0 + x1) / 2 < width and 0 <= (y0 + y1) / 2 < height):
        return None
    x0, x1 = (min(max(x, 0), width) * W / width for x in (x0, x1))
    y0, y1 = (min(max(y, 0), height) * H / height for y in (y0, y1))
    return x0, y0, x1, y1


def _classes_of_types(
    found: Iterable[list[Annotation]], model: SceneModel, folder: Path
) -> tuple[dict[str, str], tuple[str, ...]]:
    """By KITTI's type the class of the model that it counts as, and notes on which count as something of another name,
    and which not at all."""
    occurring = Counter(one.name for each in found for one in each if one.name != DONT_CARE)
    of_type = {name: class_of(name, model.classes) for name in (*TYPES, *occurring)}
    classes = {name: own for name, own in of_type.items() if own is not None}
    if not classes:
        raise DataError(
            f"expected types in {folder} that model {model.name!r} has classes for ({', '.join(model.classes)}), "
            f"got {', '.join(occurring) or 'no object'}."
        )
    renamed = [f"{name} as {own}" for name in occurring if (own := of_type[name]) and own.casefold() != name.casefold()]
    out = [f"{number} {name}" for name, number in occurring.most_common() if of_type[name] is None]
    notes = (f"Counted are {', '.join(sorted(renamed))}.",) if renamed else ()
    return classes, notes + ((f"Not counted, since the model has no such class: {', '.join(out)}.",) if out else ())


def _regions(found: Collection[list[Annotation]], min_height: float) -> tuple[str, ...]:
    """How many images have a region without labels that could hold an object which counts."""
    each = [[one.bottom - one.top for one in objects if one.name == DONT_CARE] for objects in found]
    marked = sum(max(heights, default=-1.0) >= min_height for heights in each)
    high = f" that are at least {min_height:g} pixels high" if min_height else ""
    note = (
        f"{marked} of {len(each)} images have regions marked {DONT_CARE}{high}; objects there are not labelled, so "
        "that these images may show more than their labels say."
    )
    return (note,) if marked else ()
