"""Guides are tilted toward scenes that bring renders nearer to the target, and no site is moved by chance."""

from functools import partial

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from pyro.poutine.messenger import Messenger
from scipy.stats import chi2, kstest

from probscene.inference.features.base import class_table, examples
from probscene.inference.parameters.sites import with_handlers
from probscene.inference.parameters.tilting.image_statistics import image_statistics
from probscene.inference.parameters.tilting.learning import (
    TiltingLearning,
    explained_part,
    tilted_weights,
    without_structure,
    witness,
)
from probscene.inference.parameters.tilting.objects import basis, dependence, objects_of
from probscene.inference.parameters.tilting.schedule import TiltingSchedule
from probscene.inference.statistics.energy import energy_distance
from probscene.renderers.sprites import SpriteRenderer
from probscene.sampling import sample, seed_everything

seeds = st.integers(0, 2**31)


@given(seeds, st.integers(3, 300), st.floats(0.2, 0.95))
def test_as_many_scenes_are_effective_as_are_kept(seed, number, kept):
    w = np.random.default_rng(seed).normal(size=number) * 7 + 3
    weight = tilted_weights(w, kept)
    assert weight.sum() == pytest.approx(1) and (weight >= 0).all()
    assert (np.diff(weight[np.argsort(w)]) <= 1e-12).all()  # the smaller w, the heavier
    assert 1 / np.square(weight).sum() == pytest.approx(max(kept * number, 1.0), rel=1e-3)


def test_scenes_that_are_all_as_near_weigh_the_same():
    assert tilted_weights(np.full(20, 3.0), 0.4) == pytest.approx(np.full(20, 0.05))


@given(seeds, st.integers(1, 60), st.floats(0.9999999, 1))
def test_where_all_are_kept_all_weigh_the_same(seed, number, kept):
    w = np.random.default_rng(seed).normal(size=number)
    assert tilted_weights(w, kept) == pytest.approx(np.full(number, 1 / number), rel=0.02)


@given(seeds, st.integers(20, 400), st.integers(1, 4), st.floats(0, 2))
def test_what_is_explained_of_w_is_its_regression(seed, number, sites, strength):
    """By the normal equations; the share beyond chance by the adjusted coefficient of determination."""
    rng = np.random.default_rng(seed)
    u = torch.from_numpy(rng.uniform(size=(number, sites)))
    w = strength * np.sin(6 * u[:, 0].numpy()) + rng.normal(size=number)
    x, y = np.concatenate([basis(one) for one in u.unbind(1)], 1), w - w.mean()
    v, sure = explained_part(u, w)
    assert v == pytest.approx(x @ np.linalg.solve(x.T @ x, x.T @ y), abs=1e-6)
    determined, freedom = 1 - np.square(y - v).sum() / np.square(y).sum(), number - 4 * sites - 1
    adjusted = 1 - (1 - determined) * (number - 1) / freedom
    assert sure**2 == pytest.approx(max(0, adjusted / determined), abs=1e-6)


@pytest.mark.parametrize(("number", "w"), [(50, lambda u: 0 * u + 3), (5, lambda u: u), (1, lambda u: u)])
def test_nothing_is_explained_surely_of_one_value_or_of_few_scenes(number, w):
    u = torch.from_numpy(np.random.default_rng(0).uniform(size=(number, 2)))
    assert explained_part(u, w(u[:, 0].numpy()))[1] == 0


def test_noise_is_mostly_known_for_what_it_is():
    rng, found = np.random.default_rng(0), []
    for _ in range(300):
        found.append(explained_part(torch.from_numpy(rng.uniform(size=(500, 9))), rng.normal(size=500))[1])
    assert np.mean(np.square(found)) < 0.2 and np.mean(np.array(found) == 0) > 0.4


