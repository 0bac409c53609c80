"""Refinement by an energy distance of readings."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from probscene.inference.parameters.energy import (
    EnergyDistance,
    GuideReadings,
    WeightedEnergyDistance,
    WeightedRows,
    energy_distance,
    reparameterised_readings,
)
from probscene.inference.parameters.graph import SceneGraph
from probscene.inference.parameters.likelihood import Values
from probscene.inference.parameters.net import ParameterNet
from probscene.sampling import seed_everything

SITES = 2
ALL = (True,) * (SITES + 1)


def values_of(nodes, scene, turns=(False,) * (SITES + 1)):
    """Readings of chains of siblings, of one kind."""
    number, most = nodes.shape[:2]
    kind, parent = torch.zeros(number, most, dtype=torch.int64), torch.full((number, most), -1)
    return Values(
        kind, parent, nodes, torch.full_like(nodes, 0.05), scene, torch.full_like(scene, 0.05), torch.tensor(turns)
    )


def random_net(seed=0, spread=0.4):
    torch.manual_seed(seed)
    net = ParameterNet(1, SITES, 1, hidden=12, before=(1, 1))
    for parameter in net.parameters():
        torch.nn.init.normal_(parameter, std=spread)
    return net.double()


def drawn(net, number, nodes=3, quantiles=None):
    """u of a guide's scenes, with gradients where they are on."""
    kind, parent = torch.zeros(number, nodes, dtype=torch.int64), torch.full((number, nodes), -1)
    graph = SceneGraph.from_nodes(kind, parent)
    v = torch.rand(number, nodes * SITES + 1).double() if quantiles is None else quantiles
    scene = net.scene_mixture(graph, torch.full((number, 1), torch.nan).double(), 0).icdf(v[:, :1])
    values = torch.full((number, nodes, SITES), torch.nan).double()
    for s in range(SITES):
        part = v[:, 1 + s * nodes : 1 + (s + 1) * nodes]
        found = net.sample(graph, scene, values, s, part, kind >= 0)
        values = torch.cat([values[..., :s], found.unsqueeze(-1), values[..., s + 1 :]], -1)
    return graph, scene, values


def quantiles_of(net, graph, scene, values):
    """The mixtures of values, and at which quantiles of theirs these lie."""
    mixtures = [net.scene_mixture(graph, scene, 0), *(net.node_mixture(graph, scene, values, s) for s in range(SITES))]
    return mixtures, [m.cdf(u.logit()) for m, u in zip(mixtures, (scene, *values.unbind(2)), strict=True)]


@settings(max_examples=8)
@given(st.integers(0, 2**31))
def test_the_gradient_is_that_of_finite_differences(seed):
    """Of the energy distance of values at given quantiles of their mixtures, along a random direction of weights."""
    net = random_net()
    seed_everything(seed)
    graph, scene, nodes = (x if isinstance(x, SceneGraph) else x.detach() for x in drawn(net, 30))
    target = values_of(torch.rand(60, 3, SITES).double(), torch.rand(60, 1).double())
    direction = [torch.randn_like(parameter) for parameter in net.parameters()]

    @torch.no_grad()
    def found(step):
        for parameter, way in zip(net.parameters(), direction, strict=True):
            parameter += step * way
        mixtures, _ = quantiles_of(net, graph, scene, nodes)
        moved = [m.icdf(v) for m, v in zip(mixtures, at, strict=True)]
        for parameter, way in zip(net.parameters(), direction, strict=True):
            parameter -= step * way
        return energy_distance(values_of(torch.stack(moved[1:], 2), moved[0]), target)

    with torch.no_grad():
        _, at = quantiles_of(net, graph, scene, nodes)
    away = 1e-6  # a distance of two rows has a kink where they meet
    expected = float(found(away) - found(-away)) / (2 * away)
    read = values_of(nodes, scene)
    own = GuideReadings(read.kind, read.parent, nodes, scene, read, torch.arange(3).expand(30, 3))
    moved = reparameterised_readings(net, own, ALL)
    assert torch.equal(moved.nodes, nodes) and torch.equal(moved.scene, scene)
    energy_distance(moved, target).backward()
    slope = sum(
        float((p.grad * way).sum()) for p, way in zip(net.parameters(), direction, strict=True) if p.grad is not None
    )
    assert slope == pytest.approx(expected, rel=1e-3, abs=1e-6)


@settings(max_examples=20)
@given(st.integers(0, 2**31), st.floats(0.15, 0.3))
def test_the_distance_is_zero_for_one_distribution_and_no_other(seed, away):
    torch.manual_seed(seed)
    one, other = (values_of(0.3 + 0.2 * torch.rand(150, 2, SITES), 0.3 + 0.2 * torch.rand(150, 1)) for _ in range(2))
    shifted = one._replace(nodes=one.nodes + away)
    same, apart = (float(energy_distance(each, other)) for each in (one, shifted))
    assert abs(same) < 0.012 < apart


