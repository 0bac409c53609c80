"""What is said about a grammar under a prior, against enumeration and closed forms."""

import math

import pytest
import torch
from hypothesis import assume, given
from hypothesis import strategies as st

from probscene.branching import CRITICAL, Branching
from probscene.checks import check, check_grammar
from probscene.enumeration import enumerate_derivations, shortest_lengths
from probscene.errors import GrammarError
from probscene.grammar import Grammar
from probscene.model import SceneModel
from probscene.policy import Policy
from probscene.structure import StructurePrior, counts, ranked, weights

DIGITS = Grammar("Scene -> bg Digits\nDigits -> Digit Digits | ε\nDigit -> 0|1|2|3|4|5|6|7|8|9")
UNIFORM = StructurePrior(DIGITS, Digits=counts(*[1] * 11))
TREE = Grammar("Scene -> Scene Scene | x")
LIST = Grammar("Scene -> x Scene | ε")


def exact(prior, max_steps, limit=4000):
    """Every derivation and its probability."""
    assume(shortest_lengths(prior.grammar)[0] <= max_steps)
    try:
        every = enumerate_derivations(prior.grammar, max_steps, limit)
    except GrammarError:
        assume(False)
    return every, prior.log_prob(every).double().exp()


@given(st.from_type(StructurePrior))
def test_lengths_are_those_of_the_enumeration(prior):
    every, q = exact(prior, 8)
    lengths = Branching(prior.grammar, prior.table).lengths(8)
    for n in range(9):
        assert lengths[n] == pytest.approx(q[every.lengths == n].sum().item(), abs=1e-6)


@given(st.from_type(StructurePrior))
def test_expectations_are_sums_over_the_enumeration(prior):
    process = Branching(prior.grammar, prior.table)
    assume(process.longest() <= 14)
    every, q = exact(prior, int(process.longest()))
    report = check_grammar(prior.grammar, prior, 14)
    assert q.sum().item() == pytest.approx(1, abs=1e-5)
    possible = q > 0
    assert process.longest() == every.lengths[possible].max()
    assert report.expected_length == pytest.approx((q * every.lengths).sum().item(), rel=1e-4)
    kinds = prior.grammar.kinds
    mean = (q.unsqueeze(1) * every.counts(len(kinds))).sum(0).tolist()
    assert report.expected_nodes == pytest.approx(dict(zip(kinds, mean, strict=True)), rel=1e-4, abs=1e-5)
    used = [k for k in range(len(prior.grammar.rules)) if (every.rules[possible] == k).any()]
    assert sorted({*used, *report.unused}) == list(range(len(prior.grammar.rules))) and not {*used} & {*report.unused}
    assert report.spectral_radius == 0 and report.longer == 0


@given(st.from_type(StructurePrior))
def test_the_mean_length_is_the_mean_of_the_lengths(prior):
    process = Branching(prior.grammar, prior.table)
    assume(process.spectral_radius < 0.8)
    lengths = process.lengths(300)
    mean = sum(n * p for n, p in enumerate(lengths))
    assume(lengths.sum() > 1 - 1e-8)
    assert process.expected_rules().sum() == pytest.approx(mean, rel=1e-4)


@given(st.floats(0.05, 0.95))
def test_a_geometric_list(p):
    process = Branching(LIST, StructurePrior(LIST, Scene=weights(p, 1 - p)).table)
    assert process.spectral_radius == pytest.approx(p, rel=1e-5) and process.longest() == math.inf
    assert process.expected_rules() == pytest.approx([p / (1 - p), 1], rel=1e-4)
    assert process.lengths(20)[1:] == pytest.approx([(1 - p) * p**n for n in range(20)], abs=1e-6)


