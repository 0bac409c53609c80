"""Nearest neighbours by brute force and by scikit-learn; empty balls as often as theory says."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from sklearn.neighbors import NearestNeighbors

from probscene.inference.statistics.domain_shift import (
    coverage,
    distance_outliers,
    fidelity,
    knn_radii,
    patch_outliers,
    support_outliers,
    uncovered_floor,
)

SETS = st.tuples(st.integers(8, 25), st.integers(8, 25)).flatmap(
    lambda s: st.tuples(*(arrays(np.float64, (n, 2), elements=st.integers(-9, 9).map(float)) for n in s))
)


def reach(points, k):
    """Distance to the k-th other point."""
    return NearestNeighbors(n_neighbors=k + 1, algorithm="brute").fit(points).kneighbors(points)[0][:, k]


@given(SETS, st.integers(1, 6))
def test_balls_and_likes_are_scikit_learns(sets, k):
    a, b = sets
    assert knn_radii(a, k) == pytest.approx(reach(a, k), abs=1e-6)
    assert (knn_radii(a, k, 3.0) >= 3).all()
    grown = max(k, round(k * len(a) / len(b)))
    radius = reach(a, min(grown, len(a) - 1))
    nearest = NearestNeighbors(n_neighbors=1, algorithm="brute").fit(b).kneighbors(a)[0][:, 0]
    sure = ~np.isclose(nearest, radius)
    found = coverage(a, b, k)
    assert np.array_equal(found.covered[sure], (nearest <= radius)[sure])
    assert found.nearest == pytest.approx(nearest, abs=1e-6)


@given(SETS, st.integers(1, 6))
def test_precision_recall_density_and_coverage_by_definition(sets, k):
    generated, real = (each + np.random.default_rng(s).normal(size=each.shape) / 100 for s, each in enumerate(sets))
    ball, theirs = reach(real, k), reach(generated, k)
    near = np.linalg.norm(real[:, None] - generated, axis=-1)
    L, N = near.shape
    found = fidelity(generated, real, k)
    assert found.precision == pytest.approx(np.mean([any(near[i, j] <= ball[i] for i in range(L)) for j in range(N)]))
    assert found.recall == pytest.approx(np.mean([any(near[i, j] <= theirs[j] for j in range(N)) for i in range(L)]))
    assert found.density == pytest.approx(sum(near[i, j] <= ball[i] for i in range(L) for j in range(N)) / (k * N))
    assert found.coverage == pytest.approx(np.mean([any(near[i, j] <= ball[i] for j in range(N)) for i in range(L)]))


@given(SETS, st.integers(1, 6))
def test_images_outside_by_definition(sets, k):
    images, others = (each + np.random.default_rng(s).normal(size=each.shape) / 100 for s, each in enumerate(sets))
    ball = reach(others, k)
    within = np.linalg.norm(images[:, None] - others, axis=-1) <= np.minimum(ball, np.median(ball))
    assert np.array_equal(support_outliers(images, others, k), [not any(row) for row in within])
    assert not support_outliers(others, others, k).any()


def test_an_outlier_holds_nothing_that_is_far():
    rng = np.random.default_rng(0)
    images, others = rng.normal([6, 0], 0.1, (20, 2)), rng.normal(size=(100, 2))
    others[0] = [12, 0]  # its ball of three neighbours holds the images, as they lie between it and the rest
    assert support_outliers(images, others, 3).all() and fidelity(images, others, 3).precision == 1


@pytest.mark.parametrize("density", [1.0, 0.3, 0.1])
def test_balls_are_empty_as_often_as_theory_says(density):
    k, empty = 5, []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        real, others = rng.random((1000, 2)), rng.random((1000, 2))
        others[rng.random(1000) > density] += 10  # only a share of them is where the real ones are
        empty.append(1 - coverage(real, others, k).covered.mean())
    assert abs(np.mean(empty) - (1 + density) ** -k) < 5 * np.std(empty, ddof=1) / len(empty) ** 0.5


def test_a_gap_is_found_and_nothing_else():
    rng = np.random.default_rng(0)
    real, generated = rng.normal(size=(500, 3)), rng.normal(size=(500, 3))
    real[:100] += [12, 0, 0]
    found = coverage(real, generated)
    assert not found.covered[:100].any() and found.covered[100:].mean() > 0.97
    assert set(np.argsort(-found.nearest)[:50]) <= set(range(100))
    assert uncovered_floor(real) < 0.05


def test_images_closer_than_the_resolution_are_alike():
    cells = np.random.default_rng(0).integers(0, 3, (300, 2)).astype(float)
    shifted = cells + 0.1
    assert not coverage(cells, shifted).covered.any()  # duplicates: balls of no size
    assert coverage(cells, shifted, resolution=0.5).covered.all()
    assert coverage(cells, cells).covered.all() and coverage(cells, cells).nearest.max() == 0


def test_images_of_another_domain_are_farther_than_scenes_are_apart():
    rng = np.random.default_rng(0)
    scenes, real = rng.normal(size=(100, 8)), rng.normal(size=(80, 8))
    assert not distance_outliers(real + 0.5, scenes).any()
    assert distance_outliers(real + 10, scenes).all()
    assert np.array_equal(distance_outliers(7 * real, 7 * scenes), distance_outliers(real, scenes))


def patches(seed, images, kinds, number=6, width=20):
    """Images that show a few objects of some kinds, whose features are unit vectors, on a ground of zeros."""
    rng = np.random.default_rng(seed)
    shown = (
        np.eye(width)[rng.choice(kinds, (images, number))]
        * (np.arange(number) < rng.integers(0, 7, (images, 1)))[..., None]
    )
    return np.concatenate([np.zeros((images, 1, width)), shown + 0.02 * rng.normal(size=shown.shape)], 1)


def test_what_no_scene_shows_is_strange_however_much_there_is_of_it():
    scenes = patches(0, 200, range(8))
    for kinds in (range(8), [3], [1, 7]):  # other numbers of them are no other domain
        assert patch_outliers(patches(1, 200, kinds), scenes).mean() < 0.2
    empty = patches(2, 200, range(8, 20))
    shows = (empty[:, 1:] > 0.5).any((1, 2))
    found = patch_outliers(empty, scenes)
    assert found[shows].all() and found[~shows].mean() < 0.2  # nor are images that show nothing
    turned = empty[:, [0, *range(6, 0, -1)]]
    assert np.array_equal(patch_outliers(turned, scenes), found) and np.array_equal(
        patch_outliers(3 * empty, 3 * scenes), found
    )
