"""Structure priors: length distributions exactly, by enumeration; parent list indices; errors."""

import pytest
import torch
from hypothesis import assume, given
from hypothesis import strategies as st

from probscene.derivation import Derivation
from probscene.enumeration import enumerate_derivations
from probscene.errors import GrammarError
from probscene.grammar import Grammar
from probscene.inference.guides.lstm import LSTMGuide
from probscene.structure import StructurePrior, counts, hazards, ranked, support_of_policies, weights

LIST = Grammar("Scene -> bg Items\nItems -> x Items | y Items | ε")
ROADS = Grammar("Scene -> Roads\nRoads -> Road Roads | ε\nRoad -> road(Cars)\nCars -> car Cars | ε")
PROBS = st.lists(st.sampled_from([0.0, 0.1, 0.5, 1.0, 2.0, 7.0]), min_size=1, max_size=6).filter(any)


def normalised(values):
    return [value / sum(values) for value in values]


def distribution(prior, max_steps, value):
    """The exact probability of every value of ``value(derivation, i)``."""
    every = enumerate_derivations(prior.grammar, max_steps)
    table = {}
    for i, q in enumerate(prior.log_prob(every).double().exp().tolist()):
        if q > 0:
            key = value(every, i)
            table[key] = table.get(key, 0.0) + q
    return table


def times(kind):
    return lambda derivation, i: int((derivation.kind[i] == kind).sum())


def same(table, values):
    assert table == pytest.approx({n: p for n, p in enumerate(values) if p}, abs=1e-6)


@given(PROBS)
def test_counts_are_the_distribution_of_the_length(probs):
    grammar = Grammar("Scene -> Items\nItems -> x Items | ε")
    same(distribution(StructurePrior(grammar, Items=counts(*probs)), 2 + len(probs), times(0)), normalised(probs))


@given(PROBS, st.tuples(*[st.sampled_from([0.0, 0.5, 1.0])] * 2).filter(any))
def test_weights_share_out_a_list_that_is_counted(probs, shares):
    prior = StructurePrior(LIST, Items=counts(*probs, weights=shares))
    every = enumerate_derivations(LIST, 2 + len(probs))
    q = prior.log_prob(every).double().exp()
    number = every.counts(3).double()
    mean = sum(n * p for n, p in enumerate(normalised(probs)))
    for kind, share in zip((1, 2), normalised(shares), strict=True):
        assert (q * number[:, kind]).sum().item() == pytest.approx(mean * share, abs=1e-5)


@given(PROBS)
def test_hazards_stop_the_list_as_often_as_asked(probs):
    h = hazards(torch.tensor(normalised(probs), dtype=torch.float64)).tolist()
    alive, found = 1.0, []
    for stop in h:
        found.append(alive * stop)
        alive *= 1 - stop
    assert alive == pytest.approx(0, abs=1e-12) and found == pytest.approx(normalised(probs), abs=1e-12)


def test_every_list_counts_for_itself():
    prior = StructurePrior(ROADS, Roads=counts(0, 0.5, 0.5), Cars=counts(0.25, 0.5, 0.25))
    table = distribution(prior, 14, cars_of_roads)
    for n, at_n in ((1, 0.5), (2, 0.5)):
        assert sum(q for cars, q in table.items() if len(cars) == n) == pytest.approx(at_n, abs=1e-6)
    one = {0: 0.25, 1: 0.5, 2: 0.25}
    for cars, q in table.items():
        independent = 0.5
        for number in cars:
            independent *= one[number]
        assert q == pytest.approx(independent, abs=1e-6)


def cars_of_roads(derivation, i):
    """How many cars each road has, the roads in order."""
    kind, parent = derivation.kind[i].tolist(), derivation.parent[i].tolist()
    return tuple(
        sum(below == node for below, k in zip(parent, kind, strict=True) if k == 1)
        for node, k in enumerate(kind)
        if k == 0
    )


@given(st.lists(PROBS.map(lambda p: p[:3]).filter(any), min_size=1, max_size=3))
def test_ranked_gives_each_element_of_the_list_around_its_own(each):
    prior = StructurePrior(ROADS, Roads=counts(0.1, 0.2, 0.3, 0.4), Cars=ranked(*(counts(*probs) for probs in each)))
    for cars, q in distribution(prior, 17, cars_of_roads).items():
        expected = (0.1, 0.2, 0.3, 0.4)[len(cars)]
        for rank, number in enumerate(cars):
            expected *= normalised(each[min(rank, len(each) - 1)])[number]
        assert q == pytest.approx(expected, abs=1e-6)


