"""What a reader says, and what is made of it."""

from functools import partial

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import truncnorm

from probscene.derivation import expand
from probscene.errors import ModelError
from probscene.grammar import Grammar
from probscene.inference.features.base import class_table, examples
from probscene.inference.features.counting.batches import STRIDE as CELL
from probscene.inference.features.counting.batches import cells
from probscene.inference.parameters.graph import ClassNodes, SceneGraph
from probscene.inference.parameters.reader import (
    Detections,
    find_objects,
    harmonics,
    normal,
    truncated_mean,
    truncated_quantile,
)
from probscene.inference.parameters.scene_graph_builder import fit_scene_graph_builder, order_by_variance
from probscene.inference.parameters.sites import Site, find_sites
from probscene.inference.parameters.skill import CIRCLE, LINE, TWICE, Skill
from probscene.inference.parameters.supervised_renders import SupervisedRenders, concatenate
from probscene.renderers.sprites import SpriteRenderer
from probscene.sampling import sample, seed_everything

seeds = st.integers(0, 2**31)


@given(st.floats(-0.5, 1.5), st.floats(0.02, 1.5), st.floats(0.001, 0.999))
def test_cut_normal_distributions_are_scipys(mean, sd, v):
    low, high = -mean / sd, (1 - mean) / sd
    if not -3 < low < 3 and not -3 < high < 3:
        return  # nearly nothing of it lies between 0 and 1
    reference = truncnorm(low, high, mean, sd)
    one, other = torch.tensor(mean).double(), torch.tensor(sd).double()
    assert float(truncated_mean(one, other)) == pytest.approx(reference.mean(), abs=1e-3)
    assert float(truncated_quantile(one, other, torch.tensor(v).double())) == pytest.approx(reference.ppf(v), abs=5e-3)


