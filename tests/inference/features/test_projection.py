"""The projection against scikit-learn's discriminant and SciPy's generalised eigenvalues, and its laws."""

import numpy as np
import pytest
import scipy.linalg
import torch
from hypothesis import given
from hypothesis import strategies as st
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis

from probscene.errors import ProbsceneError, RunError
from probscene.inference.divergence import SELF_SHARE, KDELogRatio, bandwidth, self_share
from probscene.inference.features.projection import Projected, discriminant


def pairs(number, dimensions=12, structures=3, noise=0.3, seed=0):
    """Features of two renders of each structure, and the structures: ``structures`` directions carry them, and all
    others twenty times as much of the parameters' noise."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=generator)

    shared = normal(number, structures)
    mix, _ = torch.linalg.qr(normal(dimensions, dimensions))
    sides = []
    for _ in range(2):
        rest = 20 * noise * normal(number, dimensions - structures)
        sides.append(torch.cat([shared + noise * normal(number, structures), rest], 1) @ mix.T + 5)
    return *sides, shared


def unexplained(features, shared):
    """The share of each structure's variance that no linear map of the features gives."""
    return np.linalg.lstsq(features.numpy(), shared.numpy(), rcond=None)[1] / shared.square().sum(0).numpy()


def test_directions_are_those_of_scikit_learns_discriminant():
    one, other, _ = pairs(400)
    found = discriminant(one, other, 3, 100)
    reference = LinearDiscriminantAnalysis(solver="eigen", n_components=3)
    reference.fit(np.concatenate([one, other]), np.tile(np.arange(400), 2))
    assert np.rad2deg(scipy.linalg.subspace_angles(found.weight.numpy(), reference.scalings_[:, :3])).max() < 1


def test_ratios_are_generalised_eigenvalues():
    one, other, _ = pairs(300)
    both = torch.cat([one, other])
    within, total = np.cov((one - other).T.numpy(), bias=True) / 2, np.cov(both.T.numpy(), bias=True)
    expected = scipy.linalg.eigh(total, within, eigvals_only=True)[::-1][:5]
    assert np.allclose(discriminant(one, other, 5, 100).ratio, expected, rtol=0.03)


def test_structure_is_kept_and_what_varies_most_is_not():
    """The first principal components hold nothing of it."""
    one, other, shared = pairs(500)
    fresh, _, unseen = pairs(500)
    found = discriminant(one[:250], other[:250], 3, 100)(fresh[250:])
    assert (unexplained(found, unseen[250:]) < 0.15).all()
    principal = torch.linalg.svd(one - one.mean(0), full_matrices=False)[2][:3].T
    assert (unexplained(one @ principal, shared) > 0.9).all()


@given(st.integers(0, 2**31), st.floats(0.01, 100), st.floats(-50, 50))
def test_turning_scaling_and_shifting_the_features_changes_nothing(seed, scale, shift):
    one, other, _ = pairs(60, 6)
    turn, _ = torch.linalg.qr(torch.randn(6, 6, generator=torch.Generator().manual_seed(seed)))

    def moved(features):
        return scale * features @ turn + shift

    plain, again = discriminant(one, other, 3, 60), discriminant(moved(one), moved(other), 3, 60)
    assert torch.allclose(again.ratio, plain.ratio, rtol=1e-3)
    assert torch.allclose(again(moved(one)).abs(), plain(one).abs(), atol=2e-2)


@given(st.integers(25, 200), st.integers(1, 10), st.floats(0.01, 100), st.integers(0, 2**31))
def test_the_bandwidth_gives_each_scene_its_share(N, d, scale, seed):
    points = torch.randn(N, d, generator=torch.Generator().manual_seed(seed))
    width = bandwidth(points)
    assert self_share(points / width) == pytest.approx(SELF_SHARE, rel=1e-2)
    assert bandwidth(scale * points) == pytest.approx(scale * width, rel=1e-2)
    kernels = np.exp(-0.5 * np.square(points.numpy()[:, None] / width - points.numpy() / width).sum(-1))
    assert (np.diag(kernels) / kernels.sum(1)).mean() == pytest.approx(SELF_SHARE, rel=1e-2)


def test_the_log_ratio_of_projected_features_is_alive():
    """Under H = d I on the raw ones it is not, and under a kernel of the noise's size scenes are alone."""
    one, other, _ = pairs(400)
    found = discriminant(one, other, 3, 150)
    assert torch.allclose(found(torch.cat([one, other])).mean(0), torch.zeros(3), atol=1e-3)
    generated, real = one[:150], other[150:] + 0.6 * (found.weight / found.weight.norm(dim=0)).sum(1)
    assert self_share(found(generated)) < 2 * SELF_SHARE
    assert KDELogRatio(1.0, None)(found(generated), found(real)).std() > 0.3


def test_few_pairs_have_a_bandwidth_too():
    one, other, _ = pairs(10, 4, 1)
    assert torch.isfinite(discriminant(one, other, 2, 10)(one)).all()


@pytest.mark.parametrize(
    ("spoil", "part"),
    [(lambda x: x * 0 + 1, "vary"), (lambda x: x.index_fill(0, torch.tensor([3]), torch.nan), "finite"),
     (lambda x: x[:3], "more pairs"), (lambda x: x[:, :1].expand(-1, 12), "at least 3 directions")],
    ids=["constant", "nan", "few", "one direction"],
)  # fmt: skip
def test_what_cannot_be_projected_is_refused(spoil, part):
    one, other, _ = pairs(40)
    with pytest.raises(ProbsceneError, match=rf"^expected .*{part}"):
        discriminant(spoil(one), spoil(other), 3, 40)


class Means:
    """A network whose features are the mean colours."""

    names = ("red", "green", "blue")

    def embed(self, images):
        return images.float().mean((2, 3))


def test_without_directions_features_are_the_networks_own():
    images = torch.randint(0, 256, (3, 3, 8, 8), dtype=torch.uint8)
    net = Projected(Means(), 0)
    assert net.names == tuple(Means.names) and torch.equal(net.embed(images), Means().embed(images))


def test_a_projected_network_keeps_its_projection_alone():
    images = torch.randint(0, 256, (60, 3, 8, 8), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    net = Projected(Means(), 2, b"a" * 32)
    net.projection = discriminant(net.pretrained.embed(images[:30]), net.pretrained.embed(images[30:]), 2, 30)
    assert torch.equal(net.embed(images), net.projection(Means().embed(images)))
    assert net.embed(images).shape == (60, len(net.names)) and net.embed(images[:0]).shape == (0, 2)
    again = Projected(Means(), 2, b"a" * 32)
    again.load_state_dict(net.state_dict())
    assert torch.equal(again.embed(images), net.embed(images))
    assert set(net.state_dict()) == {"mean", "weight", "ratio", "origin"}
    with pytest.raises(RunError, match="weights of the feature network"):
        Projected(Means(), 2, b"b" * 32).load_state_dict(net.state_dict())
