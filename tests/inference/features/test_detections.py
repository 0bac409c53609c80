"""Renders and photographs are counted alike, and what a detector gets wrong is known from labelled images."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binomtest, poisson

from probscene.errors import DataError, ProbsceneError
from probscene.inference.features.base import Detections, Examples
from probscene.inference.features.detections.calibration import calibrate, iou, matched, shift_of
from probscene.inference.features.detections.net import DetectionFeatures, DetectionNet, poisson_quantile

NAMES = ("cat", "dog")
seeds = st.integers(0, 2**31)


def scenes(rng, images=300, most=4):
    """True objects: image, label and box of each."""
    n = rng.integers(0, most + 1, images)
    image = np.repeat(np.arange(images), n)
    place = rng.uniform(0, 200, (len(image), 2))
    return image, rng.integers(0, 2, len(image)), np.concatenate([place, place + rng.uniform(15, 25, place.shape)], 1)


def labelled(image, label, box, rows, boxes=True):
    """The labels of some images."""
    of = [np.flatnonzero(image == row) for row in rows]
    counts = np.array([np.bincount(label[each], minlength=2) for each in of])
    found = tuple(torch.from_numpy(np.column_stack([label[each], box[each]])).float() for each in of)
    return SimpleNamespace(
        rows=torch.tensor(rows), counts=torch.from_numpy(counts), classes=NAMES, boxes=found if boxes else None
    )


def detected(rng, image, label, box, images, recall=1.0, false_share=0.0):
    """With scores that tell right from wrong for the most part."""
    kept = rng.random(len(image)) < recall
    more = int(false_share / (1 - false_share) * kept.sum())
    place = rng.uniform(0, 200, (more, 2))
    return Detections(
        np.concatenate([image[kept], rng.integers(0, images, more)]),
        np.concatenate([label[kept], rng.integers(0, 2, more)]),
        np.concatenate([box[kept], np.concatenate([place, place + 5], 1)]),
        np.concatenate([rng.beta(8, 2, kept.sum()), rng.beta(2, 8, more)]),
        images,
        (0, 1),
    )


ROWS = list(range(0, 60, 3))


@given(seeds, st.booleans())
def test_perfect_detections_are_the_truth(seed, boxes):
    rng = np.random.default_rng(seed)
    image, label, box = scenes(rng)
    found = detected(rng, image, label, box, 300)._replace(score=np.full(len(image), 0.9))
    for c, reading in enumerate(calibrate(found, NAMES, labelled(image, label, box, ROWS, boxes))):
        assert reading.readable and (reading.recall, reading.false_finds) == (1, 0) and reading.error == 0
        assert (found.counts(c, reading.min_score) == np.bincount(image[label == c], minlength=300)).all()


def test_misses_and_false_finds_are_found_and_put_into_renders():
    """The mean count of renders that are the target's own scenes is that of the detections."""
    rng = np.random.default_rng(0)
    image, label, box = scenes(rng, 3000)
    found = detected(rng, image, label, box, 3000, 0.8, 0.15)
    rows = list(range(200))
    readings = calibrate(found, NAMES, labelled(image, label, box, rows))
    net = DetectionNet(NAMES)
    for c, reading in enumerate(readings):
        assert reading.readable and 0.7 < reading.recall < 0.85
        net.recall[c], net.false_finds[c], net.read[c] = reading.recall, reading.false_finds, True
    features = net.embed_from_labels(as_examples(image, label, box, 3000))
    for c, reading in enumerate(readings):
        counts = found.counts(c, reading.min_score)
        assert float(features[:, c].mean()) == pytest.approx(counts.mean(), rel=0.05)
        assert float(features[:, c].var()) == pytest.approx(counts.var(), rel=0.1)
    assert torch.equal(features[:, 2], features[:, 0] + features[:, 1])


def as_examples(image, label, box, images):
    number = np.bincount(image, minlength=images)
    place = np.arange(len(image)) - np.repeat(np.cumsum(number) - number, number)
    M = int(number.max())
    of, centre, size = torch.full((images, M), -1), torch.zeros(images, M, 2), torch.zeros(images, M, 2)
    of[image, place] = torch.from_numpy(label)
    centre[image, place] = torch.from_numpy((box[:, :2] + box[:, 2:]) / 2).float()
    size[image, place] = torch.from_numpy(box[:, 2:] - box[:, :2]).float()
    empty = torch.zeros(images, 0)
    return Examples(torch.zeros(images, 3, 1, 1), of, centre, size, (of >= 0).float(), empty, empty)


@given(seeds)
def test_features_go_by_the_image_alone(seed):
    rng = np.random.default_rng(seed)
    drawn, net = as_examples(*scenes(rng, 20), 20), DetectionNet(NAMES)
    net.recall[:], net.false_finds[:], net.read[:] = 0.6, 0.4, True
    whole = net.embed_from_labels(drawn)
    assert torch.equal(whole, net.embed_from_labels(drawn))
    one = Examples(*(part[7:8] for part in drawn))
    assert torch.equal(whole[7:8], net.embed_from_labels(one))


@given(seeds, st.lists(st.sampled_from([0.0, 1e-3, 0.4, 3.0, 25.0]), min_size=1, max_size=3))
def test_false_finds_are_poisson(seed, mean):
    v = torch.from_numpy(np.random.default_rng(seed).uniform(1e-6, 1 - 1e-6, (30, len(mean))))
    found = poisson_quantile(v, torch.tensor(mean, dtype=torch.float64))
    assert (found.numpy() == np.where(np.array(mean) > 0, poisson.ppf(v.numpy(), mean), 0)).all()


