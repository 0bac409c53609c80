"""Meta-Sim's way: the graph network's transform, derivatives through a renderer, both of its losses."""

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from probscene.drawing import Sprites
from probscene.grammar import Grammar
from probscene.inference.features.base import class_table, examples
from probscene.inference.parameters.meta_sim.differences import At, Differences, SampledScenes, with_values
from probscene.inference.parameters.meta_sim.discrepancy import SCALES, Discrepancy
from probscene.inference.parameters.meta_sim.learning import MetaSimLearning
from probscene.inference.parameters.meta_sim.presence_task import PresenceTask
from probscene.inference.parameters.meta_sim.schedule import MetaSimSchedule
from probscene.inference.parameters.meta_sim.task import TaskLearning
from probscene.inference.parameters.meta_sim.transform import ParameterTransform
from probscene.inference.parameters.sites import find_sites, quantiles_of, with_handlers
from probscene.model import scene_model
from probscene.renderers.sprites import SpriteRenderer
from probscene.sampling import run_program, sample, seed_everything
from probscene.structure import StructurePrior, counts

NAMES = ("scene.bright", "tray.x", "tray.y", "ball.away", "ball.size", "ball.shade")
DOTS = Grammar("Scene -> Dots\nDots -> Dot Dots | ε\nDot -> red | blue")


@scene_model(DOTS, StructurePrior(DOTS, Dots=counts(0, 3, 1)), canvas=(64, 64), max_steps=12, classes=("red", "blue"))
def dots(scene):
    """One dot anywhere, or two."""
    with scene.nodes("red", "blue"):
        x = pyro.sample("x", dist.Uniform(8.0, 56.0))
        y = pyro.sample("y", dist.Uniform(8.0, 56.0))
    red, blue = (1.0, 0.2, 0.2), (0.2, 0.2, 1.0)
    return scene.draw(
        Sprites.disc("red", x, y, radius=5.0, tint=red), Sprites.disc("blue", x, y, radius=5.0, tint=blue)
    )


def transform_of(model, names=NAMES, spread=0.3, seed=0):
    """A transform of some sites, with random weights; as it begins where the spread is 0."""
    torch.manual_seed(seed)
    sites = tuple(site for site in find_sites(model) if site.name in names)
    made = ParameterTransform(model, sites, hidden=12, rounds=2)
    for parameter in made.net.parameters() if spread else ():
        torch.nn.init.normal_(parameter, std=spread)
    return made.eval()


def drawn(model, number=40, seed=0):
    seed_everything(seed)
    with torch.no_grad():
        return sample(model, model.prior, number)


@settings(max_examples=10)
@given(st.integers(0, 2**31), st.booleans())
def test_it_begins_as_the_identity(trays, seed, all_zero):
    transform = transform_of(trays, spread=0)
    for parameter in transform.net.parameters() if all_zero else ():
        torch.nn.init.zeros_(parameter)
    one, other = drawn(trays, seed=seed), drawn(transform.with_parameters(trays), seed=seed)
    assert torch.equal(one.derivation.rules, other.derivation.rules)
    quantiles, again = quantiles_of(trays, one), quantiles_of(trays, other)
    for name, value in one.parameters.items():
        # There and back through u in float32: near 0 and 1 one step of it is a large one of the value.
        u = quantiles.get(name, torch.full_like(value, 0.5))
        assert torch.allclose(u, again.get(name, u), atol=3e-6, equal_nan=True), name
        inner = u.isnan() | ((u > 1e-3) & (u < 1 - 1e-3))
        assert torch.allclose(value[inner], other.parameters[name][inner], atol=2e-3), name


def test_sites_that_are_not_learnt_draw_the_priors_very_numbers(trays):
    moved, prior = drawn(transform_of(trays, ("tray.x", "ball.away")).with_parameters(trays)), drawn(trays)
    for name, value in prior.parameters.items():
        assert torch.equal(value, moved.parameters[name]) == (name not in ("tray.x", "ball.away")), name
    has = prior.site_mask["tray.x"]
    assert torch.equal(prior.parameters["tray.x"][~has], moved.parameters["tray.x"][~has])


