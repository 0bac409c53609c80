"""Lists with a longest, and the extreme counts of derivations, against enumeration."""

import numpy as np
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from probscene.branching import Branching
from probscene.derive import derive_complete
from probscene.enumeration import enumerate_derivations
from probscene.grammar import Grammar
from probscene.lists import (
    ListBounds,
    bounded_lists,
    element_kinds,
    hangs_below,
    is_alone,
    is_list,
    lengths,
    share_from,
)
from probscene.structure import StructurePrior, counts, ranked, support_of_policies, weights

NESTED = Grammar("Scene -> bg Items | bg\nItems -> Item Items | ε\nItem -> x(Things) | y\nThings -> z Things | ε")
TWINS = Grammar("Scene -> As Bs\nAs -> a As | a\nBs -> b b Bs | ε\n")
STEPS = 12


@st.composite
def priors(draw):
    grammar = draw(st.sampled_from([NESTED, TWINS]))
    given = {}
    for name in grammar.nonterminals:
        number = len(grammar.rules_of(name))
        each = st.lists(st.sampled_from([0.0, 1.0]), min_size=number, max_size=number).filter(any)
        kind = each.map(lambda values: weights(*values))
        if is_list(grammar, grammar.nonterminals.index(name)):
            some = st.lists(st.sampled_from([0.0, 1.0]), min_size=1, max_size=4).filter(any)
            table = some.map(lambda values: counts(*values))
            kind = table | st.tuples(table, table).map(lambda pair: ranked(*pair)) | st.just(weights(1, 1))
        given[name] = draw(kind)
    return grammar, StructurePrior(grammar, **given)


def enumerated(grammar, prior):
    every = enumerate_derivations(grammar, STEPS)
    found = every[prior.log_prob(every) > -torch.inf]
    return found, found.counts(len(grammar.kinds)).numpy()


@settings(max_examples=40)
@given(priors())
def test_extreme_counts_are_those_of_enumeration(pair):
    grammar, prior = pair
    found, every = enumerated(grammar, prior)
    assume(len(found))
    process = Branching(grammar, support_of_policies(grammar, [prior]).uniform_table())
    rules = found.lengths.numpy()
    for kind in range(len(grammar.kinds)):
        objects = (grammar.objects.numpy()[process.rule] == kind).sum(1)
        for sign in (1, -1):
            total = process.max_totals(sign * objects, STEPS)
            for steps in range(STEPS + 1):
                assert total[steps] == (sign * every[rules <= steps, kind].astype(float)).max(initial=-np.inf)
            largest = process.max_total(sign * objects)
            assert largest >= total[-1] and (np.isinf(largest) or largest == process.max_totals(sign * objects, 60)[-1])


def test_counts_without_a_largest():
    """Nor does it matter that another branch has more at first, or that one has no end."""
    grammar = Grammar("Scene -> x | Many | Loop\nMany -> z z z z z z z z z | ε\nLoop -> z Loop | ε")
    process = Branching(grammar, StructurePrior(grammar, Loop=weights(1, 1)).table)
    objects = (grammar.objects.numpy()[process.rule] == grammar.kind("z")).sum(1)
    assert process.max_total(objects) == np.inf and process.max_total(-objects) == 0
    assert process.max_totals(objects, 20)[[1, 2, 12, 20]].tolist() == [0, 9, 10, 18]
    alone = (grammar.objects.numpy()[process.rule] == grammar.kind("x")).sum(1)
    assert process.max_total(alone) == 1


@settings(max_examples=30)
@given(priors())
def test_list_bounds_are_those_of_the_lists_that_are_derived(pair):
    grammar, prior = pair
    every = enumerate_derivations(grammar, 16)
    found = every[prior.log_prob(every) > -torch.inf]
    assume(len(found) and Branching(grammar, prior.table).longest() <= 16)
    for bounds in bounded_lists(grammar, prior, support_of_policies(grammar, [prior])):
        own = lengths(grammar, found, bounds.symbol).select(bounds, prior.table.shape[1])
        assert (own.min(), own.max()) == (bounds.shortest, bounds.prior) and bounds.prior == bounds.longest


def test_shares_of_lengths_are_those_of_samples():
    prior = StructurePrior(NESTED, Items=counts(1, 2, 3), Things=ranked(counts(1, 1), counts(1, 0, 3)))
    support = support_of_policies(NESTED, [prior])
    torch.manual_seed(0)
    drawn, _ = derive_complete(NESTED, prior, 4000, 40)
    every = bounded_lists(NESTED, prior, support)
    assert [(NESTED.nonterminals[b.symbol], b.parent_list_index, b.longest) for b in every] == [
        ("Items", None, 2), ("Things", 0, 1), ("Things", 1, 2),
    ]  # fmt: skip
    for bounds in every:
        found = lengths(NESTED, drawn, bounds.symbol).select(bounds, 2)
        share = share_from(Branching(NESTED, prior.table), bounds, bounds.longest)
        assert abs((found >= bounds.longest).mean() - share) < 5 * (share * (1 - share) / len(found)) ** 0.5


def test_pretraining_may_have_longer_lists_and_weights_have_no_longest():
    grammar = Grammar("Scene -> As Bs\nAs -> a As | ε\nBs -> b Bs | ε")
    prior = StructurePrior(grammar, As=counts(0, 1, 1), Bs=weights(1, 2))
    more = StructurePrior(grammar, As=counts(1, 1, 1, 0, 1), Bs=weights(1, 2))
    assert bounded_lists(grammar, prior, support_of_policies(grammar, [prior, more])) == [ListBounds(1, None, 1, 2, 4)]


@pytest.mark.parametrize(
    "text, kinds, more",
    [
        ("Scene -> L\nL -> a L | ε", "a", 0),
        ("Scene -> L\nL -> a L | b L | a", "ab", 1),
        ("Scene -> L\nL -> Item L | ε\nItem -> a | b(M)\nM -> c M | ε", "ab", 0),
        ("Scene -> L\nL -> a Item L | ε\nItem -> b | ε", "a", 0),
        ("Scene -> L\nL -> a a L | ε", "", 0),
        ("Scene -> L\nL -> Item L | ε\nItem -> a | Item b", "", 0),
        ("Scene -> L\nL -> Item L | ε\nItem -> a Item | a a", "", 0),
        ("Scene -> L\nL -> a L | x | ε", "a", 0),
    ],
)
def test_elements_that_are_one_object(text, kinds, more):
    grammar = Grammar(text)
    found = element_kinds(grammar, grammar.nonterminals.index("L"), range(len(grammar.kinds)))
    assert found == (tuple(sorted(map(grammar.kind, kinds))), more if kinds else 0)


def test_which_lists_can_be_read_from_an_image():
    def of(text, name, kinds):
        grammar = Grammar(text)
        return is_alone(grammar, grammar.nonterminals.index(name), [grammar.kind(kind) for kind in kinds])

    assert of("Scene -> L M\nL -> a L | ε\nM -> b M | ε", "L", "a")
    assert not of("Scene -> L M\nL -> a L | ε\nM -> a M | ε", "L", "a")
    assert not of("Scene -> L L\nL -> a L | ε", "L", "a")
    assert not of("Scene -> M\nM -> b(L) M | ε\nL -> a L | ε", "L", "a")
    assert of("Scene -> b(L) | c(L)\nL -> a L | ε", "L", "a")
    roads = Grammar("Scene -> Roads\nRoads -> Road Roads | ε\nRoad -> road(Cars)\nCars -> car Cars | ε")
    assert hangs_below(roads, 3, roads.kind("road")) and not hangs_below(roads, 1, roads.kind("road"))
