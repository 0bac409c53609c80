"""Distances between count distributions and intervals of histograms, against scipy and by brute force."""

import itertools

import numpy as np
import pytest
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from probscene.errors import ProbsceneError
from probscene.inference.statistics import count_metrics as metrics

VALUES = st.lists(st.integers(0, 12), min_size=1, max_size=60)
COUNTS = st.tuples(st.integers(1, 20), st.integers(1, 5)).flatmap(
    lambda shape: arrays(np.int64, shape, elements=st.integers(0, 9))
)


@st.composite
def shares(draw):
    weight = np.array(draw(st.lists(st.integers(0, 20), min_size=1, max_size=8).filter(any)), float)
    return weight / weight.sum()


@given(VALUES)
def test_a_histogram_is_the_share_of_each_value(values):
    share = metrics.histogram(values)
    assert share.tolist() == [values.count(k) / len(values) for k in range(max(values) + 1)]
    assert np.array_equal(metrics.histogram(values, 20)[: len(share)], share)


@given(COUNTS)
def test_pooled_shares_count_objects_one_by_one(counts):
    objects = [c for row in counts for c, number in enumerate(row) for _ in range(number)]
    expected = [objects.count(c) / max(1, len(objects)) for c in range(counts.shape[1])]
    assert metrics.pooled_shares(counts) == pytest.approx(expected)


@given(shares(), shares())
def test_total_variation_is_the_largest_difference_of_any_event(p, q):
    size = max(len(p), len(q))
    p0, q0 = np.pad(p, (0, size - len(p))), np.pad(q, (0, size - len(q)))
    events = itertools.product([0, 1], repeat=size)
    largest = max(abs(np.dot(event, p0) - np.dot(event, q0)) for event in events)
    assert metrics.total_variation(p, q) == pytest.approx(largest, abs=1e-12)


@given(shares(), shares())
def test_wasserstein_agrees_with_scipy(p, q):
    expected = scipy.stats.wasserstein_distance(range(len(p)), range(len(q)), p, q)
    assert metrics.wasserstein(p, q) == pytest.approx(expected, abs=1e-9)


@given(shares(), shares(), shares())
def test_both_distances_are_metrics(p, q, r):
    for distance in (metrics.total_variation, metrics.wasserstein):
        assert distance(p, p) == 0
        assert distance(p, q) == distance(q, p)
        assert distance(p, r) <= distance(p, q) + distance(q, r) + 1e-12
    assert metrics.total_variation(p, q) <= 1


def test_the_interval_of_a_bin_is_that_of_a_binomial():
    values = np.repeat([0, 1, 3], [50, 120, 30])
    found = metrics.histogram_interval(values, level=0.9, size=20000)
    for k, number in enumerate([50, 120, 0, 30]):
        low, high = scipy.stats.binom.interval(0.9, 200, number / 200)
        assert found.low[k] * 200 == pytest.approx(low, abs=1)
        assert found.high[k] * 200 == pytest.approx(high, abs=1)


def test_the_interval_of_class_shares_agrees_with_scipys_bootstrap():
    rng = np.random.default_rng(0)
    counts = rng.poisson([1.0, 3.0], (80, 2)) * rng.integers(1, 4, (80, 1))  # what one image shows belongs together
    found = metrics.pooled_shares_interval(counts, size=3000)
    ours = scipy.stats.bootstrap(
        (counts[:, 0], counts[:, 1]), lambda a, b, axis: a.sum(axis) / (a + b).sum(axis), paired=True, vectorized=True,
        n_resamples=3000, method="percentile", rng=np.random.default_rng(1),
    ).confidence_interval  # fmt: skip
    assert found.low[0] == pytest.approx(ours.low, abs=0.01)
    assert found.high[0] == pytest.approx(ours.high, abs=0.01)


@given(VALUES, st.integers(0, 5))
def test_an_interval_is_the_same_for_the_same_seed(values, seed):
    found = metrics.histogram_interval(values, size=200, seed=seed)
    assert (found.low <= found.high).all() and found.share.sum() == pytest.approx(1)
    again = metrics.histogram_interval(values, size=200, seed=seed)
    assert all(np.array_equal(a, b) for a, b in zip(found, again, strict=True))


@pytest.mark.parametrize("values", [[], [1.5, 2.0], [-1, 2], [[1, 2]]])
def test_what_is_no_count_is_refused(values):
    with pytest.raises(ProbsceneError, match="expected counts of 0 or more"):
        metrics.histogram(values)


def test_wrong_arguments_are_refused():
    with pytest.raises(ProbsceneError, match="below 3, got 7"):
        metrics.histogram([7], 3)
    with pytest.raises(ProbsceneError, match="sum to 1"):
        metrics.total_variation([0.5, 0.4], [1.0])
    with pytest.raises(ProbsceneError, match="sum to 1"):
        metrics.wasserstein([1.5, -0.5], [1.0])
    with pytest.raises(ProbsceneError, match="level"):
        metrics.histogram_interval([1], level=1.0)


@given(
    st.lists(st.lists(st.integers(0, 400), min_size=1, max_size=60), min_size=1, max_size=4),
    st.integers(3, 20),
)
def test_ranges_are_few_and_hold_every_count_once(samples, most):
    found = metrics.bin_ranges(samples, most)
    assert len(found) <= most
    assert [k for first, last in found for k in range(first, last + 1)] == list(range(max(map(max, samples)) + 1))
    if max(map(max, samples)) < most:
        assert all(first == last for first, last in found)


@given(st.integers(0, 2**31), st.integers(5, 60))
def test_ranges_merge_tails_alone_where_the_rest_has_room(seed, mean):
    samples = [np.random.default_rng(seed + i).poisson(mean, 2000) for i in range(3)]
    found = metrics.bin_ranges(samples)
    widths = {last + 1 - first for first, last in found[1:-2]}
    assert len(widths) <= 1  # of one width, but for the tails and what is left over
    for first, last in (found[0], found[-1]):
        if last + 1 - first > max(widths):  # a tail
            assert all(np.mean((sample >= first) & (sample <= last)) <= 0.0105 for sample in samples)
