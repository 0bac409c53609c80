"""Relations against the right-hand sides as they are written, and counts below parents against plain loops."""

import pyro
import torch
from hypothesis import given
from hypothesis import strategies as st

from probscene.derivation import Derivation
from probscene.derive import derive
from probscene.enumeration import enumerate_derivations
from probscene.grammar import Grammar
from probscene.policy import Policy
from probscene.relations import per_parent, relations

ROADS = Grammar("""
    Scene -> Roads
    Roads -> Road Roads | ε
    Road  -> road(Cars)
    Cars  -> car Cars | ε
""")


def below(grammar, symbols, seen=()):
    """Kinds that a list of symbols derives side by side, from the rules as written."""
    found = set()
    for symbol in symbols:
        name = symbol if isinstance(symbol, str) else symbol.name
        if not name[0].isupper():
            found.add(name)
        elif name not in seen:
            for rule in grammar.rules:
                if rule.lhs == name:
                    found |= below(grammar, rule.rhs, (*seen, name))
    return found


def nodes(symbols):
    for symbol in symbols:
        if not isinstance(symbol, str):
            yield symbol
            yield from nodes(symbol.children)


@given(st.from_type(Grammar))
def test_relations_are_those_that_the_rules_spell(grammar):
    written = {
        (node.name, child)
        for rule in grammar.rules
        for node in nodes(rule.rhs)
        for child in below(grammar, node.children)
    }
    found = relations(grammar)
    assert set(found) == written
    assert list(found) == sorted(found, key=lambda pair: tuple(map(grammar.kind, pair)))


def test_a_kind_may_hang_below_itself_through_others():
    grammar = Grammar("Scene -> Boxes\nBoxes -> box(Inner) Boxes | ε\nInner -> Boxes | ball(lid)")
    assert set(relations(grammar)) == {("box", "box"), ("box", "ball"), ("ball", "lid")}
    assert relations(Grammar("Scene -> Things\nThings -> a Things | b")) == ()
    assert relations(ROADS) == (("road", "car"),)


def looped(grammar, derivation, parent, child):
    """One scene, one node after the other."""
    out = []
    for i in range(len(derivation)):
        kinds, parents = derivation.kind[i].tolist(), derivation.parent[i].tolist()
        seen = {}
        for node, kind in enumerate(kinds):
            if kind == parent:
                rank = seen.get(parents[node], 0)
                seen[parents[node]] = rank + 1
                children = [k for k, p in zip(kinds, parents, strict=True) if k == child and p == node]
                out.append((i, rank, len(children)))
    return out


@given(st.from_type(Policy), st.integers(0, 2**31))
def test_counts_below_parents_are_those_of_plain_loops(policy, seed):
    grammar = policy.grammar
    pyro.set_rng_seed(seed)
    with pyro.plate("scenes", 9, dim=-2):
        derivation = derive(grammar, policy, 9, 16)
    known = {(grammar.kind(a), grammar.kind(b)) for a, b in relations(grammar)}
    for parent in range(len(grammar.kinds)):
        for child in range(len(grammar.kinds)):
            found = per_parent(derivation, parent, child)
            expected = looped(grammar, derivation, parent, child)
            assert list(zip(*(x.tolist() for x in found), strict=True)) == expected
            assert (parent, child) in known or not found.count.any()


def test_counts_of_every_small_scene_with_roads():
    derivations = enumerate_derivations(ROADS, 9)
    found = per_parent(derivations, 0, 1)
    cars = torch.zeros(len(derivations), dtype=torch.int64).index_add_(0, found.scene, found.count)
    assert torch.equal(cars, derivations.counts(2)[:, 1])
    assert torch.equal(torch.bincount(found.scene, minlength=len(derivations)), derivations.counts(2)[:, 0])
    two = Derivation.from_rules(ROADS, torch.tensor([[0, 1, 3, 4, 4, 5, 1, 3, 4, 5, 2]]))
    assert [x.tolist() for x in per_parent(two, 0, 1)] == [[0, 0], [0, 1], [2, 1]]


def test_no_scenes_and_no_such_node():
    one = Derivation.from_rules(ROADS, torch.tensor([[0, 2]]))
    for derivation in (one, one[:0]):
        assert all(len(x) == 0 and x.dtype == torch.int64 for x in per_parent(derivation, 0, 1))
