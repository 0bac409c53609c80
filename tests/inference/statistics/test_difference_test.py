"""A verdict's test: where sets are alike it finds nothing, and it finds what it says that it would."""

import numpy as np
import pytest

from probscene.inference.statistics.difference_test import TOLERATED_TV, difference_test

SHARES = np.array([0.1, 0.2, 0.3, 0.25, 0.15])


def counted(rng, number, shares):
    """Objects of one class and of another one, read with a small error."""
    drawn = np.column_stack([rng.choice(len(shares), number, p=shares), rng.poisson(1.0, number)])
    return drawn + 0.05 * rng.normal(size=drawn.shape)


def moved(distance):
    """Shares that are so far away in total variation, from the first two to the last two."""
    less, more = SHARES[:2].sum(), SHARES[3:].sum()
    return np.r_[SHARES[:2] * (1 - distance / less), SHARES[2], SHARES[3:] * (1 + distance / more)]


def test_what_it_names_is_found_and_what_is_alike_is_not():
    found = {0.0: 0, 1.0: 0}
    for seed in range(5):
        rng = np.random.default_rng(seed)
        real = counted(rng, 250, SHARES)
        named = difference_test(counted(rng, 250, SHARES), real, 0.5, seed)
        found[0.0] += named.significant
        assert 0.1 < named.detectable < 0.3
        found[1.0] += difference_test(counted(rng, 250, moved(named.detectable)), real, 0.5, seed).significant
    assert found[0.0] <= 1 and found[1.0] >= 4


def test_more_images_show_smaller_differences_down_to_what_is_tolerated():
    rng = np.random.default_rng(0)
    named = [difference_test(counted(rng, n, SHARES), counted(rng, n, SHARES), 0.5).detectable for n in (40, 100, 250)]
    assert named == sorted(named, reverse=True) and named[-1] > TOLERATED_TV


def test_it_says_where_they_differ():
    rng = np.random.default_rng(0)
    real, other = counted(rng, 300, SHARES), counted(rng, 300, np.array([0.3, 0.2, 0.02, 0.25, 0.23]))
    found = difference_test(other, real, 0.5)
    assert found.significant and found.feature == 0 and found.total_variation == pytest.approx(0.28, abs=0.08)
    turned = difference_test(other[:, ::-1], real[:, ::-1], 0.5)
    assert turned.significant and turned.feature == 1
    assert difference_test(other, real, 0.5) == found  # the same for the same seed


def test_features_that_agree_one_by_one_and_not_together_differ():
    rng = np.random.default_rng(0)
    one, other = rng.normal(size=(2, 300, 2))
    other[:, 1] = other[:, 0]
    found = difference_test(other, one)
    assert found.significant and found.feature is None


@pytest.mark.parametrize("share", [0.0, 0.2])
def test_a_feature_that_is_constant_in_the_real_images_is_compared(share):
    rng = np.random.default_rng(0)
    real, other = (np.pad(counted(rng, 200, SHARES), ((0, 0), (0, 1))) for _ in range(2))
    other[:, 2] = rng.random(200) < share
    found = difference_test(other, real, 0.5)
    assert found.significant is (share > 0) and (not share or found.feature == 2)


def test_features_that_hardly_vary_name_nothing():
    rng = np.random.default_rng(0)
    ones = 1 + 0.01 * rng.normal(size=(2, 60, 3))
    found = difference_test(*ones, 0.5)
    assert not found.significant and found.detectable is None