@given(st.floats(0.05, 0.45))
def test_a_binary_tree(p):
    process = Branching(TREE, StructurePrior(TREE, Scene=weights(p, 1 - p)).table)
    assert process.spectral_radius == pytest.approx(2 * p, rel=1e-5)
    assert process.expected_rules().sum() == pytest.approx(1 / (1 - 2 * p), rel=1e-4)
    lengths = process.lengths(21)
    for n in range(11):  # n inner nodes: Catalan numbers of trees
        trees = math.comb(2 * n, n) // (n + 1)
        assert lengths[2 * n + 1] == pytest.approx(trees * p**n * (1 - p) ** (n + 1), abs=1e-6)
        assert lengths[2 * n] == 0


@given(st.floats(0.1, 0.9), st.floats(0.1, 0.9))
def test_two_that_derive_one_another(p, q):
    grammar = Grammar("A -> x B | ε\nB -> A A | y")
    process = Branching(grammar, StructurePrior(grammar, A=weights(p, 1 - p), B=weights(q, 1 - q)).table)
    assert process.spectral_radius == pytest.approx(math.sqrt(2 * p * q), rel=1e-5)
    if process.spectral_radius < CRITICAL:
        visits = 1 / (1 - 2 * p * q)
        expected = [visits * p, visits * (1 - p), visits * p * q, visits * p * (1 - q)]
        assert process.expected_rules() == pytest.approx(expected, rel=1e-3)


def test_ranks_beyond_the_counts_are_told_apart():
    grammar = Grammar("Scene -> Items\nItems -> Item Items | ε\nItem -> x | y")
    item = ranked(weights(1, 0), weights(0, 1), weights(1, 0))
    for given_, (x, y) in [
        (weights(1, 1), (0.5 + 0.25, 0.25)),
        (counts(0, 0, 0, 0, 1), (3, 1)),
        (counts(0, 1), (1, 0)),
    ]:
        report = check_grammar(grammar, StructurePrior(grammar, Items=given_, Item=item), 30)
        assert report.expected_nodes == pytest.approx({"x": x, "y": y}, abs=1e-5)


def test_quantiles_of_multi_mnist():
    report = check_grammar(DIGITS, UNIFORM, 64)
    # n digits take 2 + 2n rules, n uniform in 0..10: P(n <= 5) = 6/11, P(n <= 9) = 10/11 >= 0.9.
    assert [report.quantile(share) for share in (0.5, 0.9, 0.99, 0.999)] == [12, 20, 22, 22]
    assert report.longest == 22 and report.expected_length == pytest.approx(12) and report.longer == 0
    assert not report.faults and not report.warnings and not report.unused
    for words in (
        "3 nonterminals, 13 rules, 11 kinds",
        "the longest takes 22 rules",
        "12 rules on average",
        "50 % within 12, 90 % within 20",
        "bg 1, 0 0.5",
        "max_steps = 64: covers every",
        "Nothing to fix",
    ):
        assert words in str(report)  # fmt: skip


@given(st.sampled_from([0.1, 0.5, 0.9, 0.99, 0.999]))
def test_a_quantile_is_the_least_length_that_keeps_the_share(share):
    report = check_grammar(LIST, StructurePrior(LIST, Scene=weights(4, 1)), 10)
    length = report.quantile(share)
    assert 1 - 0.8**length >= share - 1e-5 and 1 - 0.8 ** (length - 1) < share
    assert report.longer == pytest.approx(0.8**10, abs=1e-6)


@pytest.mark.parametrize(
    ("grammar", "given_", "words"),
    [
        ("Thing -> Thing Thing | ε", {"Thing": weights(0.6, 0.4)},
         ["'Thing -> Thing Thing | ε' need not terminate: on average each Thing leads to 1.2 more",
          "lower the weight of 'Thing -> Thing Thing' or raise that of 'Thing -> ε'"]),
        ("Thing -> Thing Thing | ε", {}, ["leads to 1 more, and it must be below 1"]),
        ("Scene -> x Items\nItems -> x Items | ε", {"Items": weights(1, 0)}, ["or give its lengths with Items=counts"]),
        ("S -> A\nA -> B B | ε\nB -> y A | z", {"A": weights(9, 1), "B": weights(3, 1)},
         ["'A -> B B | ε' and 'B -> y A | z' need not terminate: on average each round leads to 1.16 more"]),
    ],
)  # fmt: skip
def test_a_grammar_that_need_not_terminate(grammar, given_, words):
    grammar = Grammar(grammar)
    report = check_grammar(grammar, StructurePrior(grammar, **given_), 50)
    assert len(report.faults) == 1 and report.spectral_radius >= CRITICAL
    for part in words:
        assert part in report.faults[0] and part in str(report)
    assert report.expected_length == math.inf and "need not end" in str(report)


