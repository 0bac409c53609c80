"""Which of two samples is farther from the real one, against the energy distance."""

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from probscene.inference.statistics.energy import RESAMPLES, bootstrap_test, energy_distance


def test_distances_are_energy_distances():
    rng = np.random.default_rng(0)
    one, other, real = rng.normal(1, 1, (80, 3)), rng.normal(0, 2, (60, 3)), rng.normal(0, 1, (90, 3))
    found = bootstrap_test(one, other, real)
    assert found.distance == pytest.approx(energy_distance(one, real)) and found.baseline_distance == pytest.approx(
        energy_distance(other, real)
    )


@pytest.mark.parametrize(("shift", "sure"), [(2.0, True), (0.0, False), (-0.5, False)])
def test_only_what_is_farther_beyond_chance_is_sure(shift, sure):
    rng = np.random.default_rng(1)
    real = rng.normal(0, 1, (200, 2))
    other = rng.normal(0.5, 1, (200, 2))
    assert bootstrap_test(rng.normal(0.5 + shift, 1, (200, 2)), other, real).significant == sure


def test_whole_images_are_resampled():
    """Rows that are copies of one another say no more than one."""
    rng = np.random.default_rng(3)
    one, other, real = rng.normal(0.4, 1, (40, 1)), rng.normal(0, 1, (40, 1)), rng.normal(0, 1, (40, 1))
    copies, image = [np.repeat(x, 20, 0) for x in (one, other, real)], np.repeat(np.arange(40), 20)
    single, together = bootstrap_test(one, other, real), bootstrap_test(*copies, images=(image,) * 3)
    assert together.distance == pytest.approx(single.distance) and abs(together.probability - single.probability) < 0.1
    assert bootstrap_test(*copies).probability > together.probability


def test_a_share_is_that_of_resamples_row_by_row():
    """Against a twin that looks at one resample after the other; images have any number of rows, in any order."""
    rng = np.random.default_rng(4)
    images = tuple(rng.integers(0, number, rows) for number, rows in ((20, 60), (12, 30), (15, 90)))
    of = [np.unique(image, return_inverse=True)[1] for image in images]
    one, other, real = (rng.normal(mean, 1, (len(of[i]), 2)) for i, mean in enumerate((0.35, 0.3, 0.0)))

    def squared(x, y, a, b):
        a, b = a / a.sum(), b / b.sum()
        return 2 * a @ cdist(x, y) @ b - a @ cdist(x, x) @ a - b @ cdist(y, y) @ b

    draws, larger = np.random.default_rng(0), 0
    times = [draws.multinomial(n, np.full(n, 1 / n), RESAMPLES) for n in (image.max() + 1 for image in of)]
    for i in range(RESAMPLES):
        a, b, c = (each[i][image] for each, image in zip(times, of, strict=True))
        larger += squared(one, real, a, c) > squared(other, real, b, c)
    found = bootstrap_test(one, other, real, images=images)
    assert 0.1 < found.probability < 0.9 and found.probability == pytest.approx(larger / RESAMPLES, abs=1e-9)
