"""Lost modes, binomial limits and the effective sample size, against scipy and scikit-learn."""

import numpy as np
import pytest
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st
from sklearn.linear_model import LogisticRegression

from probscene.inference.statistics.modes import _logistic, binomial_interval, ess_fraction, modes


@given(st.integers(1, 300), st.data(), st.sampled_from([0.9, 0.95, 0.999]))
def test_limits_of_a_share_are_scipys(number, data, level):
    found = data.draw(st.integers(0, number))
    exact = scipy.stats.binomtest(found, number).proportion_ci(level, "exact")
    low, high = binomial_interval(np.array([found]), number, level)
    assert (low[0], high[0]) == pytest.approx((exact.low, exact.high), abs=1e-9)


def blobs(seed: int, shares, number: int = 800):
    """Points about (0, 0), (10, 0), (20, 0), ... in these shares."""
    rng = np.random.default_rng(seed)
    which = rng.choice(len(shares), number, p=np.divide(shares, sum(shares)))
    return rng.normal(size=(number, 2)) + np.stack([10 * which, 0 * which], 1)


def test_a_mode_is_lost_where_the_prior_had_it_and_missing_where_not():
    real = blobs(0, [1, 1, 1])
    found = modes(blobs(1, [1, 1, 0]), real, blobs(2, [1, 1, 1]))
    gone = found.centre[:, 0] > 15
    assert np.array_equal(found.collapsed, gone) and not found.missing.any()
    assert found.real[gone].sum() == pytest.approx(1 / 3, abs=0.06) and found.generated[gone].sum() == 0
    found = modes(blobs(1, [1, 1, 0]), real, blobs(2, [1, 1, 0]))
    assert np.array_equal(found.missing, gone) and not found.collapsed.any()
    assert np.array_equal(modes(blobs(1, [1, 1, 0]), real).collapsed, gone)  # no prior: it might have


def test_no_mode_is_lost_between_samples_of_one_distribution():
    for seed in range(20):
        found = modes(blobs(seed, [4, 2, 1, 0.3]), blobs(100 + seed, [4, 2, 1, 0.3]))
        assert not (found.collapsed | found.missing).any()
        assert (found.low <= 1).all() and (found.high >= 1).all()  # 95 % for all at once, and exact limits are wide
        assert found.real.sum() == pytest.approx(1) and found.generated.sum() == pytest.approx(1)


def test_few_images_and_equal_ones_have_few_modes():
    assert len(modes(blobs(0, [1, 1]), blobs(1, [1, 1], 60)).centre) == 1
    real = np.repeat([[0.0, 0.0], [1.0, 0.0]], 300, 0)
    assert len(modes(real, real).centre) == 2


@pytest.mark.parametrize("penalty", [0.1, 3.0])
def test_the_classifier_is_scikit_learns(penalty):
    rng = np.random.default_rng(0)
    x = np.pad(rng.normal(size=(300, 4)), ((0, 0), (1, 0)), constant_values=1)
    y = (x @ [0.5, 1, -2, 0, 0.3] + rng.logistic(size=300) > 0).astype(float)
    theirs = LogisticRegression(C=1 / penalty, tol=1e-8, max_iter=1000).fit(x[:, 1:], y)
    assert _logistic(x, y, penalty) == pytest.approx([*theirs.intercept_, *theirs.coef_[0]], abs=1e-4)


def test_effective_share_is_that_of_the_true_density_ratio():
    rng = np.random.default_rng(0)
    real = rng.normal(size=(2000, 1))
    assert ess_fraction(rng.normal(size=(2000, 1)), real) > 0.95
    before = 1.0
    for shift in (0.5, 1.0, 1.5):
        generated = rng.normal(size=(2000, 1)) + shift
        expected = np.exp(-(shift**2))  # E[w]^2 / E[w^2] of two unit normals so far apart
        found = ess_fraction(generated, real)
        assert found == pytest.approx(expected, abs=0.15) and found < before
        before = found
