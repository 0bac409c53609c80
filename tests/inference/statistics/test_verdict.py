"""The verdict is right where one knows what it must be: counts drawn from distributions like those of the experiments.

Roads with cars on each, in order: the number of roads, then the cars of up to six roads, -1 where there is no such
road; and digits: how many of each of ten, and their number. Soft counts stray a little from whole numbers.
"""

import json

import numpy as np
import pytest

from probscene.errors import DataError, ProbsceneError
from probscene.inference.statistics.verdict import Verdict, structure_verdict

PAPER = (0.05, 0.15, 0.4, 0.4)  # one to four roads
NAMES = ("road", *(f"car {i}" for i in range(1, 7)))
TEN = np.full(10, 0.1)


def roads(rng, number, shares=PAPER, first=9.0, others=3.0, cars=None, stray=0.05):
    counts = np.full((number, 7), -1.0)
    counts[:, 0] = rng.choice(np.arange(1, len(shares) + 1), number, p=np.divide(shares, sum(shares)))
    for j in range(6):
        drawn = rng.poisson(first if j == 0 else others, number) if cars is None else cars(rng, number)
        counts[:, 1 + j] = np.where(counts[:, 0] > j, drawn, -1)
    return counts + stray * rng.normal(size=counts.shape)


def digits(rng, number, lengths, classes, stray=0.05):
    length = rng.choice(len(lengths), number, p=lengths)
    counts = np.column_stack([rng.multinomial(length, classes), length]).astype(float)
    return counts + stray * rng.normal(size=counts.shape)


def some_cars(rng, number):
    """Zero to eight, and a tenth of the roads nine to twenty."""
    return np.where(rng.random(number) < 0.9, rng.integers(0, 9, number), rng.integers(9, 21, number))


def close_to(rng, shares, far):
    """Shares about ``far`` in total variation from others."""
    other = rng.dirichlet(np.ones(len(shares)))
    return shares + (other - shares) * min(1, far / (np.abs(other - shares).sum() / 2))


def aerial(case, rng, N=500, L=450):
    prior, real = roads(rng, N, (1, 1, 1, 1), cars=some_cars), roads(rng, L)
    if case == "good":
        return roads(rng, N), real, prior
    if case == "as good as the experiment asks":  # total variation 0.03, 0.03, 0.02
        return roads(rng, N, (0.06, 0.17, 0.40, 0.37), 8.8, 3.1, stray=0.1), real, prior
    if case == "the prior":
        return roads(rng, N, (1, 1, 1, 1), cars=some_cars), real, prior
    if case == "one mode":
        return roads(rng, N, (0, 0, 1)), real, prior
    if case == "too many roads":
        return roads(rng, N, (0, 0, 0, 1)), roads(rng, L, (0, 0, 0, 0, 1, 1)), prior
    if case == "some have too many roads":
        return roads(rng, N), roads(rng, L, (*np.multiply(0.7, PAPER), 0.15, 0.15)), prior
    if case == "another domain":
        elsewhere = rng.normal(size=(L, 7)) + [3.0, 40, 2, 35, -1, 20, 9]
        return roads(rng, N), elsewhere, prior
    return roads(rng, N, PAPER, 4.5, 4.5), real, prior  # what no context-free grammar can do better


def numbers(case, rng, N=500, L=450):
    lengths, classes = rng.dirichlet(np.ones(11)), rng.dirichlet(np.ones(10))
    uniform, longest = np.full(11, 1 / 11), np.eye(11)
    prior, real = digits(rng, N, uniform, TEN), digits(rng, L, lengths, classes)
    if case == "good":
        return digits(rng, N, lengths, classes), real, prior
    if case == "as good as the experiment asks":
        return digits(rng, N, close_to(rng, lengths, 0.04), close_to(rng, classes, 0.02), 0.08), real, prior
    if case == "the prior":
        return digits(rng, N, uniform, TEN), real, prior
    if case == "one mode":
        return digits(rng, N, longest[lengths.argmax()], classes), real, prior
    many = np.zeros(16)
    many[11:] = 0.2
    return digits(rng, N, longest[10], TEN), digits(rng, L, many, TEN), prior  # too many digits


CASES = [
    (aerial, "good", Verdict.GOOD),
    (aerial, "as good as the experiment asks", Verdict.GOOD),
    (aerial, "the prior", Verdict.NOT_FITTED),
    (aerial, "one mode", Verdict.MODE_COLLAPSE),
    (aerial, "too many roads", Verdict.OUT_OF_SUPPORT),
    (aerial, "some have too many roads", Verdict.OUT_OF_SUPPORT),
    (aerial, "another domain", Verdict.DOMAIN_SHIFT),
    (aerial, "context lost", Verdict.UNDERFIT),
    (numbers, "good", Verdict.GOOD),
    (numbers, "as good as the experiment asks", Verdict.GOOD),
    (numbers, "the prior", Verdict.NOT_FITTED),
    (numbers, "one mode", Verdict.MODE_COLLAPSE),
    (numbers, "too many digits", Verdict.OUT_OF_SUPPORT),
]


@pytest.mark.parametrize(("make", "case", "expected"), CASES)
def test_the_verdict_is_right(make, case, expected):
    found = structure_verdict(*make(case, np.random.default_rng(7)), resolution=0.5)
    assert found.verdict == expected
    json.dumps(found.record(), allow_nan=False)


