"""Stochastic EM on readings whose errors are known."""

import math

import pytest
import torch
from scipy.stats import kstest, truncnorm

from probscene.inference.parameters.graph import SceneGraph
from probscene.inference.parameters.net import ParameterNet
from probscene.inference.parameters.stochastic_em import NormalApproximation, Readings, StochasticEM
from probscene.inference.parameters.values import Values, log_density


def read(nodes, scene, sd, turns=()):
    """Readings of u of nodes ``(L, M, S)`` and scenes ``(L, G)``, each site with an error of its own."""
    S, circles = nodes.shape[2], torch.tensor([i in turns for i in range(len(sd))])
    sds = [
        error.expand(u.shape).clone()
        for u, error in zip((nodes, scene), torch.tensor(sd).tensor_split([S]), strict=True)
    ]
    means = [u + error * torch.randn(u.shape) for u, error in zip((nodes, scene), sds, strict=True)]
    means = [m.where(~c, m.remainder(1.0)) for m, c in zip(means, circles.tensor_split([S]), strict=True)]
    kind = torch.zeros(nodes.shape[:2], dtype=torch.int64)
    return Values(kind, torch.full_like(kind, -1), means[0], sds[0], means[1], sds[1], circles)


@torch.no_grad()
def sample(net, num, nodes):
    kind = torch.zeros(num, nodes, dtype=torch.int64)
    graph = SceneGraph.from_nodes(kind, torch.full_like(kind, -1))
    scene, u = torch.full((num, net.scene_sites), torch.nan), torch.full((num, nodes, net.node_sites), torch.nan)
    for g in range(net.scene_sites):
        scene[:, g] = net.scene_mixture(graph, scene, g).icdf(torch.rand(num, 1))[:, 0]
    for s in range(net.node_sites):
        u[..., s] = net.sample(graph, scene, u, s, torch.rand(num, nodes), kind >= 0)
    return u, scene


def correlation(one, other):
    return float(torch.corrcoef(torch.stack([one.flatten(), other.flatten()]))[0, 1])


def bounded(mean, sd, *shape):
    return (mean + sd * torch.randn(shape)).clamp(1e-3, 1 - 1e-3)


def learn(net, values, steps, seed=0, first=True):
    training = StochasticEM(net, values, steps, learning_rate=1e-2 if first else 1e-3, seed=seed, from_prior=first)
    training.run()
    return training


def drawn_from(mean, sd, number, circle=False):
    """u of a reading alone."""
    if math.isinf(sd):
        return torch.rand(number)
    if circle:
        return (mean + sd * torch.randn(number)).remainder(1.0)
    return torch.from_numpy(truncnorm.ppf(torch.rand(number).numpy(), -mean / sd, (1 - mean) / sd, mean, sd)).float()


def test_chains_are_distributed_as_the_posterior():
    """A net of random weights that is not trained; many chains of one image, and its posterior by importance sampling.
    One node does not have a site, one value is read on a circle and one is not read at all."""
    torch.manual_seed(0)
    net, L = ParameterNet(1, 2, 1, hidden=8), 800
    for part in net.parameters():
        torch.nn.init.normal_(part, 0, 0.35)
    one = read(torch.tensor([[[0.3, 0.9], [0.6, 0.4], [0.5, 0.5]]]), torch.tensor([[0.7]]), [0.15, 0.1, 0.2], (1,))
    one.nodes[0, 2, 1], one.nodes_sd[0, 1, 0] = torch.nan, torch.inf
    chains = one.select(torch.zeros(L, dtype=torch.int64))
    training = StochasticEM(net, chains, steps=40, images=L, learning_rate=0.0, from_prior=False)
    training.run()
    assert all(share > 0.2 for share in training.accepted.values())
    free = one.select(torch.zeros(20_000, dtype=torch.int64))
    for s, (mean, sd) in enumerate(zip(one.nodes[0].T, one.nodes_sd[0].T, strict=True)):
        for m, (at, error) in enumerate(zip(mean.tolist(), sd.tolist(), strict=True)):
            if at == at:
                free.nodes[:, m, s] = drawn_from(at, error, len(free.nodes), circle=s == 1)
    free.scene[:, 0] = drawn_from(float(one.scene[0, 0]), float(one.scene_sd[0, 0]), len(free.scene))
    with torch.no_grad():
        weight = log_density(net, free).sum(1).softmax(0)

    def moments(nodes, scene):
        u = torch.cat([nodes.flatten(1)[:, [0, 1, 2, 3, 4]], scene], 1)
        u[:, [1, 3]] = (6.2832 * u[:, [1, 3]]).cos()
        return torch.cat([u, u.square(), u[:, 1:] * u[:, :-1]], 1)

    exact = moments(free.nodes, free.scene)
    expected = weight @ exact
    variance = weight @ (exact - expected).square()
    error = (variance * (1 / L + weight.square().sum())).sqrt()
    found = moments(training.nodes, training.scene)
    assert 1 / weight.square().sum() > 1000 and training.nodes[:, 2, 1].isnan().all()
    assert ((found.mean(0) - expected).abs() < 6 * error).all()


