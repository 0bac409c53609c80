"""Enumeration against a recursive one, and exact q(T) that sums to one."""

import itertools

import pytest
import torch
from hypothesis import assume, given
from hypothesis import strategies as st

from probscene.branching import Branching
from probscene.enumeration import enumerate_derivations, shortest_lengths
from probscene.errors import GrammarError
from probscene.grammar import Grammar
from probscene.policy import Policy
from probscene.structure import StructurePrior, counts

MOST = 2000


def strings(grammar, named, max_steps):
    """Every derivation of the start symbol, by the sizes of its parts."""

    def of(name, size):
        for k, rule in enumerate(grammar.rules):
            if rule.lhs == name:
                below = [symbol for symbol in named(rule.rhs) if symbol[0].isupper()]
                for parts in sizes(size - 1, len(below)):
                    each = [list(of(child, part)) for child, part in zip(below, parts, strict=True)]
                    for choice in itertools.product(*each):
                        yield (k, *itertools.chain(*choice))

    return [rules for size in range(1, max_steps + 1) for rules in of(grammar.rules[0].lhs, size)]


def sizes(total, parts):
    """The ways to write ``total`` as a sum of ``parts`` positive numbers."""
    if not parts:
        return [()] if not total else []
    return [(first, *rest) for first in range(1, total + 1) for rest in sizes(total - first, parts - 1)]


def enumerated(grammar, max_steps):
    """The enumeration, where it is small."""
    assume(shortest_lengths(grammar)[0] <= max_steps)
    try:
        return enumerate_derivations(grammar, max_steps, MOST)
    except GrammarError:
        assume(False)


@given(st.from_type(Grammar), st.integers(1, 6))
def test_every_derivation_stands_once(reference, grammar, max_steps):
    every = enumerated(grammar, max_steps)
    assert every.complete.all()
    found = [tuple(k for k in row if k >= 0) for row in every.rules.tolist()]
    assert found == sorted(found) and len(set(found)) == len(found)
    assert set(found) == set(strings(grammar, reference.named, max_steps))


@given(st.from_type(Grammar))
def test_shortest_lengths_are_those_of_the_shortest_derivation(reference, grammar):
    shortest = shortest_lengths(grammar)[0]
    assume(shortest <= 7)
    assert strings(grammar, reference.named, shortest)
    assert not strings(grammar, reference.named, shortest - 1)


@given(st.from_type(StructurePrior))
def test_what_the_enumeration_lacks_is_longer(prior):
    every = enumerated(prior.grammar, 8)
    total = prior.log_prob(every).double().exp().sum().item()
    longer = 1 - Branching(prior.grammar, prior.table).lengths(8).sum()
    assert total + longer == pytest.approx(1, abs=1e-5)


@given(st.from_type(Policy))
def test_any_policy_sums_to_at_most_one(policy):
    every = enumerated(policy.grammar, 8)
    total = policy.log_prob(every).double().exp().sum().item()
    recursive = bool(policy.grammar.recursive.any())
    assert total <= 1 + 1e-5
    if not recursive and len(every) == len(enumerated(policy.grammar, 30)):
        assert total == pytest.approx(1, abs=1e-5)


def test_a_prior_with_a_longest_scene_sums_to_one():
    grammar = Grammar("Scene -> Digits\nDigits -> Digit Digits | ε\nDigit -> 0 | 1 | 2")
    every = enumerate_derivations(grammar, 2 + 2 * 4)
    assert len(every) == 1 + 3 + 9 + 27 + 81
    prior = StructurePrior(grammar, Digits=counts(0.1, 0.1, 0.3, 0.2, 0.3))
    torch.testing.assert_close(prior.log_prob(every).exp().sum(), torch.tensor(1.0))


def test_limits():
    grammar = Grammar("Scene -> Scene Scene | x")  # Catalan numbers of derivations
    assert len(enumerate_derivations(grammar, 9, limit=1 + 1 + 2 + 5 + 14)) == 23
    with pytest.raises(GrammarError, match="at most 22 derivations of at most 9 rules"):
        enumerate_derivations(grammar, 9, limit=22)
    with pytest.raises(GrammarError, match="max_steps of at least 3, .* got 2"):
        enumerate_derivations(Grammar("Scene -> A A\nA -> x"), 2)
