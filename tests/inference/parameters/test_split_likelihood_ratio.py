"""Which sites are learnt."""

import torch

from probscene.inference.parameters import split_likelihood_ratio
from probscene.inference.parameters.graph import SceneGraph
from probscene.inference.parameters.net import ParameterNet
from probscene.inference.parameters.split_likelihood_ratio import log_e_values, significant
from probscene.inference.parameters.stochastic_em import StochasticEM
from probscene.inference.parameters.values import Values


def read(nodes, scene, error):
    kind = torch.zeros(nodes.shape[:2], dtype=torch.int64)
    both = [(u + error * torch.randn(u.shape), torch.full_like(u, error)) for u in (nodes, scene)]
    sites = nodes.shape[2] + scene.shape[1]
    return Values(kind, torch.full_like(kind, -1), *both[0], *both[1], torch.zeros(sites, dtype=torch.bool))


def test_the_e_value_has_a_mean_of_at_most_one_under_the_prior():
    """Of a net of random weights, images of the prior one at a time, with and without resampling."""
    torch.manual_seed(0)
    net = ParameterNet(1, 2, 1, hidden=8)
    for part in net.parameters():
        torch.nn.init.normal_(part, 0, 0.25)
    e = []
    for _ in range(250):
        values = read(torch.rand(1, 3, 2), torch.rand(1, 1), 0.1)
        e.append(log_e_values(net, values, particles=4).exp())
    e = torch.stack(e)
    assert float(e.std(0).min()) > 0.02  # the net is not the prior
    assert ((e.mean(0) - 1).abs() < 6 * e.std(0) / len(e) ** 0.5).all()


def test_a_guide_that_is_the_prior_has_an_e_value_of_about_one():
    """Its components begin a little apart."""
    torch.manual_seed(0)
    log_e = log_e_values(ParameterNet(1, 2, 2, hidden=8), read(torch.rand(20, 3, 2), torch.rand(20, 2), 0.1))
    assert log_e.shape == (4,) and log_e.abs().max() < 2 and not significant(log_e).any()


def test_sites_that_have_the_prior_are_not_learnt_and_others_are():
    """A mean, a spread, two that have the prior, one of the prior's marginal distribution that follows the one before;
    of nodes and of scenes."""
    torch.manual_seed(0)

    def images(number):
        u = torch.rand(number, 4, 5)
        u[..., 0] = 0.3 + 0.7 * u[..., 0]
        u[..., 1] = 0.2 + 0.6 * u[..., 1]
        u[..., 4] = u[..., 3]
        return read(u[:, 1:], u[:, 0], 0.1)

    net = ParameterNet(1, 5, 5, hidden=16)
    StochasticEM(net, images(250), 120, learning_rate=1e-2).run()
    assert significant(log_e_values(net, images(120))).tolist() == [True, True, False, False, True] * 2


def test_pairs_of_nodes_that_are_looked_at_together_are_bounded(monkeypatch):
    """Memory grows by them."""
    pairs, from_nodes = [], SceneGraph.from_nodes
    monkeypatch.setattr(split_likelihood_ratio, "MAX_PAIRS", 4 * 12**2)

    def counting_pairs(kind, parent):
        pairs.append(kind.shape[0] * kind.shape[1] ** 2)
        return from_nodes(kind, parent)

    monkeypatch.setattr(SceneGraph, "from_nodes", counting_pairs)
    values = read(torch.rand(3, 12, 1), torch.rand(3, 0), 0.1)
    log_e_values(ParameterNet(1, 1, 0, hidden=8), values, particles=4)
    assert pairs == [4 * 12**2] * 3
