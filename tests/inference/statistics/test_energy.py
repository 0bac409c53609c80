"""The energy distance and its floor, against scipy and by brute force; what cannot be judged is said."""

import itertools

import numpy as np
import pytest
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from probscene.errors import DataError
from probscene.inference.statistics.energy import (
    check_features,
    energy_distance,
    energy_test,
    marginal_distances,
    marginal_test,
    permutation_p_value,
    principal_components,
)

# Whole numbers and halves, as counts are: ties are the rule.
HALVES = st.integers(-6, 6).map(lambda x: x / 2)
SETS = st.tuples(st.integers(1, 12), st.integers(1, 12), st.integers(1, 3)).flatmap(
    lambda s: st.tuples(*(arrays(np.float64, (n, s[2]), elements=HALVES) for n in s[:2]))
)


def normal(seed: int, number: int, shift: float = 0.0, width: int = 3):
    return np.random.default_rng(seed).normal(size=(number, width)) + shift


@given(SETS)
def test_single_features_are_as_far_apart_as_scipy_says(sets):
    a, b = sets
    expected = [scipy.stats.energy_distance(x, y) for x, y in zip(a.T, b.T, strict=True)]
    assert marginal_distances(a, b) == pytest.approx(expected, abs=1e-7)
    if a.shape[1] == 1:
        assert energy_distance(a, b) == pytest.approx(expected[0], abs=1e-6)


@given(SETS, st.randoms(use_true_random=False))
def test_the_distance_is_the_mean_over_all_pairs_in_any_order(sets, rng):
    a, b = sets

    def mean(x, y):
        return np.mean([np.sqrt(sum((p - q) ** 2)) for p, q in itertools.product(x, y)])

    assert energy_distance(a, b) ** 2 == pytest.approx(2 * mean(a, b) - mean(a, a) - mean(b, b), abs=1e-9)
    shuffled = a[rng.sample(range(len(a)), len(a))]
    assert energy_distance(b, shuffled) == pytest.approx(energy_distance(a, b), abs=1e-6)
    assert marginal_distances(b, shuffled) == pytest.approx(marginal_distances(a, b), abs=1e-9)
    assert energy_distance(a, shuffled) == pytest.approx(0, abs=1e-6)


def test_the_permutation_test_is_scipys():
    a, b = normal(0, 30, width=1), normal(1, 40, 0.45, width=1)

    def statistic(x, y):
        return scipy.stats.energy_distance(x, y)

    theirs = scipy.stats.permutation_test(
        (a[:, 0], b[:, 0]), statistic, n_resamples=999, alternative="greater", rng=np.random.default_rng(0)
    )
    assert permutation_p_value(a, b, permutations=1999) == pytest.approx(theirs.pvalue, abs=0.03)
    assert 0.005 < theirs.pvalue < 0.3  # so that the comparison says something


def test_p_values_of_one_distribution_are_uniform():
    found = [permutation_p_value(normal(s, 40), normal(1000 + s, 50), permutations=99) for s in range(60)]
    assert scipy.stats.kstest(found, "uniform").pvalue > 1e-3


def test_samples_of_one_distribution_are_at_the_floor():
    """But for one in twenty, which chance sets apart."""
    close = []
    for seed in range(20):
        a, b = normal(seed, 400), normal(1000 + seed, 600)
        joint, single = energy_test(a, b), marginal_test(a, b)
        assert 0.6 < joint.ratio < 1.6 and joint.low <= joint.floor <= joint.high and joint.split_size == 300
        assert joint.close == (joint.rank > 0.05)
        assert single.distances[single.feature] == pytest.approx(single.largest.distance)
        assert single.feature == single.distances.argmax() and single.largest.distance < 2
        close.append((joint.close, single.largest.close))
    assert np.sum(close, 0).min() >= 16


def test_the_farther_the_features_the_less_they_are_taken_for_real():
    real = normal(0, 800)
    shifts = [energy_test(normal(1, 500, shift), real) for shift in (0.0, 0.2, 0.4, 0.8, 1.6)]
    distances, ranks = [x.distance for x in shifts], [x.rank for x in shifts]
    assert distances == sorted(distances) and ranks == sorted(ranks, reverse=True)
    assert shifts[0].close and not shifts[-1].close and ranks[-1] == 0
    assert len({x.floor for x in shifts}) == 1  # it is the real set's own


def test_a_feature_that_is_constant_in_the_real_images_has_a_floor():
    real, rng = np.pad(normal(0, 600), ((0, 0), (0, 1))), np.random.default_rng(2)
    for share, close in ((0.0, True), (0.004, True), (0.4, False)):
        generated = np.pad(normal(1, 600), ((0, 0), (0, 1)))
        generated[:, 3] = rng.random(600) < share
        found = marginal_test(generated, real)
        assert np.isfinite(found.distances).all() and found.largest.close == close
    assert found.feature == 3
    both = marginal_test(np.zeros((100, 1)), np.zeros((100, 1)))
    assert both.distances.tolist() == [0] and both.largest.close


def test_no_unit_changes_the_judgement():
    a, b = normal(0, 300, 0.3), normal(1, 300)
    one, other = energy_test(a, b), energy_test(1000 * a + 7, 1000 * b + 7)
    assert one.ratio == pytest.approx(other.ratio) and one.rank == other.rank
    assert marginal_test(a, b).distances == pytest.approx(marginal_test(1000 * a, 1000 * b).distances)


def test_principal_components_keep_what_varies():
    rng = np.random.default_rng(0)
    wide = rng.normal(size=(200, 5)) @ rng.normal(size=(5, 90))
    a, b = principal_components([wide[:120], wide[120:]], 32)
    assert a.shape == (120, 32) and energy_distance(a, b) == pytest.approx(energy_distance(wide[:120], wide[120:]))
    assert principal_components([wide[:, :7]])[0].shape == (200, 7)


@pytest.mark.parametrize(
    ("real", "says"),
    [
        (np.eye(39), "at least 40 real images, got 39"),
        (np.ones((60, 4)), "60 images with the same features"),
        (np.ones((60, 4)) + 1e-7 * np.arange(60)[:, None], "zero variance in all 4 features"),
        (np.full((60, 4), np.nan), "finite"),
        (np.ones(60), "got .60,."),
    ],
)
def test_features_that_cannot_be_judged(real, says):
    with pytest.raises(DataError, match=says):
        check_features(real)


def test_one_feature_that_varies_is_enough():
    real = np.pad(np.arange(12.0)[:, None], ((0, 0), (0, 3)))
    assert check_features(real, needed=12) is not None
    with pytest.raises(DataError, match="at least 13"):
        check_features(real, needed=13)