def test_the_rank_reaches_through_what_is_no_list():
    grammar = Grammar("S -> Rows\nRows -> Row Rows | ε\nRow -> row(Inner)\nInner -> Cell\nCell -> x | y")
    prior = StructurePrior(grammar, Rows=counts(0, 0, 0, 1), Cell=ranked(weights(1, 0), weights(0, 1), weights(1, 1)))
    table = distribution(prior, 14, lambda d, i: tuple(grammar.kinds[k] for k in d.kind[i].tolist()[1::2]))
    assert table == pytest.approx({("x", "y", "x"): 0.5, ("x", "y", "y"): 0.5}, abs=1e-6)


@given(st.lists(st.sampled_from([0.0, 0.5, 1.0, 4.0]), min_size=3, max_size=3).filter(any))
def test_weights_are_probabilities_up_to_a_factor(values):
    grammar = Grammar("Scene -> x | y | z")
    x = normalised(values)[0]
    same(distribution(StructurePrior(grammar, Scene=weights(*values)), 1, times(0)), [1 - x, x])


@given(st.from_type(StructurePrior))
def test_the_table_holds_distributions_over_the_legal_rules(prior):
    probs = prior.table.double().exp()
    torch.testing.assert_close(probs.sum(-1), torch.ones(probs.shape[:-1], dtype=torch.float64), atol=1e-6, rtol=0)
    assert (probs.amax((1, 2)) * ~prior.grammar.legal == 0).all()


def test_what_is_not_named_is_uniform():
    same(distribution(StructurePrior(Grammar("Scene -> x | y | z | ε")), 1, times(0)), [0.75, 0.25])


def test_beyond_the_last_length_a_list_stops():
    grammar = Grammar("Scene -> A B\nA -> x A | ε\nB -> y B | ε")
    prior = StructurePrior(grammar, A=counts(0, 1), B=counts(0, 0, 0, 1))
    too_long = Derivation.from_rules(grammar, torch.tensor([[0, 1, 1, 2, 3, 3, 3, 4], [0, 1, 2, 3, 3, 3, 4, -1]]))
    assert prior.log_prob(too_long).tolist() == [-torch.inf, 0.0]


@pytest.mark.parametrize(
    ("given_", "message"),
    [
        ({"Thing": weights(1)}, r"among \['Scene', 'Items'\], got \['Thing'\]"),
        ({"Items": weights(1, 2)}, "expected 3 weights of Items, one a production, got 2"),
        ({"Items": weights(1, -1, 2)}, "non-negative weights of Items"),
        ({"Items": weights(0, 0, 0)}, "positive sum"),
        ({"Items": weights(1, float("nan"), 1)}, "non-negative"),
        ({"Items": weights(1, float("inf"), 1)}, "non-negative"),
        ({"Items": weights()}, "expected 3 weights"),
        ({"Items": counts()}, "counts of Items"),
        ({"Items": counts(0, 0)}, "positive sum"),
        ({"Items": counts(0.5, -0.5)}, "non-negative counts of Items"),
        ({"Items": counts(1, 1, weights=(1,))}, "expected 2 weights of Items's recursive productions"),
        ({"Items": counts(1, 1, weights=())}, "expected 2 weights of Items's recursive productions"),
        ({"Items": ranked()}, r"at least one distribution in ranked"),
        ({"Items": ranked(weights(1, 1, 1), weights(1))}, "expected 3 weights"),
        ({"Scene": counts(1, 1)}, "expected a list such as 'Scene -> item Scene | ε'"),
    ],
)
def test_distributions_that_are_none(given_, message):
    with pytest.raises(GrammarError, match=message):
        StructurePrior(LIST, **given_)


@pytest.mark.parametrize("productions", ["Scene -> Scene Scene | x", "Scene -> A\nA -> x Scene | ε"])
def test_only_lists_are_counted(productions):
    with pytest.raises(GrammarError, match="expected a list"):
        StructurePrior(Grammar(productions), Scene=counts(1, 1))


