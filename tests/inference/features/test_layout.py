"""Where objects stand, as features: how far layouts are apart is how far objects have to be moved."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment

from probscene.inference.features.counting.layout import objects, scales

SIDE = 16


def cells(*places) -> torch.Tensor:
    """A map with an object in each of the cells."""
    found = torch.zeros(1, SIDE, SIDE)
    for y, x in places:
        found[0, y, x] += 1.0
    return found


def apart(one, other) -> float:
    return float((scales(one) - scales(other)).abs().sum())


@given(st.lists(st.tuples(st.integers(0, 15), st.integers(0, 15)), min_size=1, max_size=5), st.randoms())
def test_the_distance_is_that_of_moving_objects_up_to_a_factor(places, rng):
    moved = [(rng.randrange(SIDE), rng.randrange(SIDE)) for _ in places]
    cost = np.array([[max(abs(a - c), abs(b - d)) for c, d in moved] for a, b in places])
    rows, columns = linear_sum_assignment(cost)
    mean, found = cost[rows, columns].mean(), apart(cells(*places), cells(*moved))
    assert found >= 0.5 * mean
    assert found <= 2 * sum(2.0**level for level in range(5)) and (found == 0) == (mean == 0)


def test_farther_is_farther_and_numbers_do_not_count():
    here = cells((8, 2))
    distances = [apart(here, cells((8, x))) for x in (2, 3, 6, 14)]
    assert distances[0] == 0 and distances == sorted(distances) and distances[1] < distances[3] / 3
    twice = cells((8, 2), (8, 2))
    assert apart(here, twice) == pytest.approx(0) and objects(twice).tolist() == [2.0]
    assert scales(torch.zeros(1, 5, 7)).abs().sum() == 0


@pytest.mark.parametrize("shape", [(5, 7), (1, 1), (18, 3)])
def test_every_scale_holds_all_objects(shape):
    maps = torch.rand(3, *shape)
    found, level = scales(maps), [np.prod(shape)]
    while max(shape) > 1:
        shape = tuple(-(-side // 2) for side in shape)
        level.append(np.prod(shape))
    for weight, part in zip((2.0**i for i in range(len(level))), found.split([int(n) for n in level], 1), strict=True):
        torch.testing.assert_close(part.sum(1), torch.full((3,), weight))
