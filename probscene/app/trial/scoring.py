"""Average precision of detections, once they are matched, for any resample of the test images at once.

Matching is by image and never looks at another, so that a bootstrap over images only weighs what was matched. The
rules are COCO's [1]: detections from the highest score on, each takes the free object with the greatest overlap that is
at least the threshold; what only overlaps an object that is ignored counts neither way. AP is the mean, over 101
recalls from 0 to 1, of the greatest precision at that recall or a higher one; KITTI's protocol [2] takes the 40 recalls
from 1/40 to 1.

On KITTI a level has its own objects and those of the levels before it, the rest is ignored. The official figures (R40)
also need an overlap of 0.7 for cars, and leave out what is found lower than the level's least height.

Axis letters: L test images, D detections, N objects, B resamples, R recalls.

References:
    [1] cocodataset.org, *Detection evaluation*; the figures are those of faster-coco-eval.
    [2] Geiger et al., *Are we ready for autonomous driving?*, CVPR 2012; R40: Simonelli et al., ICCV 2019.
"""

import contextlib
import io
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from faster_coco_eval import COCO, COCOeval_faster
from numpy.typing import NDArray

from .sets import HARD, LEVELS, Example, LabelledSet
from .training import Detections

OVERLAP, OVERLAP_OF_CARS = 0.5, 0.7
COCO_RECALLS = np.linspace(0, 1, 101)
R40_RECALLS = np.linspace(1 / 40, 1, 40)
MOST_FOUND = [1, 10, 100]  # of an image's detections, as COCO has it
AT_ONCE = 64  # resamples: that many times the number of detections is held in memory
LEVEL_NAMES = ("easy", "moderate", "hard")
MAIN = ("AP50", "moderate AP50")  # the measure by which sets are compared, of COCO and of KITTI


class Measure(NamedTuple):
    """One way to score.

    Attributes:
        name: such as ``"AP50"`` or ``"easy R40"``.
        level: of KITTI's, the last whose objects count.
        overlap: least intersection over union.
        recalls: ``(R,)``, those whose precisions are averaged.
        least_height: pixels of what is found; lower counts neither way.
    """

    name: str
    level: int = HARD
    overlap: float = OVERLAP
    recalls: NDArray[np.float64] = COCO_RECALLS
    least_height: float = 0.0


class Matched(NamedTuple):
    """Detections of one class in all test images, from the highest score on, those left out that count neither way.

    Attributes:
        image: ``(D,)`` int64, of which test image.
        correct: ``(D,)`` bool.
        score: ``(D,)``.
        objects: ``(L,)`` int64, how many there are to find in each image.
    """

    image: NDArray[np.int64]
    correct: NDArray[np.bool_]
    score: NDArray[np.float32]
    objects: NDArray[np.int64]


def measures(kitti: bool, name: str) -> tuple[Measure, ...]:
    """The ways to score a class, among them ``MAIN``."""
    if not kitti:
        return (Measure("AP50"),)
    strict = OVERLAP_OF_CARS if name.casefold() in ("car", "van", "truck", "tram") else OVERLAP
    usual = [Measure(f"{word} AP50", level) for level, word in enumerate(LEVEL_NAMES)]
    official = [
        Measure(f"{word} R40", level, strict, R40_RECALLS, LEVELS[level][0]) for level, word in enumerate(LEVEL_NAMES)
    ]
    return (*usual, *official)


def match(test: Sequence[Example], found: Sequence[Detections], number: int, measure: Measure) -> Matched:
    """Detections of class ``number`` beside the objects of the test images."""
    images, correct, scores, objects = [], [], [], np.zeros(len(test), np.int64)
    for i, (example, detections) in enumerate(zip(test, found, strict=True)):
        mine = detections.classes == number
        boxes, score = detections.boxes[mine], detections.scores[mine]
        of_class = (example.classes == number) | (example.classes == -1)
        counts = of_class & example.real & (example.levels <= measure.level)
        objects[i] = counts.sum()
        right, neither = _match_image(boxes, example, counts, of_class & ~counts, measure.overlap)
        neither |= ~right & (boxes[:, 3] - boxes[:, 1] < measure.least_height)
        images.append(np.full((~neither).sum(), i))
        correct.append(right[~neither])
        scores.append(score[~neither])
    image, true, value = (np.concatenate(parts) for parts in (images, correct, scores))
    best = np.argsort(-value, kind="stable")
    return Matched(image[best].astype(np.int64), true[best].astype(bool), value[best].astype(np.float32), objects)


