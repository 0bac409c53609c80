"""The laws of ``derive`` against a plain recursive descent, over random grammars and policies."""

import math

import pyro
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from pyro import poutine

from probscene.derivation import Derivation
from probscene.derive import derive, derive_complete
from probscene.errors import GrammarError, ModelError, SamplingError
from probscene.grammar import Grammar
from probscene.policy import Policy, cumulative, rule_log_probs
from probscene.rules import InverseCDF, drawn
from probscene.structure import StructurePrior, counts, weights

N, T = 16, 24
ANY_POLICY = st.one_of(st.from_type(Policy), st.from_type(StructurePrior))
SEED = st.integers(0, 2**31)


def program(policy, num_scenes=N, max_steps=T):
    with pyro.plate("scenes", num_scenes, dim=-2):
        return derive(policy.grammar, policy, num_scenes, max_steps)


def traced(policy, seed):
    pyro.set_rng_seed(seed)
    trace = poutine.trace(program).get_trace(policy)
    return trace, trace.nodes["_RETURN"]["value"]


def own(row):
    """A row without its padding, which must be -1 and come last."""
    row = row.tolist()
    length = row.index(-1) if -1 in row else len(row)
    assert set(row[length:]) <= {-1}
    return row[:length]


def same(one, other):
    """Whether two batches hold the same derivations and scene graphs, up to padding."""
    equal = torch.equal(one.complete, other.complete)
    for name in ("rules", "kind", "parent"):
        a, b = getattr(one, name), getattr(other, name)
        width = max(a.shape[1], b.shape[1])
        a, b = (torch.nn.functional.pad(x, (0, width - x.shape[1]), value=-1) for x in (a, b))
        equal = equal and torch.equal(a, b)
    return equal


@given(ANY_POLICY, SEED)
def test_a_complete_derivation_is_what_recursive_descent_makes_of_its_rules(reference, policy, seed):
    grammar, (_, derivation) = policy.grammar, traced(policy, seed)
    for i in range(N):
        rules = own(derivation.rules[i])
        tree = reference.expand(grammar, rules)
        assert (tree is not None) == derivation.complete[i]
        if tree is None:
            assert len(rules) == T
            continue
        assert tree.rules == rules and derivation.lengths[i] == len(rules)
        kinds = [grammar.kinds[k] for k in own(derivation.kind[i])]
        assert list(zip(kinds, derivation.parent[i].tolist(), strict=False)) == tree.nodes
        assert all(parent < node for node, (_, parent) in enumerate(tree.nodes))
        frontier = torch.stack(derivation.frontier, -1)[i, : len(rules)].tolist()
        assert [(grammar.nonterminals[v], c, p) for v, c, p in frontier] == tree.steps
        counted = [sum(kind == name for kind, _ in tree.nodes) for name in grammar.kinds]
        assert derivation.counts(len(grammar.kinds))[i].tolist() == counted
    ended = derivation.frontier.symbol == len(grammar.nonterminals)
    assert torch.equal(derivation.rules < 0, ended)


@given(ANY_POLICY, SEED)
def test_only_legal_and_possible_rules_are_sampled(policy, seed):
    _, derivation = traced(policy, seed)
    active = derivation.rules >= 0
    rules, symbols = derivation.rules[active], derivation.frontier.symbol[active]
    assert policy.grammar.legal[symbols, rules].all()
    assert torch.equal(policy.grammar.lhs[rules], symbols)
    assert torch.isfinite(policy.log_prob(derivation)).all()


@given(ANY_POLICY, SEED)
def test_the_trace_scores_the_product_of_the_rules_probabilities(reference, policy, seed):
    trace, derivation = traced(policy, seed)
    trace.compute_log_prob()
    sites = [site for name, site in trace.nodes.items() if name.startswith("rule_")]
    assert [site["log_prob"].shape for site in sites] == [(N, 1)] * derivation.rules.shape[1]
    scored = torch.cat([site["log_prob"] for site in sites], 1)
    close = {"rtol": 1e-5, "atol": 1e-4}
    torch.testing.assert_close(scored, rule_log_probs(policy.grammar, policy.logits(derivation), derivation), **close)
    assert (scored[derivation.rules < 0] == 0).all()
    torch.testing.assert_close(scored.sum(1), policy.log_prob(derivation), **close)
    for i in derivation.complete.nonzero()[:4, 0].tolist():
        expected = reference.log_probability(policy.grammar, policy, own(derivation.rules[i]))
        assert math.isclose(scored[i].sum(), expected, rel_tol=1e-4, abs_tol=1e-4)


@given(ANY_POLICY, SEED)
def test_a_seed_draws_the_same_scenes_and_what_comes_after_where_nothing_listens(policy, seed):
    _, heard = traced(policy, seed)
    after = torch.rand(3)
    pyro.set_rng_seed(seed)
    assert same(program(policy), heard)
    assert torch.equal(torch.rand(3), after)
    pyro.set_rng_seed(seed)
    assert same(derive(policy.grammar, policy, N, T), heard)


@given(st.from_type(StructurePrior), SEED)
def test_a_rule_that_is_looked_up_in_a_table_is_the_one_that_its_row_draws(prior, seed):
    shares = cumulative(prior.table.flatten(0, 2))
    generator = torch.Generator().manual_seed(seed)
    known = (~shares[:, 0].isnan()).nonzero()[:, 0]
    row = known[torch.randint(len(known), (500,), generator=generator)]
    pyro.set_rng_seed(seed)
    expected = drawn(shares[row])
    pyro.set_rng_seed(seed)
    assert InverseCDF.from_prior(prior).drawn(row.numpy()).tolist() == expected.tolist()