def test_objects_are_missed_as_often_as_is_said():
    rng, net = np.random.default_rng(0), DetectionNet(NAMES)
    image, label, box = scenes(rng, 4000)
    net.recall[:], net.read[:] = 0.7, True
    kept = int(net.embed_from_labels(as_examples(image, label, box, 4000))[:, 2].sum())
    low, high = binomtest(kept, len(image)).proportion_ci(1 - 1e-6)
    assert low < 0.7 < high


@pytest.mark.parametrize("seed", range(20))
def test_detections_at_random_are_refused(seed):
    rng = np.random.default_rng(seed)
    image, label, box = scenes(rng)
    found = detected(rng, rng.permutation(image), label, rng.permutation(box), 300)
    with pytest.raises(DataError, match=r"expected detections by which some class can be counted, got none \(cat: not"):
        calibrate(found, NAMES, labelled(image, label, box, ROWS))


@pytest.mark.parametrize(("seed", "by"), list(enumerate([-40.0, -20.0, -9.0, 8.5, 13.0, 33.0])))
def test_a_shift_is_said_and_taken_out(seed, by):
    rng = np.random.default_rng(seed)
    image, label, box = scenes(rng, most=2)
    found = detected(rng, image, label, box + [by, 0, by, 0], 300)
    labels = labelled(image, label, box, list(range(60)))
    own = [some[some[:, 0] == 0, 1:].numpy() for some in labels.boxes]
    assert shift_of(found, 0, labels.rows.numpy(), own) == pytest.approx([by, 0], abs=0.5)
    readings = calibrate(found, NAMES, labels)
    assert all(reading.recall > 0.8 for reading in readings)
    assert f"detections lie {by:+.1f}, +0.0 pixels from labelled boxes" in readings[0].because.replace("-0.0", "+0.0")
    assert "lie" not in calibrate(found._replace(box=found.box - [by, 0, by, 0]), NAMES, labels)[0].because


def test_what_is_not_labelled_or_not_known_is_said():
    rng = np.random.default_rng(0)
    image, label, box = scenes(rng)
    found = detected(rng, image, label, box, 300)
    for labels in (None, labelled(image, label, box, [0, 1, 2])):
        for reading in calibrate(found, NAMES, labels):
            assert reading.readable and reading.min_score == 0.5 and "label ten images" in reading.because
    one = found._replace(classes=(1,))
    cat, dog = calibrate(one, NAMES, labelled(image, label, box, ROWS))
    assert not cat.readable and dog.readable and "does not know this class" in cat.because


@given(seeds, st.integers(0, 6), st.integers(0, 6))
def test_overlap_is_that_of_pixels(seed, n, b):
    rng = np.random.default_rng(seed)
    boxes = []
    for number in (n, b):
        low = rng.integers(0, 20, (number, 2))
        boxes.append(np.concatenate([low, low + rng.integers(1, 12, (number, 2))], 1).astype(float))
    found = iou(*boxes)
    assert found.shape == (n, b)
    grid = np.zeros((2, 40, 40), bool)
    for i in range(n):
        for j in range(b):
            grid[:] = False
            for k, (x0, y0, x1, y1) in enumerate((boxes[0][i].astype(int), boxes[1][j].astype(int))):
                grid[k, y0:y1, x0:x1] = True
            assert found[i, j] == pytest.approx((grid[0] & grid[1]).sum() / (grid[0] | grid[1]).sum())


def test_a_box_is_found_once():
    box = np.array([[0.0, 0, 10, 10], [1, 0, 11, 10], [50, 50, 60, 60]])
    found = Detections(np.zeros(3, int), np.zeros(3, int), box, np.array([0.5, 0.9, 0.7]), 1, (0,))
    correct, score = matched(found, 0, np.array([0]), [np.array([[0.0, 0, 10, 10]])])
    assert dict(zip(score.tolist(), correct.tolist(), strict=True)) == {0.9: True, 0.7: False, 0.5: False}


def test_it_is_kept_and_knows_whose_detections_it_has():
    rng = np.random.default_rng(0)
    image, label, box = scenes(rng)
    found = detected(rng, image, label, box, 300)
    target = SimpleNamespace(detections=found, labelled=labelled(image, label, box, ROWS), fingerprint="ab" * 32)
    net, features = DetectionNet(NAMES), DetectionFeatures()
    record = features.adapt(net, lambda: target, lambda *_: None)["classes"]
    again = DetectionNet(NAMES)
    again.load_state_dict(net.state_dict())
    known = again.embed_target("ab" * 32)
    assert torch.equal(known, net.embed_target("ab" * 32)) and features.target_fingerprint(again) == "ab" * 32
    assert known[:, 1].numpy() == pytest.approx(found.counts(1, record["dog"]["min_score"]))
    with pytest.raises(DataError, match="expected the images that the run's detections are of, got others"):
        again.embed_target("cd" * 32)
    with pytest.raises(ProbsceneError, match="expected labels of renders, got images"):
        again.embed(torch.zeros(1, 3, 8, 8))
    with pytest.raises(ProbsceneError, match="give --readings FILE"):
        features.adapt(net, lambda: SimpleNamespace(detections=None, labelled=None), lambda *_: None)