def test_the_program_moves_what_the_network_moves_at_once(trays):
    """Site by site as the program runs, or all sites of scenes that are drawn: the same values."""
    transform = transform_of(trays)
    scenes = drawn(transform.with_parameters(trays))
    seed_everything(0)
    before = SampledScenes.sample(trays, trays.prior, transform.sites, 40)
    with torch.no_grad():
        moved = [x.sigmoid() for x in transform.net(before.graph, before.of_scene, before.of_nodes)]
    again = with_values(trays, transform.sites, before, *moved)
    assert torch.equal(scenes.derivation.rules, again.derivation.rules)
    for name, value in scenes.parameters.items():
        has = scenes.site_mask[name]
        assert torch.allclose(value[has], again.parameters[name][has], atol=5e-3), name


def test_a_site_does_not_see_those_after_it(trays):
    transform = transform_of(trays)
    before = SampledScenes.sample(trays, trays.prior, transform.sites, 20)
    with torch.no_grad():
        scene, nodes = transform.net(before.graph, before.of_scene, before.of_nodes)
        changed = before.of_nodes.clone()
        changed[..., 3:] = (changed[..., 3:] + 0.3).remainder(1.0)  # ball.size and what comes after it
        again = transform.net(before.graph, before.of_scene, changed)
    assert torch.equal(scene, again[0]) and torch.equal(nodes[..., :3], again[1][..., :3])
    there = ~before.of_nodes[..., 3].isnan()
    assert not torch.equal(nodes[..., 3][there], again[1][..., 3][there])


def test_padding_moves_nothing(trays):
    """A scene's values do not depend on how many nodes the others have."""
    transform = transform_of(trays)
    before = SampledScenes.sample(trays, trays.prior, transform.sites, 30)
    with torch.no_grad():
        _, whole = transform.net(before.graph, before.of_scene, before.of_nodes)
        for n in range(30):
            M = max(1, int((before.class_nodes.kind[n] >= 0).sum()))
            graph = type(before.graph)(*(part[n : n + 1, :M] for part in before.graph))
            _, alone = transform.net(graph, before.of_scene[n : n + 1], before.of_nodes[n : n + 1, :M])
            assert torch.allclose(alone[0], whole[n, :M], atol=1e-5)


def looked_at(values, mask):
    """Smooth features ``(N, 6)`` of the values of some sites."""
    parts = []
    for i, name in enumerate(NAMES):
        unit = {"tray": 20.0, "ball": 4.0, "scene": 0.3}[name.split(".")[0]]
        value = (values[name] / unit).where(mask[name], 0.0)
        parts.append(torch.sin(value + i).where(mask[name], 0.0).sum(1) + value.square().sum(1))
    return torch.stack(parts, 1)


def differentiated(trays, seed=0, most=None):
    """Scenes, u somewhere, and the derivative of a cost by finite differences and by autograd."""
    sites = tuple(site for site in find_sites(trays) if site.name in NAMES)
    seed_everything(seed)
    before = SampledScenes.sample(trays, trays.prior, sites, 12)
    scene, nodes = (0.1 + 0.8 * torch.rand_like(u) for u in (before.of_scene, before.of_nodes))
    ways = torch.randn(12, len(NAMES))

    def embed(scenes):
        return looked_at(scenes.parameters, scenes.site_mask)

    found = Differences(trays, sites, embed, 0.01, most).gradient(before, scene, nodes, ways)
    base = with_values(trays, sites, before, scene, nodes)
    for values in (scene, nodes):
        values.requires_grad_()
    u, empty = {}, torch.full(before.class_nodes.place.shape, torch.nan)
    for site in sites:
        column = [other.name for other in sites if other.of_scene == site.of_scene].index(site.name)
        u[site.name] = (
            scene[:, column : column + 1] if site.of_scene else before.class_nodes.scatter(nodes[..., column], empty)
        )
        u[site.name] = u[site.name].where(base.site_mask[site.name], torch.nan)
    with pyro.poutine.trace() as trace, pyro.poutine.condition(data=before.derivation.sites()):
        with_handlers(trays, At(u, before.parameters))(12)
    values = {name: node["value"] for name, node in trace.trace.nodes.items() if name in NAMES}
    cost = (looked_at(values, base.site_mask) * ways).sum()
    return found, torch.autograd.grad(cost, [scene, nodes])