def test_more_steps_than_a_stack_can_count_are_refused():
    with pytest.raises(GrammarError, match="max_steps of some thousands at most, got 4194304"):
        program(StructurePrior(LIST), 1, 1 << 22)


@given(ANY_POLICY, SEED)
def test_logits_at_once_are_those_step_by_step(policy, seed):
    _, derivation = traced(policy, seed)
    torch.testing.assert_close(policy.logits(derivation), Policy.logits(policy, derivation))


@given(ANY_POLICY, SEED)
def test_replay_and_condition_give_the_same_scenes(policy, seed):
    trace, derivation = traced(policy, seed)
    pyro.set_rng_seed(seed + 1)
    assert same(poutine.replay(program, trace=trace)(policy), derivation)
    assert same(poutine.condition(program, data=derivation.sites())(policy), derivation)


@given(ANY_POLICY, SEED)
def test_a_scene_does_not_depend_on_its_batch(policy, seed):
    grammar, (_, derivation) = policy.grammar, traced(policy, seed)
    assert same(Derivation.from_rules(grammar, derivation.rules), derivation)
    for i in range(0, N, 5):
        alone = Derivation.from_rules(grammar, torch.tensor([own(derivation.rules[i])]))
        assert same(alone, derivation[i : i + 1])
    order = torch.arange(N).flip(0)
    assert same(Derivation.from_rules(grammar, derivation.rules[order]), derivation[order])


@given(ANY_POLICY, SEED)
def test_the_same_seed_gives_the_same_scenes(policy, seed):
    assert same(traced(policy, seed)[1], traced(policy, seed)[1])


LIST = Grammar("Scene -> Items\nItems -> x Items | ε")


def test_derivation_of_refuses_rules_that_do_not_fit():
    fine = Derivation.from_rules(LIST, torch.tensor([[0, 1, 2], [0, 2, -1]]))
    assert fine.complete.all() and fine.kind.tolist() == [[0], [-1]]
    with pytest.raises(GrammarError, match="rule of Items at step 1 of scene 1, got 0"):
        Derivation.from_rules(LIST, torch.tensor([[0, 2], [0, 0]]))
    with pytest.raises(GrammarError, match="end of the derivation at step 2"):
        Derivation.from_rules(LIST, torch.tensor([[0, 2, 2], [0, 1, 2]]))


def test_derivation_of_refuses_rules_after_padding_and_rules_that_are_none():
    with pytest.raises(GrammarError, match="padding"):
        Derivation.from_rules(LIST, torch.tensor([[0, -1, 2]]))
    with pytest.raises(GrammarError, match="among 0..2"):
        Derivation.from_rules(LIST, torch.tensor([[0, 3]]))
    with pytest.raises(GrammarError, match="among 0..2"):
        Derivation.from_rules(LIST, torch.tensor([[0, -2]]))


def test_logits_that_are_not_finite_are_named():
    class Broken(Policy):
        grammar = Grammar("Scene -> sky | sea")

        def step(self, memory, frontier, previous_rule):
            return torch.full((len(frontier.symbol), 2), torch.nan), memory

    for run in (program, poutine.trace(program)):
        with pytest.raises(ModelError, match="finite logits of the rules"):
            run(Broken())


def test_rules_that_stop_early_derive_no_more():
    grammar = Grammar("Scene -> sky Plates\nPlates -> plate Plates | ε")
    derivation = Derivation.from_rules(grammar, torch.tensor([[0, 1, -1, -1], [0, 1, 1, 2]]))
    assert derivation.complete.tolist() == [False, True]
    assert derivation.kind.tolist() == [[0, 1, -1], [0, 1, 1]]


def test_incomplete_derivations_say_so():
    derivation = Derivation.from_rules(LIST, torch.tensor([[0, 1, 1, 2], [0, 1, 1, 1], [0, 2, -1, -1], [0, 1, -1, -1]]))
    assert derivation.complete.tolist() == [True, False, True, False]
    assert derivation.lengths.tolist() == [4, 4, 2, 2]
    finished, left = len(LIST.nonterminals), LIST.nonterminals.index("Items")
    assert derivation.frontier.symbol[2:].tolist() == [[0, left, finished, finished], [0, left, left, left]]
    assert derivation.frontier.list_index[2:].tolist() == [[0, 0, 0, 0], [0, 0, 1, 1]]


def test_derive_complete_redraws_what_is_too_long():
    policy = StructurePrior(LIST, Items=counts(0.25, 0.25, 0.25, 0.25))
    derivation, failures = derive_complete(LIST, policy, 4000, max_steps=3)  # at most one item: half of them fail
    assert derivation.complete.all() and derivation.lengths.max() <= 3
    number = derivation.counts(1)[:, 0]
    assert abs(number.double().mean() - 0.5) < 0.05  # uniform on {0, 1}, as the prior says of those that end
    # The failed attempts before a success of probability 1/2 are geometric: mean 1, P(0) = 1/2.
    assert abs(failures.double().mean() - 1) < 0.15
    assert abs((failures == 0).double().mean() - 0.5) < 0.05


def test_derive_complete_counts_no_failures_where_all_fits():
    policy = StructurePrior(LIST, Items=counts(0.5, 0.5))
    derivation, failures = derive_complete(LIST, policy, 50, max_steps=3)
    assert len(derivation) == 50 and (failures == 0).all()
    empty, failures = derive_complete(LIST, policy, 0, max_steps=3)
    assert len(empty) == 0 and failures.shape == (0,)


def test_derive_complete_gives_up_with_advice():
    policy = StructurePrior(LIST, Items=weights(1, 0))
    with pytest.raises(SamplingError, match="max_steps = 20, got 7 of 7 scenes"):
        derive_complete(LIST, policy, 7, max_steps=20, attempts=5)
