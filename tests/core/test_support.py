"""What a model declares possible, against enumeration: guides stay within it, and their q(T) stay exact."""

import pyro
import pytest
import torch
from hypothesis import assume, given
from hypothesis import strategies as st
from pyro import poutine

from probscene.derivation import Derivation
from probscene.derive import derive, derive_complete
from probscene.enumeration import enumerate_derivations
from probscene.grammar import Grammar
from probscene.inference.guides.lstm import GUIDES, make_guide
from probscene.inference.guides.scenario import ScenarioGuide
from probscene.policy import Policy
from probscene.scenarios import JointGrammar
from probscene.structure import StructurePrior, counts, ranked, support_of_policies, weights
from probscene.support import nonterminals_of

LISTS = Grammar("Scene -> bg Items\nItems -> Item Items | ε\nItem -> x(Things) | y\nThings -> z Things | ε")
MOST = 16


@st.composite
def lengths(draw):
    """Of a list: up to three repeats, some of them impossible."""
    probs = draw(st.lists(st.sampled_from([0.0, 1.0, 2.5]), min_size=1, max_size=4))
    assume(sum(probs) > 0)
    return counts(*probs)


@st.composite
def priors(draw):
    things = lengths() | st.tuples(lengths(), lengths()).map(lambda each: ranked(*each))
    item = draw(st.sampled_from([weights(1, 1), weights(1, 0), weights(0, 1), weights(3, 1)]))
    return StructurePrior(LISTS, Items=draw(lengths()), Things=draw(things), Item=item)


def bound_guide(kind, grammar, support, seed, max_steps=MOST):
    torch.manual_seed(seed)
    sizes = {"pcfg": {}, "lstm": {"hidden": 4, "num_latents": 2, "max_index": 2, "latent_size": 3}}
    guide = make_guide(kind, grammar, max_steps, **sizes.get(kind, {"hidden": 4, "num_latents": 3, "latent_size": 3}))
    for parameter in guide.parameters():
        torch.nn.init.normal_(parameter, std=0.7)
    guide.bind(support)
    return guide


def possible(prior, every):
    return prior.log_prob(every) > -torch.inf


def uniform_prior(support):
    return StructurePrior.from_table(support.grammar, support.uniform_table())


EVERY = enumerate_derivations(LISTS, MOST)


@given(priors(), st.sampled_from(GUIDES), st.integers(0, 2**31))
def test_q_sums_to_one_over_what_the_prior_can_derive(prior, kind, seed):
    guide = bound_guide(kind, LISTS, support_of_policies(LISTS, [prior]), seed)
    q, own = guide.log_prob(EVERY).double(), possible(prior, EVERY)
    assert torch.equal(q > -torch.inf, own)
    longer = 1 - prior.log_prob(EVERY).double().exp().sum()
    assume(longer < 1e-6)  # else some of what is possible is not enumerated
    assert q[own].exp().sum().item() == pytest.approx(1, abs=1e-5)


@given(priors(), st.sampled_from(GUIDES), st.integers(0, 2**31))
def test_samples_stay_within_it_and_their_traces_have_the_same_log_prob(prior, kind, seed):
    guide = bound_guide(kind, LISTS, support_of_policies(LISTS, [prior]), seed)
    pyro.set_rng_seed(seed)
    with torch.no_grad():
        drawn, _ = derive_complete(LISTS, guide, 50, MOST)
    assert possible(prior, drawn).all()
    each = []
    for z in range(len(getattr(guide, "latents", [0]))):
        data = {**drawn.sites(), "z": torch.full((50, 1), z)}
        trace = poutine.trace(poutine.condition(guide, data=data)).get_trace(50)
        trace.compute_log_prob()
        each.append(
            torch.cat([s["log_prob"] for n, s in trace.nodes.items() if n == "z" or n[:5] == "rule_"], 1).sum(1)
        )
    torch.testing.assert_close(torch.stack(each).logsumexp(0), guide.log_prob(drawn), rtol=1e-4, atol=1e-4)


@given(priors(), st.integers(0, 2**31))
def test_the_score_functions_gradient_is_that_of_the_exact_expectation(prior, seed):
    """With one cost a derivation, grad sum_T q(T) c(T) is E[c grad log q]: both over what is possible."""
    guide = bound_guide("lstm", LISTS, support_of_policies(LISTS, [prior]), seed)
    every = EVERY[possible(prior, EVERY)]
    cost = torch.rand(len(every), dtype=torch.float64)
    logq = guide.log_prob(every).double()
    exact = torch.autograd.grad((logq.exp() * cost).sum(), list(guide.parameters()), retain_graph=True)
    score = torch.autograd.grad((logq.exp().detach() * cost * logq).sum(), list(guide.parameters()))
    for one, other in zip(exact, score, strict=True):
        assert torch.isfinite(one).all()
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("kind", GUIDES)
def test_a_guide_that_is_not_bound_passes_the_priors_longest(kind):
    prior = StructurePrior(LISTS, Items=counts(1, 1), Item=weights(0, 1))
    long = Derivation.from_rules(LISTS, torch.tensor([[0, *[1, 4] * 3, 2]]))
    guide = bound_guide(kind, LISTS, None, 0)
    assert guide.log_prob(long).isfinite().all()
    guide.bind(support_of_policies(LISTS, [prior]))
    assert (guide.log_prob(long) == -torch.inf).all()


