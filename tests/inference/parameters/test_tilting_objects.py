"""What is measured of objects, and that only what they show of a site counts."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binomtest

from probscene.inference.parameters.tilting.learning import step_weights
from probscene.inference.parameters.tilting.objects import (
    ASPECTS,
    BOX,
    Objects,
    aspect_of,
    concatenate_objects,
    measure,
    object_witness,
    scene_means,
    slope_of,
)

seeds = st.integers(0, 2**31)
WIDTH = ASPECTS["around"].stop


@given(seeds, st.sampled_from([1, 3]))
def test_an_object_is_measured_in_its_box(seed, channels):
    """Beside loops over its pixels."""
    rng = np.random.default_rng(seed)
    H, W = rng.integers(8, 30, 2)
    images = rng.integers(0, 256, (2, channels, H, W), dtype=np.uint8)
    x0, y0 = rng.integers(0, W - 4, 3), rng.integers(0, H - 4, 3)
    box = np.stack([x0, y0, x0 + rng.integers(2, 5, 3), y0 + rng.integers(2, 5, 3)], 1)
    label = np.array([[0, -1, 1], [2, 0, 0]])
    found = measure(torch.from_numpy(images), torch.from_numpy(np.stack([box, box])).float(), torch.from_numpy(label))
    assert found.image.tolist() == [0, 0, 1, 1, 1] and found.node.tolist() == [0, 2, 0, 1, 2]
    assert found.label.tolist() == [0, 1, 2, 0, 0] and found.images == 2
    for i, (image, node) in enumerate(zip(found.image, found.node, strict=True)):
        a, b, c, d = box[node]
        pixels = np.broadcast_to(images[image], (3, H, W)) / 255
        inside, grey = pixels[:, b:d, a:c], pixels.mean(0)[b:d, a:c]
        m, n = 0.25 * (c - a), 0.25 * (d - b)
        left, top, right, bottom = max(a - m, 0), max(b - n, 0), min(c + m, W), min(d + n, H)
        outer = np.zeros((H, W), bool)
        outer[int(top) : int(np.ceil(bottom)), int(left) : int(np.ceil(right))] = True
        outer[b:d, a:c] = False
        seen = found.seen[i]
        assert seen[ASPECTS["size"]] == pytest.approx(np.log([c - a, d - b]), abs=1e-5)
        assert seen[ASPECTS["place"]] == pytest.approx([(a + c) / 2 / W, (b + d) / 2 / H], abs=1e-5)
        assert seen[ASPECTS["inside"]] == pytest.approx([*inside.mean((1, 2)), grey.std()], abs=1e-5)
        around = pixels[:, outer].mean(1) if outer.any() else np.zeros(3)
        assert seen[ASPECTS["around"]] == pytest.approx(around, abs=1e-5)


def random_objects(rng, images, size, each=4, classes=2):
    """Objects of some images with log sizes of a normal distribution, and the u that these go by."""
    n = images * each
    u, seen = rng.uniform(size=n), rng.normal(size=(n, WIDTH))
    seen[:, 0] = size(u) + 0.1 * rng.normal(size=n)
    seen += np.repeat(rng.normal(size=(images, 1)), each, 0) * 0.3  # what an image's objects have in common
    label = rng.integers(0, classes, n)
    return Objects(np.repeat(np.arange(images), each), np.tile(np.arange(each), images), label, seen, images), u


def test_a_site_is_moved_toward_the_labelled_objects_and_others_are_not():
    rng = np.random.default_rng(0)
    own, u = random_objects(rng, 400, lambda u: 2 * u)
    real, _ = random_objects(rng, 12, lambda u: 2 * (0.6 + 0.4 * u))
    w = object_witness(own, real)
    size = slope_of(w, u[w.rows], 0)
    assert size.p < 1e-3 and size.sure > 0.5
    v = np.stack([u - 0.5, np.square(u - 0.5)], 1) @ size.slope
    assert v[u > 0.8].mean() < v[u < 0.2].mean()  # larger ones are to become more frequent
    weight = step_weights(v, 0.3)
    assert weight.sum() == pytest.approx(1) and (weight * u).sum() > 0.55
    assert slope_of(w, rng.uniform(size=len(w.rows)), 0).p > 0.01


@pytest.mark.parametrize("of_scene", [False, True])
def test_a_site_is_chosen_by_chance_as_often_as_the_test_says(of_scene):
    """Labelled objects of the renders' own distribution: of 400 tests of 5 % as many, within chance, or fewer."""
    rng, found = np.random.default_rng(1), []
    for _ in range(400):
        own, u = random_objects(rng, 100, lambda u: 2 * u)
        if of_scene:
            u = np.repeat(rng.uniform(size=100), 4)
            own.seen[:, 0] += u
        real, other = random_objects(rng, 10, lambda u: 2 * u)
        if of_scene:
            real.seen[:, 0] += np.repeat(rng.uniform(size=10), 4)
        w = object_witness(own, real)
        found.append(slope_of(w, u[w.rows], 0).p)
    low = binomtest(int((np.array(found) < 0.05).sum()), 400).proportion_ci(1 - 1e-4).low
    assert low < 0.05


