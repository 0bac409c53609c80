"""Random grammars, priors and policies (registered as strategies of their types), and a plain recursive reference."""

import math
from types import SimpleNamespace

import pytest
import torch
from hypothesis import strategies as st

from probscene.derivation import Frontier
from probscene.grammar import Grammar, Node, Rule
from probscene.policy import Policy
from probscene.structure import StructurePrior, counts, ranked, weights


def place(symbols, owner, nodes, pending):
    """Append a right-hand side's objects ``[kind, parent]`` to nodes, its ``(nonterminal, owner)`` to pending."""
    for symbol in symbols:
        name, children = (symbol, ()) if isinstance(symbol, str) else symbol
        if name[0].isupper():
            pending.append((name, owner))
        else:
            nodes.append((name, owner))
            place(children, len(nodes) - 1, nodes, pending)


def named(symbols):
    """Every symbol of a right-hand side, at any depth."""
    for symbol in symbols:
        name, children = (symbol, ()) if isinstance(symbol, str) else symbol
        yield name
        yield from named(children)


def expand(grammar, choices, choose=None):
    """Expand the start symbol by recursive descent.

    ``choices`` are the rules, leftmost first; ``choose(step, symbol, index, parent_index, previous)`` gives them
    instead. Returns nodes, steps ``(symbol, index, parent_index)``, and the rules; None if the choices do not last.
    """
    nodes, steps, rules = [], [], []
    lists = {rule.lhs for rule in grammar.rules if rule.lhs in named(rule.rhs)}

    def grow(name, owner, index, parent_index):
        previous = rules[-1] if rules else -1
        k = choose(len(rules), name, index, parent_index, previous) if choose else choices[len(rules)]
        rule = grammar.rules[k]
        assert rule.lhs == name
        rules.append(k)
        steps.append((name, index, parent_index))
        pending = []
        place(rule.rhs, owner, nodes, pending)
        for child, below in pending:
            if child == name:
                grow(child, below, index + 1, parent_index)
            else:
                grow(child, below, 0, index if name in lists else parent_index)

    try:
        grow(grammar.rules[0].lhs, -1, 0, 0)
    except IndexError:
        return None
    return SimpleNamespace(nodes=nodes, steps=steps, rules=rules)


def log_probability(grammar, policy, choices):
    """The product of the probabilities of the rules, one scene, one step after the other, over the legal rules only."""
    total, memory = 0.0, policy.start(1)
    tree = expand(grammar, choices)
    for t, (symbol, index, parent_index) in enumerate(tree.steps):
        state = [torch.tensor([x]) for x in (grammar.nonterminals.index(symbol), index, parent_index)]
        logits, memory = policy.step(memory, Frontier(*state), torch.tensor([choices[t - 1] if t else -1]))
        logits = logits[0].double().tolist()
        legal = [k for k, rule in enumerate(grammar.rules) if rule.lhs == symbol]
        total += logits[choices[t]] - math.log(sum(math.exp(logits[k]) for k in legal))
    return total


@pytest.fixture(scope="session")
def reference():
    return SimpleNamespace(expand=expand, log_probability=log_probability, named=named)


class RandomPolicy(Policy):
    """Logits that depend on everything a policy may read: the frontier, the previous rule, and its own past."""

    def __init__(self, grammar, seed):
        self.grammar = grammar
        generator = torch.Generator().manual_seed(seed)
        V, K = len(grammar.nonterminals), len(grammar.rules)
        self.tables = [torch.randn(n, K, generator=generator) * 2 for n in (V + 1, 3, 3, K + 1)]
        self.past = torch.randn(K, K, generator=generator)

    def __repr__(self):
        return f"RandomPolicy over\n{self.grammar}"

    def start(self, num_scenes):
        return torch.zeros(num_scenes, len(self.grammar.rules))

    def step(self, memory, frontier, previous_rule):
        index = (
            frontier.symbol,
            frontier.list_index.clamp(max=2),
            frontier.parent_list_index.clamp(max=2),
            previous_rule + 1,
        )
        logits = memory + sum(table[i] for table, i in zip(self.tables, index, strict=True))
        return logits, torch.tanh(logits @ self.past)


@st.composite
def grammars(draw):
    """Valid grammars: up to four nonterminals, lists, nested objects, several productions, rules in any order."""
    names = ["Scene", "A", "B-2", "C_3"][: draw(st.integers(1, 4))]
    objects = st.sampled_from(["x", "y", "0", "z-1"])
    rules = []
    for i, name in enumerate(names):
        below, any_one = st.sampled_from(names[i + 1 :] or ["x"]), st.sampled_from(names)

        def side(nonterminal):
            symbol = st.one_of(objects, nonterminal)
            nested = st.recursive(
                symbol, lambda inner: st.builds(Node, objects, st.lists(inner, max_size=2).map(tuple)), max_leaves=4
            )
            return st.lists(nested, max_size=3)

        sides = [draw(side(below))]  # ends, as it only leads to later nonterminals
        if i + 1 < len(names):
            sides[0].append(draw(st.sampled_from([names[i + 1], Node("y", (names[i + 1],))])))
        if draw(st.booleans()):
            sides += [[*draw(st.lists(st.one_of(objects, below), max_size=2)), name]]  # a list
        else:
            sides += draw(st.lists(side(any_one), max_size=2))
        rules += dict.fromkeys(Rule(name, *rhs) for rhs in sides)
    if len(rules) > 1:
        rules = [rules[0], *draw(st.permutations(rules[1:]))]
    return Grammar(rules)


WEIGHT = st.sampled_from([0.0, 0.25, 1.0, 1.0, 3.0])


@st.composite
def distributions(draw, grammar, name):
    """Weights, or counts where the nonterminal is a list."""
    rules = [rule for rule in grammar.rules if rule.lhs == name]
    again = [list(named(rule.rhs)).count(name) for rule in rules]
    if sorted(set(again)) == [0, 1] and draw(st.booleans()):
        shares = draw(st.none() | st.lists(WEIGHT, min_size=sum(again), max_size=sum(again)).filter(any).map(tuple))
        return counts(*draw(st.lists(WEIGHT, min_size=1, max_size=4).filter(any)), weights=shares)
    return weights(*draw(st.lists(WEIGHT, min_size=len(rules), max_size=len(rules)).filter(any)))


@st.composite
def priors(draw):
    grammar = draw(grammars())
    given = {}
    for name in grammar.nonterminals:
        if draw(st.booleans()):
            each = draw(st.lists(distributions(grammar, name), min_size=1, max_size=3))
            given[name] = ranked(*each) if len(each) > 1 else each[0]
    return StructurePrior(grammar, **given)


st.register_type_strategy(Grammar, grammars())
st.register_type_strategy(StructurePrior, priors())
st.register_type_strategy(Policy, st.builds(RandomPolicy, grammars(), st.integers(0, 2**31)))
