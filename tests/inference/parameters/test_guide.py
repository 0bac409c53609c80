"""The parameter guide: a Pyro guide whose sites are the program's own."""

import pyro
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from pyro import poutine
from pyro.infer import SVI, Predictive, Trace_ELBO
from pyro.optim import Adam

from probscene.inference.parameters import sibling_encoder as module
from probscene.inference.parameters.graph import ClassNodes, SceneGraph
from probscene.inference.parameters.guide import ParameterGuide
from probscene.inference.parameters.sibling_encoder import SiblingEncoder
from probscene.inference.parameters.sites import Site, find_sites, of_scenes, quantiles_of, site_name
from probscene.inference.parameters.values import Values, log_density
from probscene.sampling import run_program, sample, seed_everything

NAMES = ("scene.bright", "tray.x", "tray.y", "ball.away", "ball.size", "ball.shade", "floor.turn")


def guide_of(model, names=NAMES, spread=0.5, seed=0):
    """A guide of some sites with random weights."""
    torch.manual_seed(seed)
    guide = ParameterGuide(model, tuple(site for site in find_sites(model) if site.name in names), hidden=12)
    for parameter in guide.net.parameters():
        torch.nn.init.normal_(parameter, std=spread) if spread else torch.nn.init.zeros_(parameter)
    return guide.eval()


def drawn(model, number=64, seed=0):
    seed_everything(seed)
    with torch.no_grad():
        return sample(model, model.prior, number)


@settings(max_examples=10)
@given(st.integers(0, 2**31))
def test_zero_weights_are_the_prior(model, seed):
    guide = guide_of(model, spread=0)
    one, other = drawn(model, seed=seed), drawn(guide.with_parameters(model), seed=seed)
    assert torch.equal(one.derivation.rules, other.derivation.rules)
    u = quantiles_of(model, one), quantiles_of(model, other)
    for name, value in u[0].items():
        assert torch.allclose(value, u[1][name], atol=1e-5, equal_nan=True), name
    for name, value in one.parameters.items():
        if site_name(model.grammar, name) not in NAMES:
            assert torch.equal(value, other.parameters[name]), name
    # Near 0 and 1 a step of u in float32 is a large one of the value.
    inner = torch.stack([(value.isnan() | ((value - 0.5).abs() < 0.499)).all(1) for value in u[0].values()]).all(0)
    assert torch.allclose(one.log_prob[inner], other.log_prob[inner], atol=1e-2)
    assert float((one.log_prob - other.log_prob).abs().median()) < 1e-3


def test_sites_that_are_not_learnt_draw_the_priors_very_numbers(model):
    learnt = drawn(guide_of(model, ("tray.x", "ball.away")).with_parameters(model))
    prior = drawn(model)
    for name, value in prior.parameters.items():
        own = site_name(model.grammar, name)
        assert torch.equal(value, learnt.parameters[name]) == (own not in ("tray.x", "ball.away")), name


def test_weights_are_a_distribution(model):
    """Under q the mean of p / q is 1, over parameters of given structures."""
    guide = guide_of(model, spread=0.2)
    scenes = drawn(guide.with_parameters(model), 4000)
    under_prior = pyro.poutine.condition(model, data={**scenes.derivation.sites(), **scenes.parameters})
    with torch.no_grad():
        trace = poutine.trace(under_prior).get_trace(4000)
        trace.compute_log_prob()
    prior = sum(trace.nodes[name]["log_prob"].sum(1) for name in scenes.parameters)
    ratio = (prior - scenes.log_prob).exp()
    assert float(ratio.mean()) == pytest.approx(1, abs=4 * float(ratio.std()) / 4000**0.5)
    assert float(ratio.std()) > 0.1


