"""The LSTM guide against an LSTM in numpy, one scene and one step at a time, in float64."""

import math

import numpy as np
import pyro
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from pyro import poutine

from probscene.derivation import Derivation
from probscene.enumeration import enumerate_derivations
from probscene.grammar import Grammar
from probscene.inference.guides.lstm import LSTMGuide

FLAT = Grammar("Scene -> A B | x\nA -> y(B) | z\nB -> y | B2 | ε\nB2 -> x | y")
LISTS = Grammar("Scene -> bg Items\nItems -> Item Items | ε\nItem -> x(Things) | y\nThings -> z Things | ε")
SIGMOID = np.vectorize(lambda x: 1 / (1 + math.exp(-x)))


@st.composite
def guides(draw, grammar):
    """Guides with random weights throughout; small ``max_index``, so that indices beyond it are met."""
    torch.manual_seed(draw(st.integers(0, 2**31)))
    guide = LSTMGuide(
        grammar if isinstance(grammar, Grammar) else draw(grammar), max_steps=9, hidden=draw(st.integers(1, 6)),
        num_latents=draw(st.sampled_from([1, 1, 2, 3])), latent_size=3, index=draw(st.booleans()), max_index=2,
    )  # fmt: skip
    for parameter in guide.parameters():
        torch.nn.init.normal_(parameter, std=0.7)
    return guide


def reference_log_probs(expand, guide, rules):
    """``log q(T | z)`` of one scene for every z."""
    w = {name: value.detach().double().numpy() for name, value in guide.state_dict().items()}
    grammar, H = guide.grammar, guide.hidden
    found = []
    for latent in w["latents"]:
        h, c = np.split(np.tanh(w["first_state.weight"] @ latent + w["first_state.bias"]), 2)
        previous, total = -1, 0.0
        for k, (symbol, *indices) in zip(rules, expand(grammar, rules).steps, strict=True):
            x, bonus = w["embed.weight"][previous + 1].copy(), np.zeros(len(grammar.rules))
            if guide.embed_index is not None:
                for table, index in enumerate(min(i, guide.max_index) for i in indices):
                    x += w[f"embed_index.{table}.weight"][index]
                    bonus += w[f"index_logits.{table}.weight"][index]
            gates = (
                w["cell.weight_ih_l0"] @ x + w["cell.bias_ih_l0"] + w["cell.weight_hh_l0"] @ h + w["cell.bias_hh_l0"]
            )
            i, f, g, o = gates.reshape(4, H)
            c = SIGMOID(f) * c + SIGMOID(i) * np.tanh(g)
            h = SIGMOID(o) * np.tanh(c)
            logits = w["out.weight"] @ h + w["out.bias"] + bonus
            legal = [j for j, rule in enumerate(grammar.rules) if rule.lhs == symbol]
            total += logits[k] - math.log(sum(math.exp(logits[j]) for j in legal))
            previous = k
        found.append(total)
    return found


def prefixes(grammar, steps):
    """Derivations that are not complete after that many rules, by a plain stack."""
    found, todo = [], [((), (grammar.nonterminals[0],))]
    while todo:
        rules, stack = todo.pop()
        if stack and len(rules) == steps:
            found.append(rules)
        elif stack:
            for k in grammar.rules_of(stack[0]):
                pushed = [grammar.nonterminals[v] for v in grammar.children[k].flip(0).tolist() if v >= 0]
                todo.append(((*rules, k), (*pushed, *stack[1:])))
    return found


def derived(guide, seed, num_scenes=6):
    pyro.set_rng_seed(seed)
    trace = poutine.trace(guide).get_trace(num_scenes)
    return trace, trace.nodes["_RETURN"]["value"]


@given(guides(LISTS) | guides(st.from_type(Grammar)), st.integers(0, 2**31))
def test_log_prob_is_the_mean_over_the_latent_vectors_of_a_plain_lstm(reference, guide, seed):
    _, derivation = derived(guide, seed)
    found = guide.log_prob(derivation).tolist()
    for i in derivation.complete.nonzero()[:, 0].tolist():
        rules = derivation.rules[i, : int(derivation.lengths[i])].tolist()
        each = reference_log_probs(reference.expand, guide, rules)
        expected = math.log(sum(map(math.exp, each)) / len(each))
        assert found[i] == pytest.approx(expected, rel=1e-4, abs=1e-4)


@given(guides(LISTS))
def test_what_q_lacks_to_one_is_not_complete_after_max_steps(guide):
    every = enumerate_derivations(LISTS, 7)
    unfinished = Derivation.from_rules(LISTS, torch.tensor(prefixes(LISTS, 7)))
    assert every.complete.all() and not unfinished.complete.any()
    ended, rest = (guide.log_prob(d).double().exp().sum().item() for d in (every, unfinished))
    assert ended + rest == pytest.approx(1, abs=1e-5)


def test_a_fresh_guide_ignores_the_indices():
    torch.manual_seed(3)
    with_index = LSTMGuide(LISTS, max_steps=12)
    without = LSTMGuide(LISTS, max_steps=12, index=False)
    without.load_state_dict({k: v for k, v in with_index.state_dict().items() if "index" not in k})
    _, derivation = derived(with_index, 0)
    assert torch.equal(with_index.log_prob(derivation), without.log_prob(derivation))
