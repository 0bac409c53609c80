"""The interval of a mean holds whatever is read, and is narrower where it is read well."""

import numpy as np
import pytest
from scipy.stats import binomtest, ttest_1samp

from probscene.inference.statistics.prediction_powered import prediction_powered_mean


def read_well(rng, y):
    return y + rng.normal(0, 0.3, len(y))


def half_of_them(rng, y):
    return rng.binomial(y, 0.5) + 4.0


def at_random(rng, y):
    return rng.poisson(9, len(y)).astype(float)


def nothing(rng, y):
    return np.full(len(y), 2.0)


@pytest.mark.parametrize("read", [read_well, half_of_them, at_random, nothing])
@pytest.mark.parametrize("mean", [0.1, 0.7, 3.0])
@pytest.mark.parametrize("K", [10, 40])
def test_the_interval_holds_the_mean_as_often_as_it_says(read, K, mean):
    """Or more often, where counts are few and whole numbers."""
    rng, held, runs = np.random.default_rng(0), 0, 600
    for _ in range(runs):
        y = rng.poisson(mean, 300)
        f = read(rng, y)
        found = prediction_powered_mean(y[:K], f[:K], f[K:])
        held += found.low <= mean <= found.high
    assert binomtest(held, runs).proportion_ci(1 - 1e-6).high + 0.02 > 0.9  # ten counts are not normal


def test_good_readings_make_it_narrower_and_bad_ones_not_wider():
    rng, width = np.random.default_rng(0), {}
    y = rng.poisson(3, 400)
    labels_alone = ttest_1samp(y[:20], 0).confidence_interval(0.9)
    for read in (read_well, at_random):
        f = read(rng, y)
        found = prediction_powered_mean(y[:20], f[:20], f[20:])
        width[read] = (found.high - found.low) / (labels_alone.high - labels_alone.low)
    assert width[read_well] < 0.5 and width[at_random] < 1.1


def test_without_other_images_it_is_the_labels_own():
    y = np.array([0, 2, 1, 5, 1])
    found, expected = prediction_powered_mean(y, y + 1, []), ttest_1samp(y, 0).confidence_interval(0.9)
    assert found == pytest.approx((y.mean(), max(0, expected.low), expected.high))
    none = prediction_powered_mean(np.zeros(10), np.ones(10), np.ones(50))
    assert none == pytest.approx((0, 0, -np.log(0.05) / 10))  # (1 - p)^n as it is for a Poisson distribution
    assert prediction_powered_mean(y[:3], y[:3], [1.0, 2.0]) is None