def test_density_and_sampling_are_one_distribution(model):
    """The quantile of each value, by the mixtures that its density is of, is the number that it was drawn from."""
    guide = guide_of(model)
    scenes = drawn(guide.with_parameters(model), 120)
    guide.net.double()
    u = quantiles_of(model, scenes)
    derivation = scenes.derivation.trimmed()
    seen = ClassNodes.from_derivation(model.grammar, model.classes, derivation)
    graph = SceneGraph.from_nodes(seen.kind, seen.parent)
    values = torch.stack([seen.gather(u[site.name]) for site in guide.node_sites], -1).double()
    values = values.where((seen.kind >= 0).unsqueeze(-1), torch.nan)
    scene = torch.cat([of_scenes(u[site.name]) for site in guide.scene_sites], 1).double()
    for s in range(len(guide.node_sites)):
        v = torch.rand(seen.kind.shape).double()
        known = values.clone()
        known[..., s:] = torch.nan
        has = ~values[..., s].isnan()
        with torch.no_grad():
            found = guide.net.sample(graph, scene, known, s, v, has)
            again = known.clone()
            again[..., s] = found.where(has, torch.nan)
            back = guide.net.node_mixture(graph, scene, again, s).cdf(found.logit())
        inside = has & (found > 1e-5) & (found < 1 - 1e-5)
        assert inside.sum() > 30 and torch.allclose(back[inside], v[inside], atol=1e-6)


def values_of(guide, scenes):
    """The u that a sample of a guide has."""
    model, u = guide.model, quantiles_of(guide.model, scenes)
    seen = ClassNodes.from_derivation(model.grammar, model.classes, scenes.derivation.trimmed())
    nodes = torch.stack([seen.gather(u[site.name]) for site in guide.node_sites], -1)
    nodes = nodes.where((seen.kind >= 0).unsqueeze(-1), torch.nan)
    scene = torch.cat([of_scenes(u[site.name]) for site in guide.scene_sites], 1)
    sites = len(guide.node_sites) + len(guide.scene_sites)
    zeros = torch.zeros_like(nodes), torch.zeros_like(scene)
    return Values(seen.kind, seen.parent, nodes, zeros[0], scene, zeros[1], torch.zeros(sites, dtype=torch.bool))


def test_what_is_fitted_is_what_is_sampled(model):
    """The density that maximum likelihood raises is that of the program with learnt parameters."""
    guide = guide_of(model)
    scenes = drawn(guide.with_parameters(model), 200)
    with torch.no_grad():
        found = log_density(guide.net, values_of(guide, scenes)).sum(1)
    prior = run_program(model, scenes.derivation, scenes.parameters).log_prob
    away = (found - (scenes.log_prob - prior)).abs()
    assert float(away.median()) < 1e-2 and float((away < 0.1).float().mean()) > 0.9  # u of float32 near 0 and 1


def test_a_density_is_the_same_whatever_else_is_in_the_batch(model):
    """A scene's log-probability does not depend on others', which may be of another scenario."""
    learnt = guide_of(model).with_parameters(model)

    def against_prior(derivation, values):
        found = [run_program(one, derivation, values).log_prob.detach() for one in (learnt, model)]
        return found[0] - found[1]

    scenes = drawn(learnt, 24)
    ratio = against_prior(scenes.derivation, scenes.parameters)
    for row in range(0, 24, 3):
        derivation = scenes.derivation[torch.tensor([row])].trimmed()
        values = run_program(model, derivation).parameters  # as wide as the scene alone is drawn
        for name, value in values.items():
            width = min(value.shape[1], scenes.parameters[name].shape[1])
            value[:, :width] = scenes.parameters[name][row : row + 1, :width]
        assert float(against_prior(derivation, values)) == pytest.approx(float(ratio[row]), rel=1e-4, abs=1e-3)


