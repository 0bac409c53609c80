"""COCO's own figures, by faster-coco-eval."""

import contextlib
import io
from collections.abc import Sequence
from typing import Any

from faster_coco_eval import COCO, COCOeval_faster

from .scoring import OVERLAP
from .sets import HARD, LabelledSet
from .training import Detections

MOST = [1, 10, 100]


def coco_figures(tested: LabelledSet, found: Sequence[Detections]) -> dict[str, float]:
    """AP averaged over overlaps of 0.5 to 0.95, and at 0.5 and 0.75, of all classes. What a trial's own measures
    ignore is a crowd here, and KITTI's levels are all one."""
    images = [{"id": i, "height": e.size[0], "width": e.size[1]} for i, e in enumerate(tested.examples)]
    labels: list[dict[str, Any]] = []
    for i, example in enumerate(tested.examples):
        for box, c, level, real in zip(example.boxes, example.classes, example.levels, example.real, strict=True):
            for number in range(len(tested.classes)) if c < 0 else (int(c),):
                crowd = int(not real or level > HARD)
                labels.append({"id": len(labels) + 1, "iscrowd": crowd, **_box(i, number, box)})
    scored = [
        {**_box(i, int(c), box), "score": float(value)}
        for i, each in enumerate(found)
        for box, c, value in zip(each.boxes, each.classes, each.scores, strict=True)
    ]
    names = [{"id": number, "name": name} for number, name in enumerate(tested.classes)]
    if not scored:
        return {"AP": 0.0, "AP50": 0.0, "AP75": 0.0}
    with contextlib.redirect_stdout(io.StringIO()):
        truth = COCO({"images": images, "annotations": labels, "categories": names})
        evaluation = COCOeval_faster(truth, truth.loadRes(scored), "bbox")
        evaluation.params.maxDets = MOST
        evaluation.evaluate()
        evaluation.accumulate()
    precision = evaluation.eval["precision"][:, :, :, 0, -1]  # overlaps, recalls, classes; -1 where there is no object
    overlaps = [round(float(v), 2) for v in evaluation.params.iouThrs]

    def mean(part) -> float:
        known = part[part > -1]
        return float(known.mean()) if known.size else 0.0

    at = {"AP50": precision[overlaps.index(OVERLAP)], "AP75": precision[overlaps.index(0.75)]}
    return {"AP": mean(precision), **{key: mean(part) for key, part in at.items()}}


def _box(image: int, number: int, box: Any) -> dict[str, Any]:
    x0, y0, x1, y1 = map(float, box)
    area = (x1 - x0) * (y1 - y0)
    return {"image_id": image, "category_id": number, "bbox": [x0, y0, x1 - x0, y1 - y0], "area": area}