def test_a_circle_has_no_ends():
    torch.manual_seed(0)
    ends = values_of((0.1 * torch.rand(100, 1, SITES) - 0.05).remainder(1.0), torch.rand(100, 1))
    middle = values_of(0.1 * torch.rand(100, 1, SITES) + 0.01, ends.scene)
    turns = torch.ones(SITES + 1, dtype=torch.bool)
    line = float(energy_distance(middle, ends))
    assert float(energy_distance(middle._replace(turns=turns), ends._replace(turns=turns))) < 0.3 * line


def test_objects_that_were_not_drawn_do_not_move():
    net = random_net()
    graph, scene, nodes = (x if isinstance(x, SceneGraph) else x.detach() for x in drawn(net, 10))
    read = values_of(nodes, scene)
    which = torch.tensor([0, -1, 2]).expand(10, 3)
    found = reparameterised_readings(net, GuideReadings(graph.kind, graph.parent, nodes, scene, read, which), ALL)
    moves = torch.autograd.grad(
        found.nodes[:, 1].sum() + 0 * found.nodes.sum(), list(net.parameters()), allow_unused=True
    )
    assert all(gradient is None or not gradient.any() for gradient in moves)
    assert torch.equal(found.nodes, nodes)


@pytest.mark.parametrize("chosen", range(SITES + 1))
def test_a_site_moves_as_it_would_with_the_others_or_not_at_all(chosen):
    net = random_net()
    graph, scene, nodes = (x if isinstance(x, SceneGraph) else x.detach() for x in drawn(net, 10))

    def slopes(trained):
        of_scene, of_nodes = net.reparameterise(graph, scene, nodes, trained)
        assert torch.equal(of_scene, scene) and torch.equal(of_nodes, nodes)
        moved = torch.cat([of_nodes.flatten(0, 1), of_scene.repeat_interleave(3, 0)], 1)[:, chosen].sum()
        return torch.autograd.grad(moved, list(net.parameters()), allow_unused=True, materialize_grads=True)

    alone, others = (slopes([(site == chosen) == moves for site in range(SITES + 1)]) for moves in (True, False))
    assert all(torch.equal(one, all_) for one, all_ in zip(alone, slopes(ALL), strict=True))
    assert any(one.any() for one in alone) and not any(one.any() for one in others)


def test_errors_of_the_reader_are_taken_out():
    """A reader that halves every distance from the middle, and says that it is sure: likelihood believes it."""
    torch.manual_seed(0)
    net = ParameterNet(1, SITES, 1, hidden=12, before=(1, 1))
    drawn_values = 0.2 + 0.1 * torch.rand(300, 3, SITES)

    def read(u):
        return 0.5 + 0.5 * (u - 0.5)

    def own(number):
        with torch.no_grad():
            graph, scene, nodes = drawn(net.double(), number)
        net.float()
        nodes, scene = nodes.float(), scene.float()
        values = values_of(read(nodes), scene)
        return GuideReadings(graph.kind, graph.parent, nodes, scene, values, torch.arange(3).expand(number, 3))

    target = values_of(read(drawn_values), torch.rand(300, 1))
    noisy = torch.tensor([True, True, False])
    training = EnergyDistance(net, target, own, noisy, steps=200, scenes=60, learning_rate=3e-2)
    training.run()
    _, _, nodes = drawn(net.double(), 500)
    assert float(drawn_values.mean()) == pytest.approx(0.25, abs=0.01)
    assert float(nodes.detach().mean()) == pytest.approx(0.25, abs=0.06)  # what is read has a mean of .375


def test_a_site_alone_is_compared_by_its_objects_and_no_others():
    """Of nodes of two kinds, of which one has the site, and of scenes."""
    torch.manual_seed(0)
    read = values_of(torch.rand(80, 4, SITES), torch.rand(80, 1))
    kind = torch.tensor([0, 1, 0, 1]).expand(80, 4)
    read = read._replace(kind=kind, nodes=read.nodes.where((kind == 0).unsqueeze(-1), torch.nan))
    shifted = read._replace(nodes=read.nodes + torch.tensor([0.3, 0.0]), scene=read.scene + 0.3)
    found = [float(energy_distance(shifted.site(i), read.site(i))) for i in range(SITES + 1)]
    assert found[0] > 0.01 and found[2] > 0.01 and found[1] < 1e-6