def test_nodes_without_a_class_are_passed_over(model):
    scenes = drawn(model, 30)
    derivation = scenes.derivation.trimmed()
    seen = ClassNodes.from_derivation(model.grammar, model.classes, derivation)
    kinds = {name: model.grammar.kind(name) for name in ("tray", "red", "blue")}
    for n in range(30):
        wanted = []
        for m, kind in enumerate(derivation.kind[n].tolist()):
            if kind in kinds.values():
                parent = int(derivation.parent[n, m])
                while parent >= 0 and int(derivation.kind[n, parent]) not in kinds.values():
                    parent = int(derivation.parent[n, parent])
                wanted.append((kind, m, parent))
        places = {m: i for i, (_, m, _) in enumerate(wanted)} | {-1: -1}
        there = seen.kind[n] >= 0
        assert seen.kind[n][there].tolist() == [kind for kind, _, _ in wanted]
        assert seen.slot[n][there].tolist() == [m for _, m, _ in wanted]
        assert seen.parent[n][there].tolist() == [places[parent] for _, _, parent in wanted]


def test_pyro_takes_it_like_any_guide(model):
    guide = guide_of(model)
    scenario = "trays/" if model.scenarios else ""
    away, x, bright = (f"{scenario}{name}" for name in ("ball.away", "tray.x", "scene.bright"))
    with torch.no_grad():
        trace = poutine.trace(guide).get_trace(8)
        again = poutine.trace(poutine.replay(guide, trace=trace)).get_trace(8)
        total = [float(one.log_prob_sum()) for one in (trace, again)]
    assert torch.equal(trace.nodes[away]["value"], again.nodes[away]["value"])
    assert total[0] == pytest.approx(total[1])
    fixed = trace.nodes[x]["value"]
    known = {name: node["value"] for name, node in trace.nodes.items() if name.startswith("rule_")}
    with torch.no_grad():
        held = poutine.trace(poutine.condition(guide, data={**known, x: fixed})).get_trace(8)
    assert torch.equal(held.nodes[x]["value"], fixed) and torch.isfinite(held.log_prob_sum())
    found = Predictive(guide, num_samples=2, return_sites=(bright,))(8)
    assert found[bright].shape == (2, 8, 1)


def test_svi_learns_it(model):
    """With the prior as the model, the evidence bound falls to the prior."""
    pyro.clear_param_store()
    seed_everything(0)
    guide = guide_of(model, ("scene.bright", "ball.size")).train()
    svi = SVI(model, guide, Adam({"lr": 3e-2}), Trace_ELBO())
    losses = [svi.step(100) for _ in range(25)]
    assert sum(losses[-5:]) < 0.3 * sum(losses[:5])
    pyro.clear_param_store()


def test_a_site_is_told_by_its_name_alone(trays):
    assert guide_of(trays).sites[0] == Site("scene.bright", ())


def test_links_of_many_scenes_are_those_of_each(monkeypatch):
    torch.manual_seed(0)
    mates = SiblingEncoder(3, 8)
    own = torch.rand(20, 6, 3).where(torch.rand(20, 6, 3) < 0.7, torch.nan)
    siblings = SceneGraph.from_nodes(torch.zeros(20, 6, dtype=torch.int64), torch.randint(-1, 1, (20, 6))).siblings
    whole = mates.links(siblings, own)
    monkeypatch.setattr(module, "PAIRS", 1)
    for one, other in zip(whole, mates.links(siblings, own), strict=True):
        assert torch.equal(one, other)


def test_links_of_later_sites_are_added_to_those_before():
    torch.manual_seed(0)
    mates, own = SiblingEncoder(3, 8), torch.rand(20, 6, 3).where(torch.rand(20, 6, 3) < 0.7, torch.nan)
    siblings = SceneGraph.from_nodes(torch.zeros(20, 6, dtype=torch.int64), torch.randint(-1, 1, (20, 6))).siblings
    before = mates.links(siblings, own.where(torch.arange(3) < 1, torch.nan))
    for one, other in zip(mates.links(siblings, own), mates.links(siblings, own, before, 1), strict=True):
        assert torch.equal(one, other)