@given(priors(), priors())
def test_what_either_of_two_priors_can_do_is_possible(one, other):
    support = support_of_policies(LISTS, [one, other])
    uniform = uniform_prior(support)
    both, union = support_of_policies(LISTS, [uniform]), possible(uniform, EVERY)
    assert torch.equal(possible(uniform_prior(both), EVERY), union)
    for prior in (one, other):
        assert (union | ~possible(prior, EVERY)).all()
        assert torch.equal(possible(uniform_prior(support_of_policies(LISTS, [prior])), EVERY), possible(prior, EVERY))


def test_lengths_between_those_of_two_priors_stay_impossible():
    grammar = Grammar("Scene -> Items\nItems -> x Items | ε")
    priors = [StructurePrior(grammar, Items=counts(0, 1)), StructurePrior(grammar, Items=counts(0, 0, 0, 1))]
    every = enumerate_derivations(grammar, 8)
    found = possible(uniform_prior(support_of_policies(grammar, priors)), every)
    assert sorted(every.counts(1)[found].flatten().tolist()) == [1, 3]


def test_weights_above_zero_declare_no_longest_and_another_policy_declares_nothing():
    prior = StructurePrior(LISTS, Items=weights(1, 2))
    guide = bound_guide("lstm", LISTS, None, 3)
    free = guide.log_prob(EVERY)
    guide.bind(support_of_policies(LISTS, [prior]))
    torch.testing.assert_close(guide.log_prob(EVERY), free)
    assert support_of_policies(LISTS, [prior, Policy()]) is None


def test_a_list_can_be_given_more_room():
    prior = StructurePrior(LISTS, Items=counts(0, 1), Item=weights(0, 1))
    support = support_of_policies(LISTS, [prior])
    items = LISTS.nonterminals.index("Items")

    def found(support):
        return sorted(set(EVERY.counts(4)[possible(uniform_prior(support), EVERY)].sum(1).tolist()))

    assert found(support) == [2]  # the background and one
    assert found(support.widened(items, 3)) == [2, 3, 4]
    assert found(support.widened(items)) == list(range(1, 9))
    many = found(support.widened(LISTS.nonterminals.index("Item")))
    assert many[0] == 2 and len(many) > 5  # now an x with its things, whose number nothing bounds


def test_scenarios_have_their_own_parts():
    parts = {"a": Grammar("Scene -> Xs\nXs -> x Xs | ε"), "b": Grammar("Scene -> Ys\nYs -> y Ys | ε")}
    grammar = JointGrammar(parts)
    tables = [StructurePrior(parts["a"], Xs=counts(1, 1)), StructurePrior(parts["b"], Ys=counts(0, 0, 1, 1))]
    prior = StructurePrior.joined(grammar, tables, grammar.first_symbol, grammar.first_rule, [1, 1])
    guide = ScenarioGuide(grammar, 8)
    for parameter in guide.parameters():
        torch.nn.init.normal_(parameter, std=0.7)
    guide.bind(support_of_policies(grammar, [prior]))
    every = enumerate_derivations(grammar, 8)
    q = guide.log_prob(every).double()
    assert torch.equal(q > -torch.inf, possible(prior, every))
    assert q.exp().sum().item() == pytest.approx(1, abs=1e-5)
    with torch.no_grad():
        drawn, failed = derive_complete(grammar, guide, 100, 8)
    assert possible(prior, drawn).all() and not failed.any()


def test_what_is_held_has_the_priors_probabilities_whatever_a_guide_says():
    """Reds are held, whites are free: a guide's distribution of reds is the prior's, and log q is exact."""
    grammar = Grammar("Scene -> Reds Whites\n Reds -> red Reds | ε\n Whites -> white Whites | ε")
    prior = StructurePrior(grammar, Reds=counts(3, 2, 1), Whites=counts(1, 1, 1))
    support = support_of_policies(grammar, (prior,))
    assert support is not None and nonterminals_of(grammar, ["red"]) == [grammar.nonterminals.index("Reds")]
    assert nonterminals_of(grammar, ["red", "white"]) == [0, 1, 2] and nonterminals_of(grammar, []) == []
    torch.manual_seed(0)
    for kind in GUIDES:
        guide = make_guide(kind, grammar=grammar, max_steps=8)
        with torch.no_grad():
            for parameter in guide.parameters():
                parameter.normal_(0, 1.5)
        guide.bind(support.with_prior(prior.table, ["red"]))
        every = enumerate_derivations(grammar, 8)
        every = every[prior.log_prob(every) > -torch.inf]
        probability = guide.log_prob(every).exp()
        assert probability.sum().item() == pytest.approx(1, abs=1e-5)
        reds = every.counts(len(grammar.kinds))[:, grammar.kind("red")]
        shares = torch.stack([probability[reds == k].sum() for k in range(3)])
        assert shares.tolist() == pytest.approx([1 / 2, 1 / 3, 1 / 6], abs=1e-5)
        drawn = derive(grammar, guide, 4000, 8).counts(len(grammar.kinds))[:, grammar.kind("red")]
        assert (drawn.bincount(minlength=3) / 4000).tolist() == pytest.approx([1 / 2, 1 / 3, 1 / 6], abs=0.04)
        guide.bind(support.with_prior(prior.table, []))
        assert guide.support is support
