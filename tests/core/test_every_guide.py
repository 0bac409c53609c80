"""Laws that every guide keeps: the LSTM, the learnt PCFG and the Grammar VAE."""

import pyro
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from pyro import poutine
from scipy.stats import binom

from probscene.enumeration import enumerate_derivations
from probscene.grammar import Grammar
from probscene.inference.guides.lstm import GUIDES, make_guide
from probscene.policy import Policy

FLAT = Grammar("Scene -> A B | x\nA -> y(B) | z\nB -> y | B2 | ε\nB2 -> x | y")  # 21 derivations
LISTS = Grammar("Scene -> bg Items\nItems -> Item Items | ε\nItem -> x(Things) | y\nThings -> z Things | ε")


@st.composite
def guides(draw, grammars):
    """Guides of every kind with random weights throughout; small ``max_index``, so that indices beyond it are met."""
    torch.manual_seed(draw(st.integers(0, 2**31)))
    kind = draw(st.sampled_from(sorted(GUIDES)))
    sizes = {"hidden": draw(st.integers(1, 6)), "num_latents": draw(st.sampled_from([1, 2, 5])), "latent_size": 3}
    if kind == "lstm":
        sizes |= {"index": draw(st.booleans()), "max_index": 2}
    guide = make_guide(kind, draw(grammars), 9, **({} if kind == "pcfg" else sizes))
    for parameter in guide.parameters():
        torch.nn.init.normal_(parameter, std=0.7)
    return guide


def latents(guide):
    return len(getattr(guide, "latents", [0]))


def derived(guide, seed, num_scenes=6):
    pyro.set_rng_seed(seed)
    trace = poutine.trace(guide).get_trace(num_scenes)
    return trace, trace.nodes["_RETURN"]["value"]


@given(guides(st.just(FLAT)))
def test_q_sums_to_one(guide):
    q = guide.log_prob(enumerate_derivations(FLAT, 9)).double().exp()
    assert len(q) == 21 and q.sum().item() == pytest.approx(1, abs=1e-5)


@given(guides(st.just(FLAT)), st.integers(0, 2**31))
def test_samples_follow_q(guide, seed):
    every = enumerate_derivations(FLAT, 9)
    q = guide.log_prob(every).detach().double().exp()
    _, drawn = derived(guide, seed, 4000)
    rules = torch.nn.functional.pad(drawn.rules, (0, every.rules.shape[1] - drawn.rules.shape[1]), value=-1)
    found = (rules.unsqueeze(1) == every.rules).all(-1)
    assert (found.sum(1) == 1).all()
    low, high = binom.interval(1 - 1e-10, 4000, q.clamp(max=1))  # 25 draws of 21 numbers: one failure in 2e7
    number = found.sum(0).numpy()
    assert ((low <= number) & (number <= high)).all()


@given(guides(st.just(LISTS)), st.integers(0, 2**31))
def test_the_marginal_sums_the_traces_of_every_latent_vector(guide, seed):
    trace, derivation = derived(guide, seed)
    Z = latents(guide)
    assert ("z" in trace.nodes) == (Z > 1)
    each = []
    for z in range(Z):
        data = {**derivation.sites(), "z": torch.full((6, 1), z)}
        conditioned = poutine.trace(poutine.condition(guide, data=data)).get_trace(6)
        conditioned.compute_log_prob()
        sites = [site["log_prob"] for name, site in conditioned.nodes.items() if name == "z" or name[:5] == "rule_"]
        each.append(torch.cat(sites, 1).sum(1))  # log 1/|Z| + log q(T | z)
    torch.testing.assert_close(torch.stack(each).logsumexp(0), guide.log_prob(derivation), rtol=1e-4, atol=1e-4)


@given(guides(st.just(LISTS) | st.from_type(Grammar)).filter(lambda guide: latents(guide) == 1), st.integers(0, 2**31))
def test_all_steps_at_once_are_one_after_the_other(guide, seed):
    _, derivation = derived(guide, seed)
    torch.testing.assert_close(guide.logits(derivation), Policy.logits(guide, derivation), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(guide.log_prob(derivation), Policy.log_prob(guide, derivation), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("kind", GUIDES)
def test_the_program_registers_its_parameters_and_every_one_gets_a_gradient(kind):
    torch.manual_seed(0)
    guide = make_guide(kind, LISTS, 12)
    pyro.clear_param_store()
    _, derivation = derived(guide, 1, 53)
    assert {f"guide$$${name}" for name, _ in guide.named_parameters()} == set(pyro.get_param_store().keys())
    guide.log_prob(derivation).sum().backward()
    choice = torch.tensor([len(LISTS.rules_of(rule.lhs)) > 1 for rule in LISTS.rules])
    for name, parameter in guide.named_parameters():
        assert torch.isfinite(parameter.grad).all(), name
        assert parameter.grad.abs().sum() > 0 or "index" in name, name
        if kind == "pcfg":  # a nonterminal's only rule is certain
            assert torch.equal(parameter.grad != 0, choice)