def test_where_too_few_are_labelled_nothing_is_said():
    rng = np.random.default_rng(0)
    own, u = random_objects(rng, 50, lambda u: u, classes=1)
    real, _ = random_objects(rng, 1, lambda u: u, each=3, classes=1)
    assert object_witness(own, real) is None
    real, _ = random_objects(rng, 2, lambda u: u, classes=1)
    w = object_witness(own, real)
    assert slope_of(w, u[w.rows], 0).p == 1 and slope_of(w, np.full(len(w.rows), np.nan), 0).p == 1
    assert slope_of(w, np.full(len(w.rows), 0.5), 0).p == 1


@given(seeds, st.integers(1, 4))
def test_several_sets_of_images_are_one(seed, number):
    rng = np.random.default_rng(seed)
    parts = [random_objects(rng, int(rng.integers(1, 4)), lambda u: u)[0] for _ in range(number)]
    whole, first = concatenate_objects(parts), 0
    assert whole.images == sum(part.images for part in parts)
    for part in parts:
        for i in range(part.images):
            assert np.array_equal(whole.seen[whole.image == first + i], part.seen[part.image == i])
        first += part.images


def test_scenes_without_objects_say_nothing_of_a_site():
    none = measure(torch.zeros(3, 3, 8, 8, dtype=torch.uint8), torch.zeros(3, 2, 4), torch.full((3, 2), -1))
    scenes, mean = scene_means(none)
    assert not len(scenes) and aspect_of(mean, torch.rand(3)[scenes]) == -1
    real, _ = random_objects(np.random.default_rng(0), 10, lambda u: u)
    assert object_witness(none, real) is None


def test_boxes_go_by_a_site_only_if_their_size_or_place_does():
    rng = np.random.default_rng(0)
    own, _ = random_objects(rng, 1000, lambda u: u)
    u = torch.from_numpy(rng.uniform(size=(1000, 4)))
    per_object = u.numpy()[own.image]
    own.seen[:, 1] += 0.3 * per_object[:, 0] * np.where(own.label == 0, 1, 1.2)
    own.seen[:, 3] += 0.5 * np.cos(6 * per_object[:, 1])
    own.seen[:, 5] += 5 * per_object[:, 2]  # light
    scenes, mean = scene_means(own)
    names = list(ASPECTS)
    for g, (of_box, of_all) in enumerate([("size", "size"), ("place", "place"), (None, "inside"), (None, None)]):
        for aspects, expected in ((BOX, of_box), (names, of_all)):
            found = aspect_of(mean, u[scenes, g], aspects)
            assert (names[found] if found >= 0 else None) == expected


@given(seeds, st.integers(2, 200), st.floats(0, 30), st.floats(0.2, 0.8))
def test_a_step_leaves_as_many_objects_as_are_asked_for(seed, number, scale, share):
    h = scale * np.random.default_rng(seed).normal(size=number)
    weight = step_weights(h, share)
    assert weight.sum() == pytest.approx(1) and 1 / np.square(weight).sum() >= min(share * number, 1) - 1e-6
    assert 1 / np.square(weight).sum() >= share * number * (1 - 1e-3) or share * number < 1
    if np.ptp(h) < 1e-3:
        assert weight == pytest.approx(np.full(number, 1 / number), rel=1e-2)
