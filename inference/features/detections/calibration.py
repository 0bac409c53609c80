"""What a detector gets wrong, by labelled images: from which score on its detections count, how many objects it misses,
and how many of its finds are false.

Where no image is labelled, detections count from a score of 0.5 on, as if they were right. Axis letters: L images, K
labelled ones, n detections, b boxes of one image.
"""

from typing import NamedTuple, Protocol

import numpy as np
from torch import Tensor

from probscene.errors import DataError

from ..base import Detections
from ..photographs.readability import ERROR_RATIO, ERROR_SLACK, histogram_scores

MIN_SCORE = 0.5  # where nothing is labelled
MIN_IOU = 0.5  # of a detection and the labelled box that it finds
MIN_LABELS = 5  # labelled images from which on a detector's errors are estimated
MAX_SHIFT_SPREAD, MIN_SHIFT = 0.2, 0.2  # in widths of boxes: of displacements that are one shift, and of it
MAX_SCORES = 200  # that are tried
POOLED_OBJECTS = 20  # labelled objects of its own from which on a class's recall is mostly its own
MIN_RECALL = 0.05


class LabelsOfSome(Protocol):
    """Labels of K of the images, see ``Labelled``."""

    @property
    def rows(self) -> Tensor:
        """``(K,)``."""
        ...

    @property
    def counts(self) -> Tensor:
        """``(K, classes)``."""
        ...

    @property
    def classes(self) -> tuple[str, ...]:
        """Their names."""
        ...

    @property
    def boxes(self) -> tuple[Tensor, ...] | None:
        """``(n, 5)`` of each image."""
        ...


class ClassReading(NamedTuple):
    """How a class is counted.

    Attributes:
        min_score: of a detection that counts.
        recall: share of the objects that are found.
        false_finds: an image.
        readable: whether counts are compared.
        error: mean absolute error an image in the labelled ones, of counts without misses and false finds; NaN if none
            is labelled.
        because: one sentence.
    """

    min_score: float
    recall: float
    false_finds: float
    readable: bool
    error: float
    because: str


def calibrate(found: Detections, names: tuple[str, ...], labelled: LabelsOfSome | None) -> list[ClassReading]:
    """How each of a model's classes is counted.

    All classes have one score, that with the fewest missed objects and false finds in the labelled images together, and
    a class with few labelled objects takes its recall mostly from the others.

    Raises:
        DataError: no class can be counted.
    """
    readings, nan = list[ClassReading](), float("nan")
    known = [c for c, name in enumerate(names) if c in found.classes and labelled and name in labelled.classes]
    errors = None if labelled is None or len(labelled.rows) < MIN_LABELS else _errors(found, known, names, labelled)
    for c in range(len(names)):
        if c not in found.classes:
            because = "not readable, the detector does not know this class"
            readings.append(ClassReading(1.0, 1.0, 0.0, False, nan, because))
        elif errors is None or c not in known:
            mean = found.counts(c, MIN_SCORE).mean()
            because = f"readable, {mean:.1f} an image from a score of {MIN_SCORE} on, as if every detection were right"
            readings.append(ClassReading(MIN_SCORE, 1.0, 0.0, True, nan, f"{because}; label ten images"))
        else:
            readings.append(_of_class(found, c, errors))
    if not any(reading.readable for reading in readings):
        reasons = "; ".join(f"{name}: {reading.because}" for name, reading in zip(names, readings, strict=True))
        raise DataError(
            f"expected detections by which some class can be counted, got none ({reasons}); give those of a better "
            "detector, or fit without --readings."
        )
    return readings


class _Errors(NamedTuple):
    """What labelled images say of detections from a score on.

    Attributes:
        min_score: the best one.
        objects: ``(K,)`` by class, labelled.
        rows: ``(K,)`` the numbers of the images.
        hits: by class, objects that are found.
        recall: of all classes.
        false_share: of all detections, those that find no object.
        shift: by class, see ``shift_of``.
        with_boxes: whether it is known which detections are right.
    """

    min_score: float
    objects: dict[int, np.ndarray]
    rows: np.ndarray
    hits: dict[int, int]
    recall: float
    false_share: float
    shift: dict[int, np.ndarray | None]
    with_boxes: bool


