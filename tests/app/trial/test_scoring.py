"""Average precision against a slow reference that knows nothing of weights, and against faster-coco-eval."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from probscene.app.trial.scoring import (
    COCO_RECALLS,
    Matched,
    average_precision,
    coco_figures,
    match,
    measures,
    overlaps,
)
from probscene.app.trial.sets import BEYOND, Example, LabelledSet
from probscene.app.trial.training import Detections

SIZE = (100, 100)


def example(boxes, classes, levels=None, real=None) -> Example:
    boxes = np.array(boxes, np.float32).reshape(-1, 4)
    levels = np.zeros(len(boxes), np.int64) if levels is None else np.array(levels, np.int64)
    real = np.ones(len(boxes), bool) if real is None else np.array(real, bool)
    return Example(Path("x"), boxes, np.array(classes, np.int64), levels, real, SIZE, "")


def found(boxes, classes, scores) -> Detections:
    order = np.argsort(-np.array(scores, np.float32), kind="stable")
    boxes = np.array(boxes, np.float32).reshape(-1, 4)[order]
    return Detections(boxes, np.array(classes, np.int64)[order], np.array(scores, np.float32)[order])


@st.composite
def scored_images(draw, most: int = 6):
    """Some images with objects and detections, many of them near an object."""
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    examples, detections = [], []
    for _ in range(draw(st.integers(1, most))):
        n, d = draw(st.integers(0, 5)), draw(st.integers(0, 8))
        corner = random.uniform(0, 70, (n, 2))
        boxes = np.concatenate([corner, corner + random.uniform(8, 30, (n, 2))], 1)
        near = boxes[random.integers(0, n, d)] if n else np.tile([10, 10, 30, 30], (d, 1))
        seen = near + random.normal(0, draw(st.sampled_from([1.0, 4.0, 12.0])), (d, 4))
        seen[:, 2:] = np.maximum(seen[:, 2:], seen[:, :2] + 2)
        examples.append(example(boxes, random.integers(0, 2, n)))
        detections.append(
            found(seen, random.integers(0, 2, d), random.permutation(1000)[:d] / 1000 + random.random(d) / 1e4)
        )
    return examples, detections


def iou(a, b) -> float:
    w, h = min(a[2], b[2]) - max(a[0], b[0]), min(a[3], b[3]) - max(a[1], b[1])
    common = max(w, 0) * max(h, 0)
    return common / ((a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - common)


def slow_precision(examples, detections, number, times) -> float:
    """AP by its definition: every image as often as ``times`` says, detections one after the other."""
    events, total = [], 0
    for one, seen, often in zip(examples, detections, times, strict=True):
        objects = [tuple(map(float, b)) for b, c in zip(one.boxes, one.classes, strict=True) if c == number]
        total += often * len(objects)
        free = list(objects)
        for box, c, score in zip(seen.boxes, seen.classes, seen.scores, strict=True):
            if c == number:
                best = max(free, key=lambda other: iou(box, other), default=None)
                right = best is not None and iou(box, best) >= 0.5
                if right:
                    free.remove(best)
                events += [(float(score), right)] * often
    events.sort(key=lambda event: -event[0])
    curve, true = [], 0
    for number_of, (_, right) in enumerate(events, 1):
        true += right
        curve.append((true / total if total else 0, true / number_of))
    if not total:
        return float("nan")
    return float(np.mean([max((p for r, p in curve if r >= recall), default=0.0) for recall in COCO_RECALLS]))


@given(scored_images(), st.integers(0, 2**32 - 1))
@settings(max_examples=60, deadline=None)
def test_weighted_precision_is_that_of_images_written_out(images, seed):
    examples, detections = images
    weights = np.random.default_rng(seed).integers(0, 4, (3, len(examples)))
    weights[0] = 1
    for number in (0, 1):
        (measure,) = measures(False, "x")
        fast = average_precision(match(examples, detections, number, measure), weights, measure.recalls)
        slow = [slow_precision(examples, detections, number, times) for times in weights.tolist()]
        np.testing.assert_allclose(fast, slow, atol=1e-9)


@given(scored_images())
@settings(max_examples=30, deadline=None)
def test_precision_is_that_of_faster_coco_eval(images):
    examples, detections = images
    tested = LabelledSet(Path("x"), ("a", "b"), tuple(examples))
    ones = np.ones((1, len(examples)), np.int64)
    each = [average_precision(match(examples, detections, c, measures(False, "")[0]), ones)[0] for c in (0, 1)]
    known = [value for value in each if not np.isnan(value)]
    figures = coco_figures(tested, detections)
    assert figures["AP50"] == pytest.approx(np.mean(known) if known else 0.0, abs=1e-6)
    assert figures["AP"] <= figures["AP50"] + 1e-9


def test_overlaps_are_areas():
    over_union, over_own = overlaps(
        np.array([[0, 0, 4, 4]], np.float32), np.array([[2, 0, 6, 4], [9, 9, 10, 10]], np.float32)
    )
    np.testing.assert_allclose(over_union, [[8 / 24, 0]])
    np.testing.assert_allclose(over_own, [[8 / 16, 0]])


def test_no_objects_have_no_precision():
    none = Matched(np.zeros(0, np.int64), np.zeros(0, bool), np.zeros(0, np.float32), np.zeros(2, np.int64))
    assert np.isnan(average_precision(none, np.ones((2, 2), np.int64))).all()


def test_kitti_counts_levels_together_and_forgives_vans_regions_and_what_is_low():
    easy, hard, van, region = [0, 0, 50, 50], [0, 60, 50, 90], [60, 0, 99, 45], [60, 60, 99, 99]
    test = [example([easy, hard, van, region], [0, 0, 0, -1], [0, 2, BEYOND, BEYOND], [True, True, False, False])]
    low = [52, 0, 58, 20]
    seen = [found([van, region, low, easy, hard], [0] * 5, [0.9, 0.8, 0.7, 0.6, 0.5])]
    ones = np.ones((1, 1), np.int64)
    value = {
        m.name: float(average_precision(match(test, seen, 0, m), ones, m.recalls)[0]) for m in measures(True, "car")
    }
    # What is low is wrong by COCO's rules, so that half of what is found first is right; KITTI's leave it out.
    assert value["easy AP50"] == pytest.approx(0.5) and value["moderate AP50"] == pytest.approx(0.5)
    assert value["hard AP50"] == pytest.approx(2 / 3)
    assert value["easy R40"] == value["moderate R40"] == value["hard R40"] == 1.0


def test_kitti_asks_more_of_cars_than_of_people():
    strict = {m.name: m.overlap for m in measures(True, "car")}
    assert strict["easy R40"] == 0.7 and strict["easy AP50"] == 0.5
    assert {m.overlap for m in measures(True, "pedestrian")} == {0.5}
