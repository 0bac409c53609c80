"""Which learnt sites keep their prior, by images that nothing was learnt from."""

from types import SimpleNamespace

import pytest
import torch

from probscene.app.fitting import site_selection
from probscene.inference.parameters.net import ParameterNet
from probscene.inference.parameters.stochastic_em import StochasticEM
from probscene.inference.parameters.values import Values


def readings(number: int, seed: int) -> Values:
    """Of one node and of the scene: the node's first u is about 0.3, its second and the scene's are uniform."""
    torch.manual_seed(seed)
    u = torch.stack([0.3 + 0.05 * torch.randn(number), torch.rand(number)], -1)[:, None]
    scene = torch.rand(number, 1)
    sd = torch.full_like(u, 0.05), torch.full_like(scene, 0.05)
    kind, turns = torch.zeros(number, 1, dtype=torch.int64), torch.zeros(3, dtype=torch.bool)
    noisy = (part + 0.05 * torch.randn_like(part) for part in (u, scene))
    nodes, scene = (part.clamp(0.0, 1.0) for part in noisy)
    return Values(kind, torch.full_like(kind, -1), nodes, sd[0], scene, sd[1], turns)


@pytest.fixture(scope="module")
def learning():
    """Of such readings; held-out images are others of the same distribution."""
    torch.manual_seed(0)
    net = ParameterNet(1, 2, 1, hidden=8)
    StochasticEM(net, readings(200, 1), steps=150, images=100, learning_rate=1e-2).run()
    node_sites, scene_sites = (SimpleNamespace(name="x"), SimpleNamespace(name="y")), (SimpleNamespace(name="light"),)
    guide = SimpleNamespace(net=net.eval(), node_sites=node_sites, scene_sites=scene_sites)
    return SimpleNamespace(guide=guide, readings=lambda images: readings(len(images), 2))


def test_only_sites_that_differ_from_their_prior_have_evidence(learning):
    because = site_selection.sites_without_evidence(learning, torch.zeros(150, 3, 8, 8), seed=0)
    assert set(because) == {"y", "light"}
    assert all("held-out images are likelier than under the prior by" in words for words in because.values())


def test_without_images_nothing_has_evidence(learning):
    assert set(site_selection.sites_without_evidence(learning, torch.zeros(0, 3, 8, 8), seed=0)) == {"x", "y", "light"}


def test_the_decision_is_that_of_its_seed(learning):
    one, other = (site_selection.sites_without_evidence(learning, torch.zeros(60, 3, 8, 8), seed=4) for _ in range(2))
    assert one == other
