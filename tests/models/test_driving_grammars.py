"""The structures of driving scenes: the paper's productions, both priors' distributions, and what is to be found."""

from functools import cache

import numpy as np
import pytest
import torch
from scipy.stats import chisquare

from probscene.checks import check, check_grammar
from probscene.derive import derive_complete
from probscene.models.driving import SCENARIOS, SIMPLE
from probscene.models.streets.grammars import (  # fmt: skip
    BOUNDS,
    FAR,
    LONGEST,
    MAX_STEPS,
    PLANTS,
    WALK,
    grammar,
    pretraining,
    prior,
    target,
    vehicle_numbers,
)
from probscene.models.streets.grammars import SIMPLE as SIMPLE_BOUNDS
from probscene.relations import per_parent, relations

EACH = tuple(SCENARIOS)
LISTS = {"Cars": ("lane", "oncoming"), "Walk": ("sidewalk", "shoulder"), "Planting": ("median",)} | {
    "Buildings": ("row",), "Foliage": ("verge",),
}  # fmt: skip
ITEMS = {"Cars": ("car",), "Walk": WALK, "Planting": PLANTS, "Buildings": ("building",), "Foliage": ("tree",)}
# Printed in the supplement, from the left to the right; | is where the median may stand.
PAPER = {"|C", "|CC", "C|C", "C|CC", "CC|C", "CC|CC"}


@cache
def derived(policy, number=1500):
    torch.manual_seed(0)
    return derive_complete(policy.grammar, policy, number, MAX_STEPS)


def counted(derivation, g, name):
    return derivation.counts(len(g.kinds))[:, g.kind(name)].numpy()


def lengths(derivation, g, key):
    """Of every list of a nonterminal: how many things its container holds."""
    found = []
    for container in set(LISTS[key]) & set(g.kinds):
        found.append(sum(per_parent(derivation, g.kind(container), g.kind(item)).count for item in ITEMS[key]))
    return torch.cat(found).numpy()


@pytest.mark.parametrize("scenario", EACH)
def test_streets_are_the_papers(scenario):
    g = grammar(scenario)
    streets = {
        str(rule)
        .split("(")[1]
        .rstrip(")")
        .replace("Oncoming", "C")
        .replace("Lane", "C")
        .replace("Median", "|")
        .replace(" ", "")
        for rule in g.rules
        if rule.lhs == "Street"
    }
    assert streets == ({s for s in PAPER if not s.startswith("|")} if scenario == "rural" else PAPER)
    held = set(relations(g))
    walk = "shoulder" if scenario == "rural" else "sidewalk"
    assert {child for parent, child in held if parent == walk} == set(WALK)
    assert {child for parent, child in held if parent == "verge"} == {"tree"}
    assert {child for parent, child in held if parent == "median"} == (set() if scenario == "rural" else set(PLANTS))
    assert {child for parent, child in held if parent in ("lane", "oncoming")} == {"car"}
    rows = str(g).splitlines()[5].count("row(Buildings)")
    assert rows == {"city": 2, "suburban": 1, "rural": 0}[scenario]


@pytest.mark.parametrize("model", [*SCENARIOS.values(), *SIMPLE.values()], ids=lambda model: model.name)
def test_a_model_is_sound_and_almost_no_derivation_is_drawn_again(model):
    report = check(model)
    assert not report.faults and not report.warnings and report.longer < 1e-3
    assert check_grammar(model.grammar, model.pretraining, MAX_STEPS).longer < 1e-3
    assert not derived(model.prior)[1].any()
    assert model.classes[0] == "car" and set(model.classes) <= set(model.grammar.kinds)