@pytest.mark.parametrize(("error", "rounds", "within"), [(0.15, 3, 0.1), (0.25, 1, 0.15)])
def test_a_spread_is_learnt_as_it_is_in_every_round(error, rounds, within):
    """The noise of few steps is a few per cent; ``benchmarks/estimator.py`` has more of them."""
    torch.manual_seed(0)
    u, net = bounded(0.4, 0.124, 2000, 5, 1), ParameterNet(1, 1, 0, hidden=24)
    for number in range(rounds):
        learn(net, read(u, torch.zeros(2000, 0), [error]), 100 if number == 0 else 60, number, number == 0)
        learnt = sample(net, 4000, 5)[0]
        assert abs(float(learnt.std() / u.std()) - 1) < within
        assert abs(float(learnt.mean() - u.mean())) < 0.01


@pytest.mark.parametrize("sd", [[0.15, 0.01], [0.01, 0.15]])
def test_a_dependence_that_is_narrower_than_the_error_is_learnt(sd):
    """Of sites of scenes, which are quick; ``benchmarks/estimator.py`` has those of nodes."""
    torch.manual_seed(0)
    u = bounded(0.5, 0.16, 2500, 1)
    u = torch.cat([u, (u + 0.02 * torch.randn(u.shape)).clamp(1e-3, 1 - 1e-3)], -1)
    net = ParameterNet(1, 0, 2, hidden=32)
    for number in range(2):
        learn(net, read(torch.zeros(len(u), 1, 0), u, sd), 400 if number == 0 else 200, number, number == 0)
    learnt = sample(net, 8000, 1)[1]
    assert correlation(learnt[..., 0], learnt[..., 1]) > 0.98


def test_siblings_share_what_they_share():
    torch.manual_seed(0)
    u = (bounded(0.5, 0.2, 600, 1, 1) + 0.01 * torch.randn(600, 5, 1)).clamp(1e-3, 1 - 1e-3)
    net = ParameterNet(1, 1, 0, hidden=32)
    learn(net, read(u, torch.zeros(600, 0), [0.1]), 250)
    learnt = sample(net, 2000, 5)[0]
    assert correlation(learnt[:, 1:], learnt[:, :-1]) > 0.97
    assert 0.5 < float((learnt[:, 1:] - learnt[:, :-1]).std() / (u[:, 1:] - u[:, :-1]).std()) < 2


def test_circles_go_round():
    torch.manual_seed(0)
    u, net = (0.05 * torch.randn(1000, 5, 1)).remainder(1.0), ParameterNet(1, 1, 0, hidden=24)
    learn(net, read(u, torch.zeros(1000, 0), [0.05], (0,)), 250)
    learnt = (sample(net, 2000, 5)[0] + 0.5).remainder(1.0)
    assert abs(float(learnt.std()) / 0.05 - 1) < 0.1 and abs(float(learnt.mean()) - 0.5) < 0.01


