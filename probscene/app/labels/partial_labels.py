"""Labels of some of a target's images, by which a fit reads counts in the others.

Axis letters: K labelled images, C classes, n boxes of one image, H W of the canvas.
"""

import hashlib
import json
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from probscene.dataset import Images
from probscene.errors import DataError
from probscene.inference.features.base import Detections, Labelled
from probscene.model import SceneModel

from .boxes import Boxes, read_boxes
from .counts import read_table
from .reading import has_boxes, label_files

MIN_LABELLED_IMAGES = 3  # one can be left out, and two are left to choose by


class PartialLabels(NamedTuple):
    """Labels of K of a target's images.

    Attributes:
        rows: ``(K,)`` int64, which of the target's images are labelled, in the order of its files.
        counts: ``(K, C)`` int64 objects of each labelled class.
        classes: the C that are labelled, in the model's order.
        boxes: of each image ``(n, 5)`` float32: the number of its class in ``classes``, then x0, y0, x1, y1 in pixels
            of the canvas; None where only counts are known.
        notes: what a person should know, one sentence each.
    """

    rows: Tensor
    counts: Tensor
    classes: tuple[str, ...]
    boxes: tuple[Tensor, ...] | None
    notes: tuple[str, ...]

    @property
    def as_boxes(self) -> Boxes | None:
        """The boxes, where they are known."""
        return None if self.boxes is None else Boxes(self.rows.tolist(), self.boxes, self.classes)


def read_partial_labels(
    path: Path, model: SceneModel, target: Images, min_images: int = MIN_LABELLED_IMAGES
) -> PartialLabels:
    """The labels of some of a target's images: with boxes, see ``read_annotations``, else a CSV of counts.

    Args:
        min_images: images that must be labelled.

    Raises:
        DataError: see ``read_boxes`` and ``read_table``; whole structures (``.jsonl``); fewer than
            ``min_images`` images are labelled.
    """
    path, boxes, notes = Path(path), None, ()
    if path.suffix == ".jsonl":
        raise DataError(
            f"expected labels that people give (a CSV of counts, COCO's JSON, a folder of KITTI's or YOLO's), got "
            f"{path} of whole structures; give those to 'probscene evaluate'."
        )
    if has_boxes(path):
        read = read_boxes(path, model, target, True)
        boxes = read.boxes
    else:
        read = read_table(path, model.classes, target, True)
        cut = sum(target.windows[row] is not None for row in read.rows)
        if cut:
            notes = (
                f"Of {cut} labelled images only the middle is seen, and counts may be of the whole; count in the "
                "middle alone, or give boxes.",
            )
    if len(read.rows) < min_images:
        short = len(target) < min_images
        raise DataError(
            f"expected labels of at least {min_images} images of {target.path} in {path}, got {len(read.rows)}; "
            f"{'add images' if short else 'label more (probscene label says which)'}."
        )
    counts = torch.from_numpy(read.counts)
    never = [name for name, some in zip(read.classes, counts.any(0).tolist(), strict=True) if not some]
    if never:
        notes += (f"No labelled image has any {', nor any '.join(never)}, which cannot be calibrated by them.",)
    return PartialLabels(torch.tensor(read.rows), counts, read.classes, boxes, (*read.notes, *notes))


class PartlyLabelledImages:
    """A target's images of which some are labelled: what a feature network looks at before it is used.

    Args:
        detections: in all of them, by somebody's detector.
    """

    def __init__(self, images: Images, labels: PartialLabels | None, detections: Detections | None = None):
        self.images, self.labels, self.fingerprint = images, labels, images.fingerprint
        self.detections = detections

    def subset(self, max_images: int) -> Tensor:
        """At most so many of them, evenly spread, ``(L, C, H, W)`` uint8."""
        return self.images.subset(max_images)

    @property
    def labelled(self) -> Labelled | None:
        """Those that are labelled, with their counts; None where none is."""
        if self.labels is None:
            return None
        pictures = torch.stack([self.images.load(row) for row in self.labels.rows.tolist()])
        return Labelled(pictures, *self.labels[1:3], self.labels.rows, self.labels.boxes)


def labels_record(path: Path) -> dict[str, Any]:
    """What a run records of its labels: where they are, and SHA-256 of what they say, hexadecimal.

    Raises:
        DataError: they are not there.
    """
    path = Path(path).resolve()
    try:
        digest = _digest(path)
    except OSError as error:
        raise DataError(f"expected a file of labels at {path}, got none: {error.strerror}.") from error
    return {"path": str(path), "sha256": digest}


def _digest(path: Path) -> str:
    if not path.is_dir() and label_files(path) == (path,):
        return hashlib.sha256(path.read_bytes()).hexdigest()
    files = [[file.name, hashlib.sha256(file.read_bytes()).hexdigest()] for file in label_files(path)]
    return hashlib.sha256(json.dumps(files).encode()).hexdigest()