@given(st.from_type(StructurePrior), st.integers(0, 2**31))
def test_a_table_is_what_its_frontier_says(prior, seed):
    generator = torch.Generator().manual_seed(seed)
    every = enumerate_derivations_or_skip(prior.grammar)
    derivation = every[torch.randint(len(every), (8,), generator=generator)]
    V, P, C, K = prior.table.shape
    logits = prior.logits(derivation)
    for i in range(8):
        for t in range(int(derivation.lengths[i])):
            v, c, p = (int(x[i, t]) for x in derivation.frontier)
            assert torch.equal(logits[i, t], prior.table[v, min(p, P - 1), min(c, C - 1)])


def enumerate_derivations_or_skip(grammar):
    try:
        return enumerate_derivations(grammar, 8, limit=2000)
    except GrammarError:
        assume(False)


def test_a_production_may_depend_on_how_far_its_list_is():
    """No two of a kind in a row, by whether the list index is even: exactly the derivations a person would list."""
    prior = StructurePrior(LIST, Items=counts(1, 1, 1, 1))

    def legal(production, index, parent_index):
        return production != ("Items -> y Items" if index % 2 == 0 else "Items -> x Items")

    x, y = LIST.kind("x"), LIST.kind("y")
    found = distribution(
        prior.where(legal, list_indices=4), 6, lambda some, i: tuple(some.kind[i][some.kind[i] > 0].tolist())
    )
    assert found == pytest.approx({(x, y, x)[:n]: 0.25 for n in range(4)}, abs=1e-6)


def test_a_production_may_depend_on_the_parent_list_index():
    prior = StructurePrior(ROADS, Roads=counts(0, 0, 1), Cars=counts(1, 1))
    no_first = prior.where(
        lambda production, _, parent_index: parent_index > 0 or production != "Cars -> car Cars", parent_list_indices=2
    )
    assert distribution(no_first, 12, times(ROADS.kind("car"))) == pytest.approx({0: 0.5, 1: 0.5}, abs=1e-6)
    assert (distribution(prior, 12, times(ROADS.kind("car")))).keys() == {0, 1, 2}


def test_a_guide_keeps_to_what_is_legal():
    prior = StructurePrior(LIST, Items=counts(1, 1, 1))
    first_is_x = prior.where(lambda production, index, _: index > 0 or "y" not in production, list_indices=2)
    support = support_of_policies(LIST, [first_is_x])
    guide = LSTMGuide(LIST, 6)
    guide.support = support
    every = enumerate_derivations(LIST, 6)
    possible = first_is_x.log_prob(every) > -torch.inf
    with torch.no_grad():
        q = guide.log_prob(every)
    assert torch.equal(q > -torch.inf, possible)
    assert float(q.exp().sum()) == pytest.approx(1.0, abs=1e-5)


def test_what_leaves_nothing_or_says_nothing_is_named():
    prior = StructurePrior(LIST, Items=counts(1, 1))
    with pytest.raises(GrammarError, match="of Items that is legal at list index 1 and parent list index 0"):
        prior.where(lambda production, index, _: index < 1 or "ε" not in production, list_indices=2)
    with pytest.raises(GrammarError, match="not legal somewhere, got all legal up to list index 0"):
        prior.where(lambda *_: True)


@given(PROBS, st.integers(0, 2**31))
def test_a_list_stays_as_long_where_one_production_that_goes_on_is_left(probs, seed):
    prior = StructurePrior(LIST, Items=counts(*probs, weights=(1, 3)))
    keep = torch.rand(len(probs), 2, generator=torch.Generator().manual_seed(seed)) < 0.6
    keep[:, 0] |= ~keep.any(1)
    assume(not keep.all())
    names = ("Items -> x Items", "Items -> y Items")
    legal = {name: keep[:, i].tolist() for i, name in enumerate(names)}
    made = prior.where(lambda production, index, _: legal.get(production, [True] * 9)[index], list_indices=len(probs))

    def length(some, i):
        return int((some.kind[i] > 0).sum())

    same(distribution(made, len(probs) + 2, length), normalised(probs))
    x = distribution(made, len(probs) + 2, lambda some, i: tuple(some.kind[i][some.kind[i] > 0].tolist()))
    kinds = [LIST.kind("x"), LIST.kind("y")]
    assert all(keep[place, kinds.index(kind)] for row in x for place, kind in enumerate(row))
