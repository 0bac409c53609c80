"""The parameter guide: a Pyro guide whose sites are the program's own."""

import pyro
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from pyro import poutine
from pyro.infer import SVI, Predictive, Trace_ELBO
from pyro.optim import Adam

from probscene.inference.parameters.guide import ParameterGuide
from probscene.inference.parameters.net import Graph, Seen
from probscene.inference.parameters.sites import Site, find_sites, quantiles_of
from probscene.sampling import sample, seed_everything

NAMES = ("scene.bright", "tray.x", "tray.y", "ball.away", "ball.size", "ball.shade")


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
def test_zero_weights_are_the_prior(trays, seed):
    guide = guide_of(trays, spread=0)
    one, other = drawn(trays, seed=seed), drawn(guide.suited(trays), seed=seed)
    assert torch.equal(one.derivation.rules, other.derivation.rules)
    u = quantiles_of(trays, one)
    for name, value in one.parameters.items():
        tail = (u[name] < 1e-4) | (u[name] > 1 - 1e-4) if name in u else torch.zeros_like(value, dtype=torch.bool)
        near = 5e-3 * float(value.double().std())  # there and back through u in float32, which is coarse in the tails
        assert torch.allclose(value[~tail], other.parameters[name][~tail], atol=near), name
    assert torch.allclose(one.log_prob, other.log_prob, atol=2e-2)


def test_sites_that_are_not_learnt_draw_the_priors_very_numbers(trays):
    learnt = drawn(guide_of(trays, ("tray.x", "ball.away")).suited(trays))
    prior = drawn(trays)
    for name, value in prior.parameters.items():
        assert torch.equal(value, learnt.parameters[name]) == (name not in ("tray.x", "ball.away")), name


def test_weights_are_a_distribution(trays):
    """Under q the mean of p / q is 1, over parameters of given structures."""
    guide = guide_of(trays, spread=0.2)
    scenes = drawn(guide.suited(trays), 4000)
    under_prior = pyro.poutine.condition(trays, data={**scenes.derivation.sites(), **scenes.parameters})
    with torch.no_grad():
        trace = poutine.trace(under_prior).get_trace(4000)
        trace.compute_log_prob()
    prior = sum(trace.nodes[name]["log_prob"].sum(1) for name in scenes.parameters)
    ratio = (prior - scenes.log_prob).exp()
    assert float(ratio.mean()) == pytest.approx(1, abs=4 * float(ratio.std()) / 4000**0.5)
    assert float(ratio.std()) > 0.1


def test_density_and_sampling_are_one_distribution(trays):
    """The quantile of each value, by the mixtures that its density is of, is the number that it was drawn from."""
    guide = guide_of(trays)
    scenes = drawn(guide.suited(trays), 120)
    guide.net.double()
    u = quantiles_of(trays, scenes)
    derivation = scenes.derivation.trimmed()
    seen = Seen.of(trays.grammar, trays.classes, derivation)
    graph = Graph.of(seen.kind, seen.parent)
    values = torch.stack([seen.taken(u[site.name]) for site in guide.node_sites], -1).double()
    values = values.where((seen.kind >= 0).unsqueeze(-1), torch.nan)
    scene = u["scene.bright"].double()
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


def test_nodes_without_a_class_are_passed_over(trays):
    scenes = drawn(trays, 30)
    derivation = scenes.derivation.trimmed()
    seen = Seen.of(trays.grammar, trays.classes, derivation)
    kinds = {name: trays.grammar.kind(name) for name in ("tray", "red", "blue")}
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


def test_pyro_takes_it_like_any_guide(trays):
    guide = guide_of(trays)
    with torch.no_grad():
        trace = poutine.trace(guide).get_trace(8)
        again = poutine.trace(poutine.replay(guide, trace=trace)).get_trace(8)
        total = [float(one.log_prob_sum()) for one in (trace, again)]
    assert torch.equal(trace.nodes["ball.away"]["value"], again.nodes["ball.away"]["value"])
    assert total[0] == pytest.approx(total[1])
    fixed = trace.nodes["tray.x"]["value"]
    known = {name: node["value"] for name, node in trace.nodes.items() if name.startswith("rule_")}
    with torch.no_grad():
        held = poutine.trace(poutine.condition(guide, data={**known, "tray.x": fixed})).get_trace(8)
    assert torch.equal(held.nodes["tray.x"]["value"], fixed) and torch.isfinite(held.log_prob_sum())
    found = Predictive(guide, num_samples=2, return_sites=("scene.bright",))(8)
    assert found["scene.bright"].shape == (2, 8, 1)


def test_svi_learns_it(trays):
    """With the prior as the model, the evidence bound falls to the prior."""
    pyro.clear_param_store()
    seed_everything(0)
    guide = guide_of(trays, ("scene.bright", "ball.size"), spread=0.8).train()
    svi = SVI(trays, guide, Adam({"lr": 3e-2}), Trace_ELBO())
    losses = [svi.step(100) for _ in range(40)]
    assert sum(losses[-5:]) < 0.3 * sum(losses[:5])
    pyro.clear_param_store()


def test_a_site_is_told_by_its_name_alone(trays):
    assert guide_of(trays).sites[0] == Site("scene.bright", ())