def average_precision(
    matched: Matched, weights: NDArray[np.int64], recalls: NDArray[np.float64] = COCO_RECALLS
) -> NDArray[np.float64]:
    """AP ``(B,)`` where each test image counts as often as ``weights (B, L)`` says; NaN where there is nothing to
    find."""
    parts = [_of_some(matched, weights[i : i + AT_ONCE], recalls) for i in range(0, len(weights), AT_ONCE)]
    return np.concatenate(parts)


def coco_figures(tested: LabelledSet, found: Sequence[Detections]) -> dict[str, float]:
    """COCO's own figures, by faster-coco-eval: AP averaged over overlaps of 0.5 to 0.95, and at 0.5 and 0.75, of all
    classes. What a trial's own measures ignore is a crowd here, and KITTI's levels are all one."""
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
        evaluation.params.maxDets = MOST_FOUND
        evaluation.evaluate()
        evaluation.accumulate()
    precision = evaluation.eval["precision"][:, :, :, 0, -1]  # overlaps, recalls, classes; -1 where there is no object
    overlaps = [round(float(v), 2) for v in evaluation.params.iouThrs]

    def mean(part) -> float:
        known = part[part > -1]
        return float(known.mean()) if known.size else 0.0

    at = {"AP50": precision[overlaps.index(OVERLAP)], "AP75": precision[overlaps.index(0.75)]}
    return {"AP": mean(precision), **{key: mean(part) for key, part in at.items()}}


def overlaps(boxes: NDArray[np.float32], others: NDArray[np.float32]) -> tuple[NDArray[np.float64], ...]:
    """Intersections ``(D, N)`` of boxes ``(D, 4)`` and ``(N, 4)`` over their unions, and over the first's areas."""
    a, b = boxes[:, None].astype(np.float64), others[None].astype(np.float64)
    sides = np.clip(np.minimum(a[..., 2:], b[..., 2:]) - np.maximum(a[..., :2], b[..., :2]), 0, None)
    common, area, other = sides.prod(-1), (a[..., 2:] - a[..., :2]).prod(-1), (b[..., 2:] - b[..., :2]).prod(-1)
    return common / np.maximum(area + other - common, 1e-12), common / np.maximum(area, 1e-12)


def _match_image(
    boxes: NDArray[np.float32],
    example: Example,
    counts: NDArray[np.bool_],
    ignored: NDArray[np.bool_],
    overlap: float,
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which detections ``(D,)``, from the highest score on, are right, and which count neither way."""
    right, neither = np.zeros(len(boxes), bool), np.zeros(len(boxes), bool)
    over_union, over_own = overlaps(boxes, example.boxes)
    region = example.classes == -1
    free = counts | (ignored & ~region)
    for d in range(len(boxes)):
        for among in (counts, ignored & ~region):  # an object that counts comes before one that does not
            open_ = np.flatnonzero(among & free & (over_union[d] >= overlap))
            if len(open_):
                best = open_[np.argmax(over_union[d, open_])]
                free[best] = False
                right[d], neither[d] = counts[best], not counts[best]
                break
        else:
            neither[d] = bool((over_own[d, region] >= overlap).any())
    return right, neither


def _of_some(matched: Matched, weights: NDArray[np.int64], recalls: NDArray[np.float64]) -> NDArray[np.float64]:
    all_objects = weights @ matched.objects
    times = weights[:, matched.image]  # (B, D)
    true = np.cumsum(times * matched.correct, 1)
    every = np.cumsum(times, 1)
    precision = true / np.maximum(every, 1)
    precision = np.maximum.accumulate(precision[:, ::-1], 1)[:, ::-1]
    # A resample's copies of a detection are ties, which count as one step: recall is reached at its last copy.
    out = np.full(len(weights), np.nan)
    for b in np.flatnonzero(all_objects):
        recall = true[b] / all_objects[b]
        at = np.searchsorted(recall, recalls, side="left")
        there = at < len(recall)
        out[b] = precision[b, at[there]].sum() / len(recalls)
    return out


def _box(image: int, number: int, box: Any) -> dict[str, Any]:
    x0, y0, x1, y1 = map(float, box)
    area = (x1 - x0) * (y1 - y0)
    return {"image_id": image, "category_id": number, "bbox": [x0, y0, x1 - x0, y1 - y0], "area": area}
