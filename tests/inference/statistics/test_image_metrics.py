"""FID against scipy's matrix root and known Gaussians, KID against a plain double loop, intervals against samples."""

import numpy as np
import pytest
import scipy.linalg
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from probscene.errors import ProbsceneError
from probscene.inference.statistics.image_metrics import fid, frechet, kid


def points(number: int, dimensions: int, seed: int, shift: float = 0.0, scale: float = 1.0) -> torch.Tensor:
    rng = np.random.default_rng(seed)
    mix = np.random.default_rng(dimensions).normal(size=(dimensions, dimensions))
    return torch.tensor(shift + scale * rng.normal(size=(number, dimensions)) @ mix)


def by_scipy(x: np.ndarray, y: np.ndarray) -> float:
    a, b = np.atleast_2d(np.cov(x.T)), np.atleast_2d(np.cov(y.T))
    root = scipy.linalg.sqrtm(a @ b)
    return ((x.mean(0) - y.mean(0)) ** 2).sum() + np.trace(a + b - 2 * np.real(root))


def by_loop(x: np.ndarray, y: np.ndarray) -> float:
    """The unbiased MMD^2 of the cubic kernel, pair by pair."""

    def kernel(a, b):
        return (sum(a * b) / len(a) + 1) ** 3

    def mean(pairs):
        values = [kernel(a, b) for a, b in pairs]
        return sum(values) / len(values)

    inside = [mean((p, q) for i, p in enumerate(s) for j, q in enumerate(s) if i != j) for s in (x, y)]
    return sum(inside) - 2 * mean((p, q) for p in x for q in y)


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 6), st.integers(0, 99), st.floats(-2, 2), st.floats(0.3, 3))
def test_fid_agrees_with_scipys_matrix_root(dimensions, seed, shift, scale):
    x, y = points(40, dimensions, seed), points(30, dimensions, seed + 100, shift, scale)
    expected = by_scipy(x.numpy(), y.numpy())
    found = fid(x, y, "net", size=3)
    assert found.value == pytest.approx(expected, rel=1e-6, abs=1e-6)
    assert frechet(x, y, torch.ones(40).double(), torch.ones(30).double()).item() == pytest.approx(
        found.value, abs=1e-6
    )
    assert (
        found[:2] == ("FID", "net")
        and (found.images, found.generated) == (40, 30)
        and found.min_images == dimensions + 1
    )


def test_fid_of_fewer_images_than_dimensions_is_the_same_either_way():
    x, y = points(20, 50, 0), points(25, 50, 1, 0.5)
    found = fid(x, y, "net", size=3)
    assert (found.images, found.min_images) == (20, 51)
    ones = (torch.ones(20).double(), torch.ones(25).double())
    assert found.value == pytest.approx(frechet(x, y, *ones).item(), rel=1e-5)


def test_weights_are_repetitions():
    x, y = points(12, 4, 0), points(9, 4, 1)
    a, b = torch.tensor([3, 1, 2] * 4), torch.tensor([1, 2, 1] * 3)
    expected = by_scipy(x.repeat_interleave(a, 0).numpy(), y.repeat_interleave(b, 0).numpy())
    assert frechet(x, y, a.double(), b.double()).item() == pytest.approx(expected)


def test_fid_of_known_gaussians():
    rng = torch.Generator().manual_seed(0)
    x = torch.randn(200_000, 2, generator=rng) * torch.tensor([1.0, 2.0])
    y = torch.randn(200_000, 2, generator=rng) * torch.tensor([3.0, 2.0]) + torch.tensor([0.0, 1.0])
    assert fid(x, y, "net", size=2).value == pytest.approx(1 + (3 - 1) ** 2, rel=0.02)


@settings(max_examples=15, deadline=None)
@given(st.integers(2, 12), st.integers(1, 5), st.integers(0, 99), st.floats(-1, 1))
def test_kid_agrees_with_a_double_loop(number, dimensions, seed, shift):
    x, y = points(number, dimensions, seed), points(number, dimensions, seed + 100, shift)
    found = kid(x, y, "net", size=3)
    assert found.value == pytest.approx(by_loop(x.numpy(), y.numpy()), rel=1e-6, abs=1e-6)
    assert (found.images, found.min_images) == (number, 1000)


def test_kid_over_subsets_estimates_the_same():
    x, y = points(300, 3, 0), points(200, 3, 1, 0.5)
    whole, parts = by_loop(x.numpy(), y.numpy()), kid(x, y, "net", subset=100)
    assert parts.min_images == 100 and parts.low < whole < parts.high
    state = torch.get_rng_state()
    assert kid(x, y, "net", subset=100) == parts and torch.equal(torch.get_rng_state(), state)


def test_the_same_images_are_at_no_distance():
    x = points(60, 8, 0)
    same = fid(x, x, "net")
    assert same.value == pytest.approx(0, abs=1e-5) and same.low == pytest.approx(0, abs=1e-5)
    near, far = kid(x, x, "net"), kid(x, x + 3, "net")
    assert abs(near.value) < 0.05 * far.value and far.low > near.high
    constant = torch.ones(5, 3)
    assert fid(constant, constant, "net").value == pytest.approx(0, abs=1e-9)
    assert kid(constant, constant, "net").value == pytest.approx(0, abs=1e-9)


def test_intervals_are_as_wide_as_fresh_samples_differ():
    for distance in (fid, kid):
        fresh = [distance(points(150, 2, i), points(150, 2, 1000 + i, 1.0), "net", size=1).value for i in range(150)]
        found = [distance(points(150, 2, i), points(150, 2, 1000 + i, 1.0), "net", size=150) for i in range(8)]
        width = np.mean([x.high - x.low for x in found])
        assert width == pytest.approx(np.ptp(np.quantile(fresh, [0.025, 0.975])), rel=0.35)


@pytest.mark.parametrize("distance", [fid, kid])
def test_what_cannot_be_compared_is_refused(distance):
    x = points(5, 3, 0)
    for other in (x[:1], x[:, :2], x[0], x[:0]):
        with pytest.raises(ProbsceneError, match="at least 2 real and 2 generated"):
            distance(x, other, "net")
    for value in (torch.nan, torch.inf):
        with pytest.raises(ProbsceneError, match="finite"):
            distance(x, x.clone().fill_(value), "net")