@given(seeds, st.floats(0, 20), st.floats(30, 200), st.floats(0, 25))
def test_what_is_plainly_said_is_so(seed, noise, light, tint):
    """Of a grey wall under noise, tinted red."""
    rng = np.random.default_rng(seed)
    wall = np.stack([np.full((60, 80), light + tint), np.full((60, 80), light), np.full((60, 80), light)])
    image = (wall + noise * rng.normal(size=(1, 60, 80))).clip(0, 255).round().astype(np.uint8)
    said = image_statistics(torch.from_numpy(image)[None])[0].numpy()
    assert said[:3] == pytest.approx(image.mean((1, 2)) / 255, abs=1e-5)
    assert said[3:6] == pytest.approx(image.std((1, 2)) / 255, abs=1e-5)
    assert said[6:14].mean() == pytest.approx(image.mean() / 255, abs=0.01)
    most, least = image.max(0).astype(float), image.min(0)
    assert said[14] == pytest.approx(((most - least) / np.maximum(most, 1)).mean(), abs=1e-4)
    grey = image.mean(0) / 255
    edges = np.abs(np.diff(grey, axis=0)).mean() + np.abs(np.diff(grey, axis=1)).mean()
    assert said[15] == pytest.approx(10 * edges, abs=1e-4)
    if 2 < noise and 70 < light < 170 - tint:  # nothing is cut off
        assert said[16] == pytest.approx(10 * noise / 255, rel=0.1)
    grey_image = torch.from_numpy(image[:1])[None]
    assert torch.equal(image_statistics(grey_image), image_statistics(grey_image.expand(-1, 3, -1, -1)))


@given(seeds, st.integers(2, 80))
def test_what_structure_explains_is_left_out(seed, number):
    rng = np.random.default_rng(seed)
    kind = torch.from_numpy(rng.integers(-1, 3, (number, 5)))
    w = rng.normal(size=number) + 3 * (kind == 1).sum(1).numpy() - 2 * (kind == 2).any(1).numpy()
    left = without_structure(kind, w)
    for k in (0, 1, 2):
        assert abs(left @ (kind == k).sum(1).numpy()) < 1e-6 and abs(left @ (kind == k).any(1).numpy()) < 1e-6
    assert abs(left.sum()) < 1e-6
    of_structure = 4 * (kind == 0).sum(1).numpy() + 1.0
    assert without_structure(kind, of_structure) == pytest.approx(np.zeros(number), abs=1e-8)


@given(seeds)
def test_the_witness_is_the_derivative_of_the_distance_by_a_scene_s_weight(seed):
    """By finite differences of the distance as a loop computes it, up to the same number for all scenes."""
    rng = np.random.default_rng(seed)
    own, real = rng.normal(size=(12, 3)), rng.normal(size=(9, 3)) + 1
    w, apart = witness(own, real)

    def squared(weight):
        across = sum(p * np.linalg.norm(x - r) / len(real) for p, x in zip(weight, own, strict=True) for r in real)
        pairs = ((p * q, x, y) for p, x in zip(weight, own, strict=True) for q, y in zip(weight, own, strict=True))
        return 2 * across - sum(p * np.linalg.norm(x - y) for p, x, y in pairs)

    even, slope = np.full(12, 1 / 12), []
    for i in range(12):
        step = np.eye(12)[i] * 1e-4
        slope.append((squared(even + step) - squared(even - step)) / 2e-4)
    among = np.linalg.norm(own[:, None] - own, axis=-1).sum(1)
    of_real = np.linalg.norm(real[:, None] - real, axis=-1).sum()
    unit = of_real / 9 / 8
    biased = unit * w + among / 11 - among / 12  # w leaves each scene itself out
    assert 2 * (biased - biased.mean()) == pytest.approx(np.array(slope) - np.mean(slope), abs=1e-6)
    self_pairs = among.sum() / 12**2 / 11 + of_real / 9**2 / 8
    assert unit * apart + self_pairs == pytest.approx(energy_distance(own, real) ** 2, abs=1e-9)


def test_a_site_that_says_nothing_of_w_depends_on_it_by_chance_alone():
    """As the chi-squared distribution has it; the last site is of one value."""
    rng, found = torch.Generator().manual_seed(0), []
    for _ in range(400):
        u = torch.rand(300, 3, generator=rng)
        u[:, 2] = 0.3
        w = torch.randn(300, generator=rng) * torch.where(torch.arange(300) < 100, 3.0, 0.3)
        found.append(dependence(u, w.numpy()))
    found = torch.stack(found).numpy()
    assert (found[:, 2] == 0).all()
    for i in range(2):
        assert (found[:, i, 1] == 4).all() and kstest(found[:, i, 0], chi2(4).cdf).pvalue > 1e-3


