"""Tallies against lists of units, and their intervals against scipy's bootstrap and against fresh samples."""

import math

import numpy as np
import pytest
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st

from probscene.errors import ProbsceneError
from probscene.inference.statistics import count_metrics as metrics
from probscene.inference.statistics.count_metrics import (
    bootstrap_interval,
    mean_interval,
    resamples,
    tally,
    tally_images,
)

IMAGES = st.lists(st.lists(st.integers(0, 6), max_size=4), min_size=1, max_size=12)  # the counts of each one's units


def of(images, size=50, seed=0):
    count = [c for counts in images for c in counts]
    image = [i for i, counts in enumerate(images) for _ in counts]
    return tally(count, image, resamples(len(images), size, seed))


@given(IMAGES)
def test_a_tally_counts_units_one_by_one(images):
    units = [c for counts in images for c in counts]
    found = of(images)
    assert found.empty == (not units)
    share = found.histogram().share
    assert share.tolist() == pytest.approx([units.count(k) / max(1, len(units)) for k in range(len(share))])
    if units:
        mean, low, high = found.mean()
        assert mean == pytest.approx(sum(units) / len(units)) and low <= mean + 1e-9 and high >= mean - 1e-9
    else:
        assert found.mean() is None


@given(IMAGES, st.integers(0, 3))
def test_a_resample_draws_whole_images(images, seed):
    weight = resamples(len(images), 20, seed)
    assert (weight.sum(1) == len(images)).all()
    found = of(images, 20, seed)
    for drawn, row in zip(weight.astype(int), found.resampled, strict=True):
        again = [c for i, times in enumerate(drawn) for _ in range(times) for c in images[i]]
        assert np.bincount(again, minlength=len(row)).tolist() == row.tolist() if again else not row.any()


@given(IMAGES, IMAGES)
def test_distances_are_those_of_all_units(one, other):
    a, b = ([c for counts in images for c in counts] for images in (one, other))
    found = of(one).distance(of(other, seed=1))
    if not a or not b:
        assert found is None
        return
    p, q = metrics.histogram(a), metrics.histogram(b)
    assert found.total_variation.value == pytest.approx(metrics.total_variation(p, q))
    assert found.wasserstein.value == pytest.approx(scipy.stats.wasserstein_distance(a, b))
    for value, low, high in found:
        assert 0 <= low <= high and low <= value + 1e-9
    same = of(one).distance(of(one))
    assert same.total_variation.value == same.wasserstein.value == 0


def test_the_interval_of_a_mean_agrees_with_scipys_bootstrap():
    values = np.random.default_rng(0).exponential(2.0, 150)
    found = mean_interval(values, resamples(150, 20000))
    expected = scipy.stats.bootstrap((values,), np.mean, n_resamples=20000, method="percentile", rng=1)
    assert found.value == pytest.approx(values.mean())
    assert found.low == pytest.approx(expected.confidence_interval.low, abs=0.02)
    assert found.high == pytest.approx(expected.confidence_interval.high, abs=0.02)


def test_images_whose_units_agree_give_wider_intervals_than_their_units_alone():
    rng = np.random.default_rng(0)
    alike = [[c] * 4 for c in rng.integers(0, 2, 200)]
    apart = [list(rng.integers(0, 2, 4)) for _ in range(200)]
    width = [np.ptp([h.low[1], h.high[1]]) for h in (of(alike, 1000).histogram(), of(apart, 1000).histogram())]
    assert width[0] / width[1] == pytest.approx(2.0, rel=0.2)


def test_an_interval_spans_what_fresh_samples_give():
    rng = np.random.default_rng(0)
    far, near = np.array([0.1, 0.2, 0.7]), np.array([0.5, 0.3, 0.2])

    def drawn(seed, size=300):
        return [
            tally_images(rng.choice(3, 400, p=p), resamples(400, size, seed + i)) for i, p in enumerate((far, near))
        ]

    values = [a.distance(b).total_variation.value for a, b in (drawn(0, 1) for _ in range(200))]
    found = [a.distance(b).total_variation for a, b in (drawn(7 * i) for i in range(20))]
    width = np.mean([x.high - x.low for x in found])
    assert width == pytest.approx(np.ptp(np.quantile(values, [0.025, 0.975])), rel=0.25)
    assert sum(x.low <= 0.5 <= x.high for x in found) >= 16


def test_a_rare_unit_that_most_resamples_lack():
    found = of([[3], [], [], []], 40)
    assert found.resampled.sum(1).min() == 0
    share = found.histogram()
    assert share.share.tolist() == share.low.tolist() == share.high.tolist() == [0, 0, 0, 1]
    assert found.distance(of([[1], [1]])).wasserstein == (2.0, 2.0, 2.0)


def test_figures_without_resamples_have_no_width():
    assert bootstrap_interval(0.3, [math.nan]) == (0.3, 0.3, 0.3)
    assert bootstrap_interval(0.1, [0.0, 1.0], minimum=0.0).low == 0.0


@pytest.mark.parametrize("count, image", [([-1], [0]), ([1], [2]), ([1], [-1]), ([1, 2], [0])])
def test_what_is_no_unit_of_an_image_is_refused(count, image):
    with pytest.raises(ProbsceneError, match="expected counts of 0 or more in images 0..1"):
        tally(count, image, resamples(2, 3))