@pytest.fixture
def verdict_alone(monkeypatch):
    """Without the difference that would be detected, which takes most of the work and decides nothing."""
    monkeypatch.setattr("probscene.inference.statistics.difference_test._Test.detectable", lambda self: None)


def test_false_alarms_are_rare_and_the_prior_is_never_good(verdict_alone):
    good = prior = 0
    for seed in range(15):
        rng = np.random.default_rng(seed)
        make = (aerial, numbers)[seed % 2]
        good += structure_verdict(*make("good", rng, 400, 300), resolution=0.5).verdict == Verdict.GOOD
        prior += structure_verdict(*make("the prior", rng, 400, 300), resolution=0.5).verdict == Verdict.GOOD
    assert good >= 14 and prior == 0


def test_the_farther_the_fit_the_lower_the_trust(verdict_alone):
    rng = np.random.default_rng(0)
    real, prior = roads(rng, 600), roads(rng, 600, (1, 1, 1, 1), cars=some_cars)
    found = [
        structure_verdict(roads(rng, 600, first=9 - less), real, prior, resolution=0.5).statistics
        for less in (0, 1, 2, 4)
    ]
    for order in (
        [x.joint.ratio for x in found],
        [x.marginal.largest.distance for x in found],
        [x.real_uncovered.share for x in found],
        [-x.ess_fraction for x in found],
        [-x.fidelity.coverage for x in found],
    ):
        assert order == sorted(order)
    assert found[-1].marginal.feature == 1  # cars on the first road


def test_neither_the_order_of_images_nor_the_seed_decides():
    generated, real, prior = numbers("one mode", np.random.default_rng(3), 600, 500)
    rng = np.random.default_rng(0)
    again = [
        structure_verdict(*(rng.permutation(x) for x in (generated, real, prior)), resolution=0.5, seed=s)
        for s in range(3)
    ]
    assert {found.verdict for found in again} == {Verdict.MODE_COLLAPSE}
    one, other = (structure_verdict(generated, real, prior, resolution=0.5, seed=1).record() for _ in range(2))
    assert one == other


def test_the_images_that_stand_apart_are_named():
    rng = np.random.default_rng(1)
    real = roads(rng, 700)
    real[13] = real[250] = [6, 9, 30, 3, 30, 3, 30]
    generated = roads(rng, 700)
    generated[99] = [4, 60, 60, 60, 60, -1, -1]
    found = structure_verdict(generated, real, names=NAMES, resolution=0.5)
    assert set(found.statistics.real_uncovered.worst[:2]) == {13, 250}
    assert found.statistics.generated_uncovered.worst[0] == 99
    assert found.verdict == Verdict.GOOD and found.statistics.real_uncovered.share < 0.02  # three images are no verdict
    assert set(found.record()["single_features"]) == set(NAMES)


def test_looks_decide_what_domain_it_is(verdict_alone):
    """The counts of a strange picture may be quite ordinary."""
    rng = np.random.default_rng(0)
    case = aerial("good", rng, 300, 300)
    near, far, scenes = rng.normal(size=(3, 60, 9, 50)) * 0.1 + np.eye(50)[:9]
    far[:, 1:] += 1
    assert structure_verdict(*case, resolution=0.5, patches=(near, scenes)).verdict == Verdict.GOOD
    found = structure_verdict(*case, resolution=0.5, patches=(far, scenes))
    assert found.verdict == Verdict.DOMAIN_SHIFT and found.statistics.by_patches
    some = np.concatenate([far[:20], near[20:]])
    found = structure_verdict(*aerial("the prior", rng, 300, 300), resolution=0.5, patches=(some, scenes))
    assert found.verdict == Verdict.NOT_FITTED and 0.2 < found.statistics.domain_shift_share < 0.5


def test_wide_features_are_judged_by_their_principal_components():
    rng = np.random.default_rng(0)
    spread = rng.normal(size=(7, 200))
    generated, real, prior = (x @ spread for x in aerial("the prior", rng, 500, 500))
    found = structure_verdict(generated, real, prior, names=tuple(f"f{i}" for i in range(200)))
    assert found.verdict == Verdict.NOT_FITTED and found.statistics.feature_names[:2] == ("component 0", "component 1")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda g, r, p: (g, r[:39], p), "at least 40 real images, got 39"),
        (lambda g, r, p: (g, np.repeat(r[:1], 60, 0), p), "60 images with the same features"),
        (lambda g, r, p: (g[:39], r, p), "generated features .40 or more, 7., got .39, 7."),
        (lambda g, r, p: (g, r, p[:, :5]), "prior features"),
        (lambda g, r, p: (np.where(g > 3, np.nan, g), r, p), "finite generated features"),
    ],
)
def test_what_cannot_be_judged(change, says):
    rng = np.random.default_rng(0)
    with pytest.raises((DataError, ProbsceneError), match=says):
        structure_verdict(*change(*(roads(rng, 80) for _ in range(3))))


def test_forty_images_are_enough_to_see_the_coarse(verdict_alone):
    rng = np.random.default_rng(0)
    generated, real, prior = aerial("good", rng, 500, 40)
    assert structure_verdict(generated, real, prior, resolution=0.5).verdict == Verdict.GOOD
    assert structure_verdict(prior[::-1], real, prior, resolution=0.5).verdict == Verdict.NOT_FITTED