@pytest.mark.parametrize("how", [lambda u: u, lambda u: (u - 0.5).square(), lambda u: (2 * torch.pi * u).sin()])
def test_a_site_that_w_depends_on_is_seen(how):
    torch.manual_seed(0)
    u = torch.rand(300, 2)
    w = (how(u[:, 0]) + 0.1 * torch.randn(300)).numpy()
    number, freedom = dependence(u, w).unbind(1)
    assert chi2.sf(number[0], freedom[0]) < 1e-3 < chi2.sf(number[1], freedom[1])


@pytest.fixture(scope="module")
def learning(trays):
    """Begins to learn from trays in bright light, by the brightest of each colour in images."""
    label = partial(_labels, SpriteRenderer(trays.canvas), class_table(trays.grammar.kinds, trays.classes))

    def look(images):
        return images.amax((2, 3)) / 255

    class Bright(Messenger):
        def _pyro_sample(self, msg):
            if msg["name"] == "scene.bright" and msg["value"] is None:
                msg["value"] = 0.85 + 0.1 * torch.rand(msg["fn"].batch_shape)

    seed_everything(3)
    real = look(label(sample(with_handlers(trays, Bright()), trays.prior, 150)).image)
    schedule = TiltingSchedule(rounds=8, first=300, scenes=120, steps=30, rate=0.02)
    return lambda: TiltingLearning(trays, trays.prior, label, (look,), (real,), schedule)


def test_what_images_show_is_learnt_and_what_they_do_not_show_is_not(learning, trays):
    whole, apart = learning(), []
    whole.run(lambda _, told: apart.append(told["loss"]))
    assert apart[-1] < 0.5 * apart[0]
    assert [site.name for site in whole.learnt] == ["scene.bright"]
    seed_everything(0)
    bright = sample(whole.guide.with_parameters(trays), trays.prior, 200).parameters["scene.bright"]
    assert 0.79 < float(bright.mean()) < 0.98  # 0.7 in the prior, 0.9 in the target
    turns = []
    for model in (whole.guide.with_parameters(trays), trays):
        seed_everything(0)
        turns.append(sample(model, trays.prior, 20).parameters["floor.turn"])
    assert torch.equal(*turns)


def test_it_goes_on_to_the_same_bits(learning):
    class Interrupted(Exception):
        pass

    def interrupt(training, _):
        if training.done == 2:
            raise Interrupted

    whole, first, second = learning(), learning(), learning()
    whole.run()
    with pytest.raises(Interrupted):
        first.run(interrupt)
    second.restore(first.state())
    second.run()
    assert second.learnt == whole.learnt and second.done == second.total
    for one, other in zip(whole.guide.net.parameters(), second.guide.net.parameters(), strict=True):
        assert torch.equal(one, other)


def _labels(render, classes, scenes):
    return examples(render(scenes.drawing), classes)


class LargeBalls(Messenger):
    """Balls of the largest third of the prior's sizes."""

    def _pyro_sample(self, msg):
        if msg["name"] == "ball.size" and msg["value"] is None:
            msg["value"] = 3.3 + 0.7 * torch.rand(msg["fn"].batch_shape)


def from_objects(trays, handlers, images):
    """Learning that knows the objects of some images, and of whole images nothing."""
    label = partial(_labels, SpriteRenderer(trays.canvas), class_table(trays.grammar.kinds, trays.classes))
    seed_everything(5)
    drawn = label(sample(with_handlers(trays, *handlers), trays.prior, images))
    schedule = TiltingSchedule(rounds=6, first=300, scenes=150, steps=40, rate=0.02)
    real = (torch.rand(40, 1),)
    return TiltingLearning(
        trays, trays.prior, label, (lambda x: torch.rand(len(x), 1),), real, schedule, 0, objects_of(drawn)
    )


def test_labelled_objects_move_the_sites_that_they_go_by(trays):
    learning = from_objects(trays, [LargeBalls()], 15)
    learning.run()
    assert "ball.size" in [site.name for site in learning.learnt]
    seed_everything(0)
    scenes = sample(learning.guide.with_parameters(trays), trays.prior, 300)
    size = scenes.parameters["ball.size"][scenes.site_mask["ball.size"]]
    print([site.name for site in learning.learnt], size.mean(), size.std())
    assert 3.4 < float(size.mean()) < 3.9 and float(size.std()) < 0.45
