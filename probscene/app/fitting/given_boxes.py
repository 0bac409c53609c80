"""Boxes of a target's objects that a run was given, with its labels or with its readings."""

import numpy as np
import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from probscene.dataset import Images
from probscene.errors import DataError
from probscene.inference.features.base import Detections

from ..labels.boxes import Boxes
from ..labels.detections import read_detections
from ..labels.partial_labels import read_partial_labels
from .run import RunFolder


def given_boxes(run: RunFolder, target: Images) -> Boxes | None:
    """The boxes that the run was given with its labels, else with its readings; None where these were none, or are gone
    by now.

    Args:
        target: the images that it was fitted to.
    """
    try:
        if "labels" in run.record:
            labels = read_partial_labels(run.record["labels"]["path"], run.model, target)
            if labels.boxes is not None:
                return labels.as_boxes
        if "readings" in run.record:
            return _found_boxes(run, read_detections(run.record["readings"]["path"], run.model, target).found)
    except DataError:
        pass
    return None


def stacked(boxes: Boxes, classes: tuple[str, ...], images: Images) -> tuple[Tensor, Tensor, Tensor]:
    """Images ``(K, C, H, W)`` uint8, their boxes ``(K, M, 4)`` float32, x0 y0 x1 y1 in pixels of the canvas, and the
    numbers of these in ``classes``, ``(K, M)`` int64, -1 where there is none."""
    number = torch.tensor([classes.index(name) for name in boxes.classes])
    label = [number[found[:, 0].long()] for found in boxes.boxes]
    pictures = torch.stack([images.load(row) for row in boxes.rows])
    corners = pad_sequence([found[:, 1:] for found in boxes.boxes], batch_first=True)
    return pictures, corners, pad_sequence(label, batch_first=True, padding_value=-1)


def _found_boxes(run: RunFolder, found: Detections) -> Boxes:
    """Of the classes that detections count, from the score on from which they do."""
    of_class = [run.readings["classes"][name] for name in run.model.classes]
    least = np.array([record["min_score"] if record["readable"] else np.inf for record in of_class])
    kept = found.score >= least[found.label]
    box = torch.from_numpy(np.column_stack([found.label, found.box])).float()
    each = tuple(box[kept & (found.image == row)] for row in range(found.images))
    return Boxes(list(range(found.images)), each, run.model.classes)
