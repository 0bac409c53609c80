"""Detections of a target's images by somebody's detector: COCO's results, with scores."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from probscene.dataset import Images
from probscene.errors import DataError
from probscene.inference.features.base import Detections
from probscene.model import SceneModel

from .boxes import read_boxes

FEW = 0.05  # share of the images without a detection, of the class that is found most often, that is not worth a note


class ReadDetections(NamedTuple):
    """Detections, and what a person should know of them, one sentence each."""

    found: Detections
    notes: tuple[str, ...]


def read_detections(path: Path, model: SceneModel, target: Images) -> ReadDetections:
    """The detections in a file of COCO's format, whose annotations have a ``score``.

    Raises:
        DataError: see ``read_boxes``; an annotation without a score.
    """
    read = read_boxes(path, model, target, allow_missing=True)
    sizes = [len(boxes) for boxes in read.boxes]
    image = np.repeat(np.array(read.rows, np.int64), sizes)
    if read.scores is None or not len(image):
        what = "boxes without scores" if len(image) else "no detection of the model's classes"
        raise DataError(
            f"expected COCO's results with a score for each box in {path}, got {what}; labels that people gave go into "
            "--labels."
        )
    number = np.array([model.classes.index(name) for name in read.classes])
    boxes, notes = torch.cat(read.boxes).numpy(), read.notes
    found = Detections(
        image,
        number[boxes[:, 0].astype(np.int64)],
        boxes[:, 1:].astype(np.float64),
        torch.cat(read.scores).double().numpy(),
        len(target),
        tuple(number.tolist()),
    )
    without = len(target) - len(np.unique(image))
    if without > FEW * len(target):
        notes = (*notes, f"{without} of {len(target)} images have no detection in {path}; they count as empty.")
    return ReadDetections(found, notes)