@given(st.floats(-2.0, 3.0), st.floats(-8.0, 8.0))
def test_what_a_reader_says_can_always_change(mean, log_sd):
    """Whatever it says: what is cut off has no gradient, and stays."""
    output = torch.tensor([mean, log_sd, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64, requires_grad=True)
    said = normal(output)
    for part, at in zip(said, (0, 1), strict=True):
        (slope,) = torch.autograd.grad(part, output, retain_graph=True)
        assert float(slope[at]) > 1e-6
    assert -1 < float(said[0].detach()) < 2 and 0 < float(said[1].detach()) < 0.5


@given(seeds, st.integers(0, 12))
def test_objects_apart_are_all_found(seed, number):
    rng = np.random.default_rng(seed)
    centre = []
    for _ in range(200):
        at = rng.uniform(1.5, 18.5, 2)
        if len(centre) < number and all(np.abs(at - other).max() >= 3 for other in centre):
            centre.append(at)
    places = torch.tensor(np.array(centre).reshape(1, -1, 2), dtype=torch.float32)
    label = torch.zeros(places.shape[:2], dtype=torch.int64)
    mass = cells(places * CELL, label, 1, 20, 20)[:, 1]
    n, y, x, inside = find_objects(mass, 0.4)
    assert len(n) == len(centre)
    found = {(int(i), int(j)) for i, j in zip(x, y, strict=True)}
    wanted = {tuple(np.floor(at - 0.5).astype(int).tolist()) for at in centre}
    assert all(any(abs(i - a) <= 1 and abs(j - b) <= 1 for i, j in found) for a, b in wanted)


def test_objects_come_image_by_image():
    mass = torch.zeros(3, 6, 6)
    mass[0, 1, 1] = mass[2, 4, 4] = mass[2, 1, 1] = 1.0
    assert find_objects(mass, 0.4)[0].tolist() == [0, 2, 2] and len(find_objects(torch.zeros(2, 6, 6), 0.4)[0]) == 0


def said(u, error=0.02, way=LINE):
    """What a reader would say that reads a site in one way alone."""
    rng = torch.Generator().manual_seed(0)
    noisy = u + error * torch.randn(len(u), generator=rng)
    raw = torch.zeros(len(u), 1, 6)
    raw[:, 0, 0], raw[:, 0, 1] = 0.5, -1.2
    if way == LINE:
        raw[:, 0, 0], raw[:, 0, 1] = noisy, np.log(error)
    if way == CIRCLE:
        raw[:, 0, 2:] = harmonics(noisy) * 0.98
    if way == TWICE:
        raw[:, 0, 4:] = harmonics(noisy)[:, 2:] * 0.98
    return raw


@pytest.mark.parametrize("way", [LINE, CIRCLE, TWICE])
def test_the_way_is_found_and_read(way):
    u = torch.rand(600, generator=torch.Generator().manual_seed(1))
    raw = said(u, way=way)
    skill = Skill.from_readings(raw, u[:, None])
    assert skill.geometry.tolist() == [way] and float(skill.explained) > 0.9 and bool(skill.readable)
    mean, sd = skill.read(raw)
    apart = (mean[:, 0] - u).abs()
    apart = torch.minimum(apart, 1 - apart) if way != LINE else apart
    apart = torch.minimum(apart, 0.5 - apart).abs() if way == TWICE else apart
    assert float(apart.mean()) < 0.03 and float(sd.mean()) < 0.1


def test_an_interval_of_which_some_readings_say_nothing_is_no_circle():
    """Wrong by more than a half is wrong by less than a half on a circle; the standard deviation is said too wide."""
    rng = torch.Generator().manual_seed(2)
    u, other = torch.rand(2, 2000, generator=rng)
    read = torch.where(torch.rand(2000, generator=rng) < 0.2, other, u)
    raw = said(read, 0.1)
    raw[:, 0, 1] = np.log(0.3)
    raw[:, 0, 2:] = harmonics(raw[:, 0, 0]) * 0.8
    skill = Skill.from_readings(raw, u[:, None])
    assert skill.geometry.tolist() == [LINE] and float(skill.explained) > 0.4


def test_what_says_nothing_is_not_readable():
    u = torch.rand(600, generator=torch.Generator().manual_seed(1))
    raw = said(u, way=LINE)[torch.randperm(600, generator=torch.Generator().manual_seed(2))]
    assert not Skill.from_readings(raw, u[:, None]).readable.any()
    assert not Skill.from_readings(raw, torch.full((600, 1), torch.nan)).readable.any()


@given(seeds, st.integers(0, 40))
def test_what_is_the_same_for_all_says_nothing_however_few_they_are(seed, number):
    rng = torch.Generator().manual_seed(seed)
    u, raw = torch.rand(number, 1, generator=rng), torch.randn(1, 1, 6, generator=rng).expand(number, 1, 6)
    share = Skill.from_readings(raw, u).explained
    assert share.isnan().all() if number < 2 else float(share) < 0.05


def test_a_site_that_few_objects_have_is_hardly_ever_read_by_chance():
    torch.manual_seed(0)
    readable = [bool(Skill.from_readings(torch.randn(20, 1, 6), torch.rand(20, 1)).readable) for _ in range(500)]
    assert sum(readable) < 5


def test_skill_is_the_share_of_the_variance_that_is_explained():
    u = torch.rand(20_000, generator=torch.Generator().manual_seed(1))
    for error in (0.02, 0.06):
        share = float(Skill.from_readings(said(u, error), u[:, None]).explained)
        assert share == pytest.approx(1 - 12 * error**2, abs=0.01)


def test_graphs_are_those_that_were_drawn(trays):
    """From the true places of the nodes, and with them as what a reader finds, come the scenes' own graphs."""
    seed_everything(0)
    scenes = sample(trays, trays.prior, 60)
    derivation = scenes.derivation.trimmed()
    seen = ClassNodes.from_derivation(trays.grammar, trays.classes, derivation)
    place = torch.rand(*seen.kind.shape, 2) * 60
    place[..., 0] = place[..., 0].sort(1).values  # siblings go from the left to the right
    group = seen.gather(derivation.parent)
    made = fit_scene_graph_builder(
        trays.grammar, trays.classes, SceneGraph.from_nodes(seen.kind, seen.parent), place, group
    )
    n, m = (seen.kind >= 0).nonzero(as_tuple=True)
    label = torch.tensor([trays.classes.index(trays.grammar.kinds[k]) for k in seen.kind[n, m].tolist()])
    parent = seen.parent[n, m]
    shuffled = torch.randperm(len(n))
    found = Detections(
        n[shuffled],
        torch.ones(len(n)),
        label[shuffled],
        place[n, m][shuffled],
        place[n, parent.clamp(min=0)][shuffled],
        torch.zeros(len(n), 0, 6),
        torch.zeros(60, 0, 6),
    )
    u = torch.rand(len(n), 2)
    kind, found_parent, mean, _ = order_by_variance(made, found).values(found, 60, u[shuffled], u[shuffled])
    assert torch.equal(kind, seen.kind[:, : kind.shape[1]]) and torch.equal(found_parent, seen.parent)
    assert torch.equal(mean[n, m], u)


def test_siblings_of_groups_that_cannot_be_seen_come_in_any_order():
    """Below two lanes that have no class, cars' order says nothing; below one it is that along the image."""
    for text, any_order in (("Scene -> left(Cars) right(Cars) sun", True), ("Scene -> left(Cars) sun", False)):
        grammar = Grammar(f"{text}\nCars -> car car car")
        derivation = expand(grammar, lambda t, frontier, previous: frontier[0], 20, 4)
        seen = ClassNodes.from_derivation(grammar, ("car", "sun"), derivation)
        place = torch.rand(20, seen.kind.shape[1], 2, generator=torch.Generator().manual_seed(0))
        group = seen.gather(derivation.parent)
        made = fit_scene_graph_builder(
            grammar, ("car", "sun"), SceneGraph.from_nodes(seen.kind, seen.parent), place, group
        )
        n, m = (seen.kind >= 0).nonzero(as_tuple=True)
        label = (seen.kind[n, m] == grammar.kind("sun")).long()
        nothing = torch.zeros(len(n), 0, 6)
        found = Detections(
            n, torch.ones(len(n)), label, place[n, m], torch.zeros(len(n), 2), nothing, torch.zeros(20, 0, 6)
        )
        made = order_by_variance(made, found)
        orders = []
        for seed in (0, 1):
            torch.manual_seed(seed)
            orders.append([[k for k, _ in scene] for scene in made.scenes(found, 20)])
            for scene in orders[-1]:
                assert sorted(scene) == list(range(min(scene), max(scene) + 1))
                assert label[scene[0]] == 1  # the sun comes first, whatever the cars do
        assert (orders[0] != orders[1]) == any_order


def test_batches_are_joined_as_they_are(model):
    """Each part's rows come back, padded to the most nodes."""
    classes = class_table(model.grammar.kinds, model.classes)
    render = SpriteRenderer(model.canvas)
    sites = {site.name: site for site in find_sites(model)}
    label = partial(_labels, render, classes)
    renders = SupervisedRenders(
        model, label, (sites["tray.x"], sites["ball.away"]), (sites["scene.bright"], sites["floor.turn"])
    )
    seed_everything(0)
    parts = [renders.draw(3, model.prior), renders.draw(5, model.prior)]
    whole = concatenate(parts)
    for part, rows in zip(parts, (slice(0, 3), slice(3, 8)), strict=True):
        M = part.parent.shape[1]
        assert torch.equal(whole.drawn.image[rows], part.drawn.image)
        assert torch.equal(whole.scene_u[rows], part.scene_u)
        for one, other in (
            (whole.parent, part.parent),
            (whole.group, part.group),
            (whole.drawn.label, part.drawn.label),
        ):
            assert torch.equal(one[rows, :M], other) and (one[rows, M:] == -1).all()
        assert torch.equal(whole.u[rows, :M].nan_to_num(-1), part.u.nan_to_num(-1)) and whole.u[rows, M:].isnan().all()


def test_a_site_that_a_call_leaves_out_is_named(trays):
    label = partial(_labels, SpriteRenderer(trays.canvas), class_table(trays.grammar.kinds, trays.classes))
    with pytest.raises(ModelError, match=r"site 'tray\.gone' in every call of the program of model 'trays'"):
        SupervisedRenders(trays, label, (Site("tray.gone", ("tray",)),), ()).draw(3, trays.prior)


def _labels(render, classes, scenes):
    return examples(render(scenes.drawing), classes)