@pytest.mark.parametrize("name", ["tuned", "simple"])
@pytest.mark.parametrize("scenario", EACH)
def test_a_prior_is_uniform_in_all_that_it_draws(scenario, name):
    g = grammar(scenario)
    derivation, _ = derived(prior(scenario, name))
    lanes = counted(derivation, g, "lane") + counted(derivation, g, "oncoming")
    numbers = (2, 3, 4) if scenario == "rural" else (1, 2, 3, 4)
    assert set(lanes) == set(numbers)
    assert chisquare([(lanes == n).sum() for n in numbers]).pvalue > 1e-3
    median = counted(derivation, g, "median")
    assert chisquare([(median == 0).sum(), (median == 1).sum()]).pvalue > 1e-3
    for key in BOUNDS[scenario]:
        fewest, most = SIMPLE_BOUNDS if name == "simple" else BOUNDS[scenario][key]
        held = lengths(derivation, g, key)
        assert (held.min(), held.max()) == (fewest, most), key
        assert chisquare(np.bincount(held)[fewest:]).pvalue > 1e-3, key
    for key in {"Walk", "Planting"} & set(BOUNDS[scenario]):
        number = [
            sum(
                int(per_parent(derivation, g.kind(c), g.kind(item)).count.sum()) for c in set(LISTS[key]) & set(g.kinds)
            )
            for item in ITEMS[key]
        ]
        assert chisquare(number).pvalue > 1e-3, key


def test_scenarios_differ_as_their_streets_do():
    nodes = {name: check(model).expected_nodes for name, model in SCENARIOS.items()}
    assert nodes["rural"]["tree"] > 2 * nodes["suburban"]["tree"] > 2 * nodes["city"]["tree"]
    assert nodes["city"]["building"] > nodes["suburban"]["building"]
    assert nodes["city"]["car"] > nodes["suburban"]["car"] > nodes["rural"]["car"]


@pytest.mark.parametrize("name", ["tuned", "simple"])
@pytest.mark.parametrize("scenario", EACH)
def test_a_tenth_of_what_a_guide_is_pretrained_on_is_longer_than_the_prior(scenario, name):
    g = grammar(scenario)
    derivation, _ = derived(pretraining(scenario, name))
    for key in BOUNDS[scenario]:
        most = (SIMPLE_BOUNDS if name == "simple" else BOUNDS[scenario][key])[1]
        held = lengths(derivation, g, key)
        assert abs((held > most).mean() - 0.1) < 0.02 and held.max() == LONGEST[key]
    assert (counted(derivation, g, "car") >= 10).mean() > 0.02
    assert torch.isfinite(pretraining(scenario, name).log_prob(derived(prior(scenario, name))[0])).all()


@pytest.mark.parametrize("scenario", EACH)
def test_a_target_is_another_distribution_that_its_seed_decides(scenario):
    g = grammar(scenario)
    known = [derived(prior(scenario, name))[0] for name in ("tuned", "simple")]
    tables = []
    for seed in range(3):
        policy = target(scenario, seed)
        assert torch.equal(policy.table, target(scenario, seed).table)
        tables.append(policy.table)
        derivation, failures = derived(policy)
        assert not failures.any()
        share = np.bincount(counted(derivation, g, "car"), minlength=49) / len(derivation)
        for other in known:
            away = np.abs(share - np.bincount(counted(other, g, "car"), minlength=49) / len(other)).sum() / 2
            assert away > FAR - 0.05
        assert torch.isfinite(pretraining(scenario, "tuned").log_prob(derivation)).all()
    assert not torch.equal(tables[0], tables[1]) and not torch.equal(tables[1], tables[2])


@pytest.mark.parametrize("scenario", EACH)
def test_how_many_vehicles_a_prior_has(scenario):
    derivation, _ = derived(prior(scenario))
    fewest, most = BOUNDS[scenario]["Cars"]
    streets = {"rural": (1, 0.5, 0.5, 1)}.get(scenario, (1, 0.5, 0.5, 0.5, 0.5, 1))
    expected = vehicle_numbers(scenario, [1.0] * (most + 1), streets)
    number = np.bincount(counted(derivation, grammar(scenario), "car"), minlength=49)
    often = expected * len(derivation) >= 5
    rest = (number[~often].sum(), expected[~often].sum() * len(derivation))
    expected = np.append(expected[often] * len(derivation), max(rest[1], 1e-9))
    assert chisquare(np.append(number[often], rest[0]) * expected.sum() / number.sum(), expected).pvalue > 1e-3


def test_vans_and_trucks_are_kinds_of_their_own():
    vehicles = ("car", "van", "truck")
    g = grammar("city", vehicles)
    derivation, _ = derived(prior("city", "tuned", vehicles))
    number = [counted(derivation, g, kind).sum() for kind in vehicles]
    assert chisquare(number, np.array([0.86, 0.1, 0.04]) * sum(number)).pvalue > 1e-3
    assert "van" not in grammar("city").kinds
