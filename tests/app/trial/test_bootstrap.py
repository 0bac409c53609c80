"""Laws of the paired bootstrap and of what a set is worth."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from probscene.app.trial.bootstrap import draw, estimate, monotone, over_seeds, worth, worth_in_words

VALUES = st.lists(st.floats(0, 1, allow_subnormal=False), min_size=1, max_size=6)


def test_the_first_draw_is_all_once_and_every_draw_is_as_large():
    draws = draw(images=7, seeds=3, resamples=50, seed=1)
    assert (draws.images[0] == 1).all() and (draws.seeds[0] == 1).all()
    assert (draws.images.sum(1) == 7).all() and (draws.seeds.sum(1) == 3).all()
    again = draw(images=7, seeds=3, resamples=50, seed=1)
    assert (again.images == draws.images).all() and (draw(7, 3, 50, 2).images != draws.images).any()


def test_means_over_seeds_are_of_those_drawn():
    draws = draw(4, 3, 20, 0)
    each = np.random.default_rng(0).random((3, 21))
    slow = [np.repeat(each[:, b], draws.seeds[b]).mean() for b in range(21)]
    np.testing.assert_allclose(over_seeds(each, draws), slow)


# The engine, where a test before has loaded it, has the processor take subnormal numbers for 0.
SHARES = st.floats(-1, 1, allow_subnormal=False)


@given(SHARES, st.lists(SHARES, min_size=1, max_size=50))
def test_an_interval_lies_within_its_resamples_and_shifts_with_them(value, resamples):
    found = estimate(np.array([value, *resamples]))
    assert found.value == value and min(resamples) <= found.low <= found.high <= max(resamples)
    assert 0 <= found.above <= 1
    moved = estimate(np.array([value, *resamples]) + 5)
    assert moved.low == pytest.approx(found.low + 5) and moved.above == 1


def test_the_interval_of_a_mean_covers_it():
    """95 % intervals of the mean of 40 images hold the truth about 95 times in a hundred."""
    random, inside = np.random.default_rng(0), 0
    for trial in range(200):
        images = random.normal(size=40)
        draws = draw(40, 1, 400, trial).images
        found = estimate(draws @ images / 40)
        inside += found.low <= 0 <= found.high
    assert 0.89 <= inside / 200 <= 0.985


def test_what_is_not_known_has_no_interval():
    assert np.isnan(estimate(np.array([np.nan, np.nan])).low)


@given(VALUES)
def test_monotone_values_never_fall_and_keep_their_sum(values):
    found = monotone(values)
    assert (np.diff(found) >= -1e-12).all() and found.sum() == pytest.approx(sum(values))
    if (np.diff(values) >= 0).all():
        np.testing.assert_allclose(found, values)


@given(st.lists(st.floats(0.01, 0.99), min_size=2, max_size=5, unique=True), st.floats(0, 1), st.floats(0, 1))
def test_worth_rises_with_precision_and_is_known_at_the_numbers(reached, one, other):
    numbers, reached = [10, 20, 50, 200, 400][: len(reached)], sorted(reached)
    low, high = sorted((one, other))
    assert worth(low, numbers, reached) <= worth(high, numbers, reached)
    for number, value in zip(numbers, reached, strict=True):
        assert worth(value, numbers, reached) == pytest.approx((number, number))


def test_worth_is_a_line_in_the_logarithm_and_says_what_is_outside():
    numbers, reached = [10, 1000], [0.4, 0.6]
    assert worth(0.5, numbers, reached)[0] == pytest.approx(100)
    words = [worth_in_words(value, numbers, reached) for value in (0.3, 0.5, 0.7)]
    assert words == ["<10", "100", ">1000"]
