"""How near a fit is: the distances by plain loops, and the words as laws."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from probscene.inference.statistics.residual import (
    GOOD_RATIO,
    GOOD_RATIO_AT_FLOOR,
    Grade,
    ResidualRatio,
    Sample,
    residual_ratio,
    worst_grade,
)

RANKED = [Grade.GOOD, Grade.BETTER, None, Grade.NO_BETTER]


def normal(seed, rows=200, shift=0.0, width=4):
    return np.random.default_rng(seed).normal(shift, 1.0, (rows, width))


def judged(real, learnt, prior, structure=None, **more) -> ResidualRatio:
    others = {"prior": Sample(prior)} | ({} if structure is None else {"structure alone": Sample(structure)})
    return residual_ratio(Sample(real), Sample(learnt), others, **more)


def plain(one, other):
    """The energy distance without bias, pair by pair."""

    def mean(a, b, same):
        pairs = [np.linalg.norm(x - y) for i, x in enumerate(a) for j, y in enumerate(b) if not (same and i == j)]
        return sum(pairs) / len(pairs)

    return 2 * mean(one, other, False) - mean(one, one, True) - mean(other, other, True)


def test_distances_are_those_of_plain_loops():
    real, learnt, prior = normal(0, 21), normal(1, 17, 0.5), normal(2, 19, 1.0)
    found = judged(real, learnt, prior)
    assert found.learnt == pytest.approx(plain(learnt, real)) and found.rows == 21
    assert found.references["prior"] == pytest.approx(plain(prior, real))
    assert found.ratio == pytest.approx(plain(learnt, real) / plain(prior, real))
    assert found.low < found.ratio < found.high and found.nearest == "prior"
    assert set(json.loads(json.dumps(found.record(), allow_nan=False))["distances"]) == {"learnt", "prior", "floor"}


@pytest.mark.parametrize("seed", range(5))
def test_a_sample_of_the_target_is_good_and_the_prior_is_not(seed):
    real, prior, before = normal(seed), normal(seed + 50, shift=1.0), normal(seed + 100, shift=1.0)
    assert judged(real, normal(seed + 150), prior).grade is Grade.GOOD
    assert judged(real, before, prior).grade is Grade.NO_BETTER  # another sample of the prior
    assert judged(real, prior, prior).grade is Grade.NO_BETTER  # the very same
    assert judged(real, normal(seed + 150, shift=0.5), prior).grade is Grade.BETTER


def test_a_fit_is_held_against_the_nearest_of_the_others():
    real, learnt, prior, structure = normal(0), normal(1, shift=0.5), normal(2, shift=1.5), normal(3, shift=0.5)
    assert judged(real, learnt, prior).grade is Grade.BETTER
    found = judged(real, learnt, prior, structure)
    assert found.nearest == "structure alone" and found.grade is Grade.NO_BETTER


def test_where_the_prior_is_right_nothing_is_called_good():
    found = judged(normal(0), normal(1), normal(2))
    assert found.ratio is None and found.close and found.grade is None
    assert judged(normal(0), normal(1, shift=0.4), normal(2)).grade is Grade.NO_BETTER


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize(("rows", "shift"), [(20, 1.0), (40, 0.3), (40, 1.0), (100, 0.2), (200, 0.1), (200, 2.0)])
def test_the_prior_is_never_good(seed, rows, shift):
    """However few images there are, and however near it is."""
    real, prior = normal(seed, rows), normal(seed + 50, rows, shift)
    for learnt in (prior, normal(seed + 100, rows, shift)):
        assert judged(real, learnt, prior).grade is not Grade.GOOD


@pytest.mark.parametrize("seed", range(5))
def test_farther_away_never_has_a_better_word(seed):
    real, prior, learnt = normal(seed), normal(seed + 1, shift=0.8), normal(seed + 2)
    away = np.sign((learnt - real).mean(0)) * 0.5  # never back toward the real mean
    words = [RANKED.index(judged(real, learnt + shift * away, prior).grade) for shift in np.linspace(0, 2, 9)]
    assert words == sorted(words) and words[0] < words[-1]


@given(st.floats(0, 2), st.floats(0, 2), st.floats(1e-3, 1), st.floats(1, 3), st.booleans())
def test_more_distance_never_has_a_better_word(one, other, floor, wide, covered):
    def word(distance):
        if not covered:
            return RANKED.index(ResidualRatio(distance, {"prior": 1.0}, floor, None, 0.0, np.inf, 100).grade)
        limits = distance / wide, distance * wide
        figures = ResidualRatio(distance, {"prior": 1.0}, floor, distance, *limits, 100)
        return RANKED.index(figures.grade)

    near, far = sorted((one, other))
    assert word(near) <= word(far)
    if covered and wide * near > max(GOOD_RATIO, GOOD_RATIO_AT_FLOOR):
        assert word(near) > 0  # never good


@given(st.lists(st.sampled_from(RANKED), min_size=1))
def test_the_worst_is_one_of_them_and_none_is_worse(words):
    assert worst_grade(words) in words and all(RANKED.index(word) <= RANKED.index(worst_grade(words)) for word in words)
    assert worst_grade([]) is Grade.GOOD


def with_numbers(seed, shares, shift=0.0):
    """Rows about their number, as layouts are of few or of many objects."""
    number = np.random.default_rng(seed).choice(len(shares), 300, p=shares)
    return Sample(normal(seed, 300, shift) + 2.0 * number[:, None], number.astype(float))


def test_other_numbers_alone_are_no_distance():
    few, many = [0.6, 0.3, 0.1], [0.1, 0.3, 0.6]
    real, learnt, prior = with_numbers(0, many), with_numbers(1, few), with_numbers(2, few, 1.0)
    assert residual_ratio(real, learnt, {"prior": prior}).grade is Grade.GOOD
    assert residual_ratio(real, prior, {"prior": learnt}).grade is Grade.NO_BETTER
    rows = Sample(learnt.features), {"prior": Sample(prior.features)}
    assert (
        residual_ratio(Sample(real.features), *rows).grade is not Grade.GOOD
    )  # it is, where numbers are not asked for


def test_many_numbers_come_in_bins():
    rng = np.random.default_rng(0)
    samples = [Sample(normal(seed, shift=s), rng.integers(5, 60, 200) + 0.0) for seed, s in ((0, 0), (1, 0), (2, 1))]
    assert residual_ratio(samples[0], samples[1], {"prior": samples[2]}).grade is Grade.GOOD


def test_without_common_numbers_nothing_is_compared():
    real, none, prior = with_numbers(0, [0, 0, 1]), with_numbers(1, [0.5, 0.5, 0]), with_numbers(2, [0, 0, 1], 1.0)
    assert residual_ratio(real, none, {"prior": prior}) is None
    found = residual_ratio(real, with_numbers(3, [0, 0, 1]), {"prior": none})
    assert found.references == {} and found.nearest is None and found.grade is None
    few = Sample(normal(0, 5))
    assert residual_ratio(few, real, {}) is None and residual_ratio(real, few, {}) is None


def test_a_sample_of_the_target_is_good_nearly_always():
    words = [judged(normal(3 * s, 100), normal(3 * s + 1, 100), normal(3 * s + 2, 100, 0.7)).grade for s in range(40)]
    assert words.count(Grade.GOOD) >= 37 and Grade.NO_BETTER not in words