def _errors(found: Detections, known: list[int], names: tuple[str, ...], labelled: LabelsOfSome) -> _Errors | None:
    """None where no object is labelled or none detected."""
    rows, scores = labelled.rows.numpy(), np.unique(found.score[np.isin(found.label, known)])
    column = {c: labelled.classes.index(names[c]) for c in known}
    objects = {c: labelled.counts[:, column[c]].numpy() for c in known}
    total = sum(int(y.sum()) for y in objects.values())
    if not total or not len(scores):
        return None
    scores = scores[np.unique(np.linspace(0, len(scores) - 1, MAX_SCORES).round().astype(int))]
    shift: dict[int, np.ndarray | None] = dict.fromkeys(known)
    matches: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    for c in known if labelled.boxes is not None else ():
        boxes = [some[some[:, 0] == column[c], 1:].double().numpy() for some in labelled.boxes or ()]
        shift[c] = found_shift = shift_of(found, c, rows, boxes)
        moved = found if found_shift is None else found._replace(box=found.box - np.tile(found_shift, 2))
        matches[c] = matched(moved, c, rows, boxes)

    def hits_and_shown(score: float) -> tuple[dict[int, int], dict[int, int]]:
        if not matches:
            shown = {c: found.counts(c, score)[rows] for c in known}
            return {c: int(np.minimum(shown[c], objects[c]).sum()) for c in known}, {
                c: int(shown[c].sum()) for c in known
            }
        right = {c: int((correct & (at >= score)).sum()) for c, (correct, at) in matches.items()}
        return right, {c: int((at >= score).sum()) for c, (_, at) in matches.items()}

    wrong = []
    for score in scores:
        hits, shown = hits_and_shown(score)
        wrong.append(sum(shown.values()) + total - 2 * sum(hits.values()))
    tied = np.flatnonzero(np.array(wrong) == min(wrong))
    score = float(scores[tied[len(tied) // 2]])  # the lowest may let in false finds that the few labelled images lack
    hits, shown = hits_and_shown(score)
    recall, all_shown = sum(hits.values()) / total, max(sum(shown.values()), 1)
    return _Errors(score, objects, rows, hits, recall, 1 - sum(hits.values()) / all_shown, shift, bool(matches))


def _of_class(found: Detections, c: int, errors: _Errors) -> ClassReading:
    y, counts = errors.objects[c], found.counts(c, errors.min_score)
    recall, false_finds = 1.0, 0.0
    if errors.with_boxes:
        recall = (errors.hits[c] + POOLED_OBJECTS * errors.recall) / (int(y.sum()) + POOLED_OBJECTS)
        false_finds = errors.false_share * float(counts.mean())
    error, histogram = _error(found, c, errors, recall, false_finds), _histogram(y)
    readable = errors.recall > 0 and error <= ERROR_RATIO * histogram + ERROR_SLACK and _all_readable(found, errors)
    estimate = np.clip((counts - false_finds) / max(recall, MIN_RECALL), 0, None).mean()
    because = f"{'' if readable else 'not '}readable by {len(y)} labels, {estimate:.1f} an image, from a score of "
    because += f"{errors.min_score:.2f} on"
    if errors.with_boxes:
        because += f": {recall:.0%} of the objects are found, {false_finds:.2f} an image are false"
    because += f" (error {error:.2f} an image, of the labels' histogram {histogram:.2f})"
    if (shift := errors.shift[c]) is not None:
        because += (
            f"; detections lie {shift[0]:+.1f}, {shift[1]:+.1f} pixels from labelled boxes: check their coordinates"
        )
    return ClassReading(errors.min_score, recall, false_finds, bool(readable), error, because)


def _all_readable(found: Detections, errors: _Errors) -> bool:
    """Whether detections of all classes tell labelled images apart; a class of which none is labelled goes by it."""
    pairs = []
    for c, y in errors.objects.items():
        false_finds = errors.false_share * float(found.counts(c, errors.min_score).mean()) * errors.with_boxes
        recall = errors.recall if errors.with_boxes else 1.0
        pairs.append((_error(found, c, errors, recall, false_finds), _histogram(y)))
    error, histogram = np.sum(pairs, 0)
    return bool(error <= ERROR_RATIO * histogram + ERROR_SLACK)


def _error(found: Detections, c: int, errors: _Errors, recall: float, false_finds: float) -> float:
    counts = found.counts(c, errors.min_score)[errors.rows]
    estimate = np.clip((counts - false_finds) / max(recall, MIN_RECALL), 0, None)
    return float(np.abs(estimate - errors.objects[c]).mean())


def _histogram(y: np.ndarray) -> float:
    return float(histogram_scores(y.astype(np.float64)).mean())


def matched(
    found: Detections, c: int, rows: np.ndarray, boxes: list[np.ndarray], min_iou: float = MIN_IOU
) -> tuple[np.ndarray, np.ndarray]:
    """Which of the detections of a class in labelled images find a labelled box, and their scores, each ``(n',)``: each
    finds the box that it overlaps most of those that no better detection has found.

    Args:
        rows: ``(K,)`` numbers of the labelled images.
        boxes: ``(b, 4)`` of each of them.
    """
    correct, scores = list[bool](), list[float]()
    for row, given in zip(rows, boxes, strict=True):
        of = np.flatnonzero((found.image == row) & (found.label == c))
        of, free = of[np.argsort(-found.score[of], kind="stable")], np.ones(len(given), bool)
        overlap = iou(found.box[of], given)
        for i in range(len(of)):
            each = np.where(free, overlap[i], 0.0) if len(given) else np.zeros(1)
            hit = bool(each.max() >= min_iou)
            if hit:
                free[each.argmax()] = False
            correct.append(hit)
        scores += found.score[of].tolist()
    return np.array(correct, bool), np.array(scores)


def iou(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """``(n, b)`` overlap of boxes ``(n, 4)`` and ``(b, 4)``: their intersection over their union."""
    low, high = np.maximum(one[:, None, :2], other[:, :2]), np.minimum(one[:, None, 2:], other[:, 2:])
    both = np.clip(high - low, 0, None).prod(-1)
    areas = [(box[:, 2:] - box[:, :2]).prod(-1) for box in (one, other)]
    return both / np.maximum(areas[0][:, None] + areas[1] - both, 1e-9)


def shift_of(found: Detections, c: int, rows: np.ndarray, boxes: list[np.ndarray]) -> np.ndarray | None:
    """By how many pixels, along x and y, detections of a class all lie beside the labelled boxes; None where they do
    not: the median displacement of the best ones from the nearest box of their image."""
    away = list[np.ndarray]()
    for row, given in zip(rows, boxes, strict=True):
        of = np.flatnonzero((found.image == row) & (found.label == c))
        of = of[np.argsort(-found.score[of], kind="stable")][: len(given)]
        for box in found.box[of] if len(given) else []:
            differences = (box[:2] + box[2:]) / 2 - (given[:, :2] + given[:, 2:]) / 2
            nearest = np.square(differences).sum(1).argmin()
            away.append(np.append(differences[nearest], given[nearest, 2:] - given[nearest, :2]))
    if len(away) < MIN_LABELS:
        return None
    moved, size = np.array(away)[:, :2], float(np.median(np.array(away)[:, 2:]))
    shift = np.median(moved, 0)
    spread = np.median(np.abs(moved - shift).max(1))
    return shift if np.abs(shift).max() > MIN_SHIFT * size and spread <= MAX_SHIFT_SPREAD * size else None