@pytest.mark.parametrize("seed", [0, 1])
def test_finite_differences_are_autograds_derivatives(trays, seed):
    for found, wanted in zip(*differentiated(trays, seed), strict=True):
        assert float(wanted.abs().max()) > 0.5
        assert torch.allclose(found, wanted, atol=2e-2, rtol=2e-2)


def test_some_values_are_unbiased(trays):
    wanted = differentiated(trays)[1]
    for some, whole in zip(differentiated(trays, most=20)[0], wanted, strict=True):
        chosen = some != 0
        number = sum(int((part != 0).sum()) for part in wanted)
        assert torch.allclose(some[chosen] * 20 / number, whole[chosen], atol=3e-2, rtol=3e-2)
    assert sum(int((part != 0).sum()) for part in differentiated(trays, most=20)[0]) == 20


@given(st.integers(0, 2**31), st.integers(2, 6), st.integers(2, 7))
def test_the_discrepancy_is_a_slow_twins(seed, N, L):
    rng = np.random.default_rng(seed)
    generated, real = rng.normal(size=(N, 3)), rng.normal(1.0, 2.0, size=(L, 3))
    unit = np.mean([[((x - y) ** 2).sum() for y in real] for x in generated])

    def kernel(x, y):
        return np.mean([np.exp(-0.5 * ((x - y) ** 2).sum() / (scale * unit)) for scale in SCALES])

    own, other = (
        np.mean([kernel(x, y) for i, x in enumerate(a) for j, y in enumerate(a) if i != j]) for a in (generated, real)
    )
    wanted = own + other - 2 * np.mean([[kernel(x, y) for y in real] for x in generated])
    found = Discrepancy(torch.tensor(real))(torch.tensor(generated))
    assert float(found) == pytest.approx(wanted, abs=1e-9)


def test_the_discrepancy_tells_samples_apart():
    torch.manual_seed(0)
    cost = Discrepancy(torch.randn(400, 3))
    assert abs(float(cost(torch.randn(400, 3)))) < 0.01 < 0.1 < float(cost(torch.randn(400, 3) + 2.0))


def places(images):
    """The middle of what is bright, ``(N, 2)`` in 0..1."""
    light = images.double().sum(1)
    along = torch.arange(64.0).double() + 0.5
    x, y = (light * along).sum((1, 2)), (light * along[:, None]).sum((1, 2))
    return torch.stack([x, y], 1).div(64 * light.sum((1, 2), keepdim=True)[:, 0].clamp(min=1)).float()


def learning(steps, seed=3):
    """Dots anywhere, whose images are to be those of dots around (44, 20)."""
    render = SpriteRenderer((64, 64), threads=1)
    torch.manual_seed(1)
    real = (torch.tensor([44.0, 20.0]) + 2.0 * torch.randn(100, 2)) / 64
    schedule = MetaSimSchedule(steps=steps, scenes=16, rate=1e-2, values=None, hidden=16, rounds=1)
    return MetaSimLearning(dots, dots.prior, lambda scenes: places(render(scenes.drawing).image), real, schedule, seed)