def scenes_of(scene):
    """Readings of scenes without nodes, or what was drawn in them, ``(N, G)``."""
    kind, none = torch.full((len(scene), 1), -1), torch.zeros(len(scene), 1, 0)
    turns = torch.zeros(scene.shape[1], dtype=torch.bool)
    return Values(kind, kind, none, none, scene, torch.full_like(scene, 0.1), turns)


@given(st.integers(0, 2**31), st.integers(2, 40), st.integers(2, 40))
def test_weighted_renders_are_as_far_from_the_target_as_scipy_says(seed, number, images):
    rng = np.random.default_rng(seed)
    own, target, weight = rng.random((number, 2)), rng.random((images, 2)), rng.random(number) + 1e-3
    rows = WeightedRows.from_readings(*(scenes_of(torch.from_numpy(values)) for values in (own, target)), 1)
    weight /= weight.sum()
    expected = stats.energy_distance(own[:, 1], target[:, 1], weight) ** 2
    assert float(rows.distance(torch.from_numpy(weight))) == pytest.approx(expected, abs=1e-9)


def test_few_renders_are_farther_from_the_target_than_many_of_the_same_distribution():
    """Else weights would settle on a few, which explain readings of any target by chance. In the mean they are farther
    by the share of pairs that a render makes with itself."""
    rng = np.random.default_rng(0)
    own, target = (scenes_of(torch.from_numpy(rng.normal(size=(size, 1)))) for size in (1000, 400))
    rows, each = WeightedRows.from_readings(own, target, 0), []
    for _ in range(1000):
        few = torch.zeros(1000).double()
        few[rng.choice(1000, 20, replace=False)] = 1 / 20
        each.append(float(rows.distance(few)))
    expected = (1 / 20 - 1 / 1000) * float(rows.own.sum()) / (1000 * 999)
    many = float(rows.distance(torch.full((1000,), 1e-3).double()))
    assert np.mean(each) - many == pytest.approx(expected, abs=4 * np.std(each) / 1000**0.5)


def test_what_is_read_with_little_skill_is_learnt_by_weights():
    """Of three sites read with a third of their variance: one lies in a part of its prior, one has its prior, and one
    is not to be learnt. A reader guesses toward the middle, so that its readings look alike."""
    torch.manual_seed(0)
    net = ParameterNet(1, 0, 3, hidden=12)
    for parameter in net.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    before = {key: value.clone() for key, value in net.state_dict().items()}
    u, true = torch.rand(1000, 3), torch.rand(1000, 3)
    true[:, 0] = 0.6 + 0.3 * true[:, 0]

    def read(u):
        return 0.5 + 0.3 * (u - 0.5) + 0.12 * torch.randn_like(u)

    own, target = scenes_of(read(u)), scenes_of(read(true))
    own = GuideReadings(own.kind, own.parent, own.nodes, u, own, own.kind)
    WeightedEnergyDistance(net, target, own, [0, 1], steps=300).run()
    graph = SceneGraph.from_nodes(own.kind, own.parent)
    with torch.no_grad():
        learnt = [net.scene_mixture(graph, u, g).icdf(torch.rand(1000, 1))[:, 0].numpy() for g in range(2)]
    away = [stats.wasserstein_distance(values, true[:, g].numpy()) for g, values in enumerate(learnt)]
    of_prior = stats.wasserstein_distance(u[:, 0].numpy(), true[:, 0].numpy())
    assert away[0] < 0.4 * of_prior and away[1] < 0.06
    after = net.state_dict()
    changed = {key for key in after if not torch.equal(after[key], before[key])}
    assert changed == {f"scene_out.{g}.{part}" for g in (0, 1) for part in ("weight", "bias")}


def test_what_no_weights_explain_is_not_learnt_as_a_few_values():
    """Readings of the target that are off to one side and pile up there, as those of renders hardly do."""
    torch.manual_seed(0)
    net, u, true = ParameterNet(1, 0, 1, hidden=12), torch.rand(1000, 1), 0.1 + 0.3 * torch.rand(1000, 1)

    def read(u, off=0.0):
        return (u - off + 0.15 * torch.randn_like(u)).clamp(0, 1)

    own, target = scenes_of(read(u)), scenes_of(read(true, 0.2))
    own = GuideReadings(own.kind, own.parent, own.nodes, u, own, own.kind)
    WeightedEnergyDistance(net, target, own, [0], steps=300).run()
    with torch.no_grad():
        learnt = (
            net.scene_mixture(SceneGraph.from_nodes(own.kind, own.parent), u, 0).icdf(torch.rand(1000, 1))[:, 0].numpy()
        )
    away, of_prior = (stats.wasserstein_distance(values, true[:, 0].numpy()) for values in (learnt, u[:, 0].numpy()))
    assert away < 0.75 * of_prior