def test_an_error_that_is_not_known_is_no_reading():
    values = read(torch.rand(3, 2, 1), torch.zeros(3, 0), [0.1])
    values.nodes_sd[0, 0, 0] = torch.nan
    readings = Readings.from_values(values)
    assert torch.isinf(readings.sd[0, 0]) and readings.there.all()


def test_what_is_not_read_keeps_the_prior():
    torch.manual_seed(0)
    u, net = torch.cat([bounded(0.4, 0.1, 300, 4, 1), torch.rand(300, 4, 1)], -1), ParameterNet(1, 2, 0, hidden=24)
    values = read(u, torch.zeros(300, 0), [0.05, 10.0])
    values.nodes_sd[..., 1] = torch.inf
    values.nodes[torch.rand(300, 4, 2) < 0.2] = torch.nan
    learn(net, values, 150)
    learnt = sample(net, 3000, 4)[0]
    assert kstest(learnt[..., 1].flatten().numpy(), "uniform").statistic < 0.06
    assert abs(float(learnt[..., 0].std()) / 0.1 - 1) < 0.1


def test_moments_are_those_of_u_and_not_of_its_readings():
    torch.manual_seed(0)
    own, shared, scene = 0.05 * torch.randn(4000, 6, 1), 0.1 * torch.randn(4000, 1, 1), 0.1 * torch.randn(4000, 1)
    u = 0.5 + own + shared + scene.unsqueeze(1)
    values = read(torch.cat([u, 1 - u], -1), 0.5 + scene, [0.2, 0.02, 0.15])
    found = NormalApproximation.from_values(values)
    sign = torch.tensor([1.0, -1.0, 1.0])
    shared = sign * sign[:, None] * torch.tensor([[0.02, 0.02, 0.01], [0.02, 0.02, 0.01], [0.01, 0.01, 0.01]])
    assert torch.allclose(found.mean.float(), torch.full((3,), 0.5), atol=0.02)
    assert torch.allclose(found.shared.float(), shared, atol=3e-3)
    assert torch.allclose(found.own.float(), 0.0025 * sign[:2] * sign[:2, None], atol=2e-3)


@pytest.mark.parametrize("nodes", [1, 5])
def test_what_nodes_do_not_share_adds_nothing_to_their_variance(nodes):
    """A part's noise is cut where it would be negative; what is cut is taken from the other part."""
    torch.manual_seed(0)
    first = bounded(0.5, 0.15, 1000, nodes, 1)
    u = torch.cat([first, first + 0.04 * torch.randn(first.shape)], -1)
    readings = u + 0.1 * torch.randn(u.shape)
    kind, of_scene, circles = torch.zeros(1000, nodes, dtype=torch.int64), torch.zeros(1000, 0), torch.zeros(2).bool()
    sd = torch.full_like(readings, 0.1)
    values = Values(kind, torch.full_like(kind, -1), readings, sd, of_scene, of_scene, circles)
    covariance = NormalApproximation.from_values(values).covariance(nodes)[:2, :2]
    expected = torch.cov(readings.flatten(0, 1).double().T) - 0.01 * torch.eye(2)
    assert torch.allclose(covariance, expected, rtol=2e-3)


class Interrupted(Exception):
    pass


@pytest.mark.parametrize("at", [10, 20])
def test_it_goes_on_to_the_same_bits(at):
    """From a state among the first steps, and from one of the chains."""

    def started():
        torch.manual_seed(0)
        net = ParameterNet(1, 2, 1, hidden=8)
        return StochasticEM(net, read(torch.rand(40, 3, 2), torch.rand(40, 1), [0.1, 0.1, 0.1]), 30, 20, seed=3)

    def interrupt(training, _):
        if training.done == at:
            raise Interrupted

    whole, first, second = started(), started(), started()
    whole.run()
    with pytest.raises(Interrupted):
        first.run(interrupt)
    second.restore({key: value.clone() for key, value in first.state().items()})
    second.run()
    for one, other in zip(whole.state().values(), second.state().values(), strict=True):
        assert torch.equal(one.nan_to_num(), other.nan_to_num())