def test_endless_rules_that_cannot_be_reached_do_no_harm():
    grammar = Grammar("Scene -> x | Thing\nThing -> Thing Thing | y")
    report = check_grammar(grammar, StructurePrior(grammar, Scene=weights(1, 0), Thing=weights(9, 1)), 10)
    assert not report.faults and report.unused == (1, 2, 3)
    assert "never chooses 'Scene -> Thing', 'Thing -> Thing Thing', 'Thing -> y'" in report.warnings[0]


def test_max_steps_that_are_too_few():
    report = check_grammar(DIGITS, UNIFORM, 19)
    assert report.longer == pytest.approx(2 / 11, abs=1e-6) and not report.faults
    assert "18 % of derivations are longer than max_steps = 19" in report.warnings[0]
    assert "raise max_steps to 22" in report.warnings[0]
    hardly = check_grammar(DIGITS, StructurePrior(DIGITS, Digits=counts(0, 0, 0, 0, 0, 1)), 11)
    assert "100 % of derivations are longer" in hardly.faults[0] and "raise max_steps to 12" in hardly.faults[0]
    assert "raise it to at least 2" in check_grammar(DIGITS, UNIFORM, 1).faults[0]
    slow = check_grammar(TREE, StructurePrior(TREE, Scene=weights(0.4999, 0.5001)), 50)
    assert slow.quantile(0.999) is None and "make lists shorter" in slow.warnings[0]
    assert "99.9 % within more than 1000" in str(slow)


def model(prior, classes):
    return SceneModel("digits", prior.grammar, prior, lambda *_: None, (8, 8), 64, classes)


def test_classes_that_never_occur():
    assert check(model(UNIFORM, ("0", "9"))) == check_grammar(DIGITS, UNIFORM, 64)
    prior = StructurePrior(DIGITS, Digits=counts(1, 1), Digit=weights(*[1] * 8, 0, 0))
    report = check(model(prior, ("1", "8", "9")))
    assert not report.faults and "'digits' that no scene of the prior holds: 8, 9" in report.warnings[-1]


@given(st.from_type(Policy))
def test_other_policies_are_sampled(policy):
    assume(shortest_lengths(policy.grammar)[0] <= 12)
    report = check_grammar(policy.grammar, policy, 12, samples=50)
    assert "RandomPolicy" in report.warnings[0] and "taken from 50 derivations" in str(report)
    assert len(report.lengths) == 13 and 0 <= report.longer <= 1
    assert report.longer == pytest.approx(1 - sum(report.lengths), abs=2e-6)


def test_a_sampled_prior_agrees_with_the_exact_one():
    class Same(Policy):
        grammar = DIGITS
        step, logits = UNIFORM.step, UNIFORM.logits

    sampled, true = check_grammar(DIGITS, Same(), 64, samples=4000), check_grammar(DIGITS, UNIFORM, 64)
    assert sampled.expected_length == pytest.approx(true.expected_length, abs=0.5)
    distance = sum(abs(a - b) for a, b in zip(sampled.lengths, true.lengths, strict=True)) / 2
    assert distance < 0.05 and torch.isnan(torch.tensor(sampled.spectral_radius))


def test_a_prior_over_another_grammar():
    with pytest.raises(GrammarError, match="over this grammar"):
        check_grammar(LIST, UNIFORM, 10)