def test_what_images_show_is_learnt():
    training = learning(30)
    training.run()
    assert training.guide is not None and training.learnt == training.sites
    far = []
    for model in (dots, training.guide.with_parameters(dots)):
        scenes = drawn(model, 300)
        off = (scenes.parameters["x"] - 44).abs() + (scenes.parameters["y"] - 20).abs()
        far.append(float(off[scenes.site_mask["x"]].mean()))
    assert far[1] < 0.25 * far[0]


def interrupted(make):
    """Two trainings that end: one in one go, one that was stopped and taken up by another."""

    class Stopped(Exception):
        pass

    def stop(training, _):
        if training.done == 3:
            raise Stopped

    whole, first, second = make(), make(), make()
    whole.run()
    with pytest.raises(Stopped):
        first.run(stop)
    second.restore({key: value.clone() for key, value in first.state().items()})
    second.run()
    assert second.done == second.total == whole.done > 3
    return whole, second


def test_matching_goes_on_to_the_same_bits():
    whole, second = interrupted(lambda: learning(6))
    pairs = zip(whole.guide.net.parameters(), second.guide.net.parameters(), strict=True)
    assert all(torch.equal(one, other) for one, other in pairs)


def near(scenes):
    """A score that is higher the nearer dots are to the left."""
    return -float(scenes.parameters["x"][scenes.site_mask["x"]].mean()) / 48


def by_score(steps, score=near):
    transform = transform_of(dots, ("x", "y"), spread=0)
    return TaskLearning(transform, score, steps, scenes=6, spread=0.5, rate=1e-2)


def test_a_tasks_score_is_raised():
    training = by_score(100)
    before = near(drawn(training.guide.with_parameters(dots), 400))
    heard = []
    training.run(lambda _, line: heard.append(-line["loss"]))
    assert near(drawn(training.guide.with_parameters(dots), 400)) > before + 0.2
    assert sum(heard[-20:]) > sum(heard[:20]) + 20 * 0.2 and training.summary()["score"] > before


def test_a_score_that_tells_nothing_moves_nothing():
    training = by_score(20, lambda scenes: 0.7)
    before = [parameter.clone() for parameter in training.guide.net.parameters()]
    training.run()
    assert all(torch.equal(a, b) for a, b in zip(before, training.guide.net.parameters(), strict=True))


def test_a_score_goes_on_to_the_same_bits():
    whole, second = interrupted(lambda: by_score(6))
    pairs = zip(whole.guide.net.parameters(), second.guide.net.parameters(), strict=True)
    assert whole.baseline == second.baseline and all(torch.equal(one, other) for one, other in pairs)


def test_the_task_is_learnt_from_scenes():
    """Scenes with red and blue dots say which a target shows; scenes that lack one of them do not."""
    render, table = SpriteRenderer((64, 64), threads=1), class_table(DOTS.kinds, ("red", "blue"))

    def label(scenes):
        return examples(render(scenes.drawing), table)

    target = label(drawn(dots, 40, seed=7))
    shown = torch.stack([(target.label == c).any(1) for c in (0, 1)], 1)
    task = PresenceTask(label, target.image, shown)
    both = drawn(dots, 200, seed=1)
    red = (both.derivation.kind != DOTS.kind("blue")).all(1)
    values = {name: value[red] for name, value in both.parameters.items()}
    assert task(both) > 0.9
    assert task(run_program(dots, both.derivation[red], values)) < 0.7


def test_u_of_moved_values_is_what_they_were_moved_to(trays):
    sites = tuple(site for site in find_sites(trays) if site.name in NAMES)
    seed_everything(0)
    before = SampledScenes.sample(trays, trays.prior, sites, 20)
    scene, nodes = torch.rand_like(before.of_scene), torch.rand_like(before.of_nodes)
    found = quantiles_of(trays, with_values(trays, sites, before, scene, nodes))
    taken = before.class_nodes.gather(found["ball.shade"])
    there = ~taken.isnan() & (before.class_nodes.kind >= 0)
    assert there.any() and torch.allclose(taken[there], nodes[..., -1][there], atol=1e-3)
