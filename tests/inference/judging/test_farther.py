"""Which of two samples is farther from the real one, against the energy distance."""

import numpy as np
import pytest

from probscene.inference.judging.farther import farther
from probscene.inference.judging.two_sample import energy_distance


def test_distances_are_energy_distances():
    rng = np.random.default_rng(0)
    one, other, real = rng.normal(1, 1, (80, 3)), rng.normal(0, 2, (60, 3)), rng.normal(0, 1, (90, 3))
    found = farther(one, other, real)
    assert found.one == pytest.approx(energy_distance(one, real)) and found.other == pytest.approx(
        energy_distance(other, real)
    )


@pytest.mark.parametrize(("shift", "sure"), [(2.0, True), (0.0, False), (-0.5, False)])
def test_only_what_is_farther_beyond_chance_is_sure(shift, sure):
    rng = np.random.default_rng(1)
    real = rng.normal(0, 1, (200, 2))
    other = rng.normal(0.5, 1, (200, 2))
    assert farther(rng.normal(0.5 + shift, 1, (200, 2)), other, real).sure == sure


def test_whole_images_are_resampled():
    """Rows that are copies of one another say no more than one."""
    rng = np.random.default_rng(3)
    one, other, real = rng.normal(0.4, 1, (40, 1)), rng.normal(0, 1, (40, 1)), rng.normal(0, 1, (40, 1))
    copies, image = [np.repeat(x, 20, 0) for x in (one, other, real)], np.repeat(np.arange(40), 20)
    single, together = farther(one, other, real), farther(*copies, images=(image,) * 3)
    assert together.one == pytest.approx(single.one) and abs(together.share - single.share) < 0.1
    assert farther(*copies).share > together.share
