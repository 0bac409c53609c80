"""Which state of a guide is kept, and which of its sites, by what is held out."""

import numpy as np
import torch

from probscene.inference.parameters.checkpoint_selection import CheckpointSelector, HeldOutSet, uninformative_sites
from probscene.inference.parameters.guide import ParameterGuide
from probscene.inference.parameters.sites import find_sites, quantiles_of
from probscene.sampling import sample, seed_everything

NAMES = ("scene.bright", "floor.turn")


def guide_of(trays, towards):
    """A guide that moves its sites' u by so many logits."""
    guide = ParameterGuide(trays, tuple(site for site in find_sites(trays) if site.name in NAMES), hidden=8)
    move(guide, towards)
    return guide.eval()


def move(guide, towards):
    for layer, logits in zip(guide.net.scene_out, towards, strict=True):
        with torch.no_grad():
            layer.bias[6:12] = logits


def looks(guide):
    """u of both sites, in place of an image."""
    seed_everything(1)
    scenes = sample(guide.with_parameters(guide.model), guide.model.prior, 150)
    u = quantiles_of(guide.model, scenes)
    floor = u["floor.turn"].nan_to_num(0.0).sum(1)
    return torch.stack([u["scene.bright"][:, 0], floor], 1).double().numpy()


def held(bright, turn):
    rng = np.random.default_rng(0)
    return HeldOutSet(looks, np.stack([rng.uniform(*bright, 150), rng.uniform(*turn, 150)], 1))


def test_a_site_that_brings_scenes_no_nearer_is_named(trays):
    guide = guide_of(trays, (2.0, 2.0))
    assert uninformative_sites(guide, held((0.6, 1.0), (0.0, 0.4))) == {"floor.turn"}
    assert uninformative_sites(guide, held((0.0, 0.4), (0.6, 1.0))) == {"scene.bright"}
    assert uninformative_sites(guide, held((0.6, 1.0), (0.6, 1.0))) == frozenset()
    assert uninformative_sites(guide, held((0.0, 0.4), (0.0, 0.4))) == set(NAMES)
    assert not guide.prior_sites


def test_a_site_that_is_passed_draws_the_prior_s_numbers(trays):
    guide = guide_of(trays, (2.0, 2.0))
    guide.prior_sites = frozenset(["floor.turn"])
    seed_everything(0)
    learnt = sample(guide.with_parameters(trays), trays.prior, 20)
    seed_everything(0)
    prior = sample(trays, trays.prior, 20)
    for name, value in prior.parameters.items():
        assert torch.equal(value, learnt.parameters[name]) == (name != "scene.bright"), name


def test_training_that_made_it_surely_worse_is_undone(trays):
    guide, best = guide_of(trays, (1.0, 1.0)), CheckpointSelector(held((0.6, 1.0), (0.6, 1.0)))
    best.update(guide)
    move(guide, (2.0, 2.0))
    best.update(guide)  # better
    assert float(guide.net.scene_out[0].bias[6].detach()) == 2.0
    move(guide, (-2.0, -2.0))
    best.update(guide)  # worse
    assert float(guide.net.scene_out[0].bias[6].detach()) == 2.0
    resumed = CheckpointSelector(best.held)
    resumed.restore(best.state())
    move(guide, (-2.0, -2.0))
    resumed.update(guide)
    assert float(guide.net.scene_out[0].bias[6].detach()) == 2.0


def test_sites_that_would_keep_their_prior_do_not_decide_about_others(trays):
    """What is learnt of ``floor.turn`` is wrong, and more so after the second training, which fixes the other site."""
    first, second, turn = (-1.0, -2.0), (2.0, -4.0), frozenset(["floor.turn"])
    judges = held((0.6, 1.0), (0.8, 1.0))

    def bias(guide):
        return float(guide.net.scene_out[0].bias[6].detach())

    guide, best = guide_of(trays, first), CheckpointSelector(judges)
    best.update(guide, turn)
    move(guide, second)
    best.update(guide, turn)
    assert bias(guide) == second[0] and best.prior_sites == turn and not guide.prior_sites
    move(guide, (-3.0, 4.0))
    best.update(guide, turn)
    assert bias(guide) == second[0]
    resumed = CheckpointSelector(judges)
    resumed.restore(best.state())
    move(guide, (2.5, -1.0))
    resumed.update(guide, turn)
    assert bias(guide) == 2.5
    all_sites = CheckpointSelector(judges)
    all_sites.update(move(guide, (0.0, 0.0)) or guide)
    move(guide, second)
    all_sites.update(guide)
    assert bias(guide) == 0.0
