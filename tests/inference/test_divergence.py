import math
from functools import partial

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import gaussian_kde as scipy_kde

from probscene.errors import ProbsceneError
from probscene.inference import divergence as module
from probscene.inference.divergence import MMD, Blockwise, JensenShannon, KDELogRatio, anscombe_transform, gaussian_kde
from probscene.inference.guides.lstm import LSTMGuide


@given(st.integers(1, 4), st.integers(6, 60), st.integers(2, 20), st.floats(0.05, 5.0), st.integers(0, 2**31))
def test_kde_is_scipys(D, L, N, variance, seed):
    rng = np.random.default_rng(seed)
    data, points = rng.normal(50, 3, (L, D)), rng.normal(50, 3, (N, D))
    reference = scipy_kde(data.T)
    reference.covariance = np.eye(D) * variance  # scipy only scales the data's covariance; give it ours
    reference.cho_cov = np.linalg.cholesky(reference.covariance)
    reference.log_det = 2 * np.log(np.diag(reference.cho_cov * np.sqrt(2 * np.pi))).sum()
    ours = gaussian_kde(torch.tensor(points), torch.tensor(data), variance)
    assert np.allclose(ours.numpy(), reference.logpdf(points.T), rtol=1e-6, atol=1e-6)


def test_leave_one_out_leaves_out_one():
    data = torch.randn(30, 3, dtype=torch.float64)
    ours = gaussian_kde(data, data, 0.7, leave_one_out=True)
    for i in range(30):
        others = torch.cat([data[:i], data[i + 1 :]])
        assert torch.allclose(ours[i], gaussian_kde(data[i : i + 1], others, 0.7)[0])


def test_kde_keeps_its_precision_far_from_the_origin():
    data = torch.randn(200, 2)
    near = gaussian_kde(data, data, 0.5)
    assert torch.allclose(gaussian_kde(data + 1000, data + 1000, 0.5), near, atol=1e-2)


def test_paper_form_is_the_formula():
    generated, real = torch.randn(20, 5), torch.randn(30, 5)

    def density(x, data):
        normal = torch.distributions.MultivariateNormal(torch.zeros(5), 5.0 * torch.eye(5))  # H = d I
        return normal.log_prob(x - data).exp().mean()

    expected = torch.stack([(density(x, generated) / density(x, real)).log() for x in generated])
    ours = KDELogRatio(variance=None, marginal_variance=None, leave_one_out=False)(generated, real)
    assert torch.allclose(ours, expected, atol=1e-4)


def test_marginals_add_the_log_ratio_of_each_feature():
    generated, real = torch.randn(20, 3), torch.randn(30, 3)
    joint = KDELogRatio(1.0, None)(generated, real)
    single = sum(KDELogRatio(0.2, None)(generated[:, d : d + 1], real[:, d : d + 1]) for d in range(3))
    assert torch.allclose(KDELogRatio(1.0, 0.2)(generated, real), joint + single, atol=1e-5)


@given(
    st.integers(1, 5), st.integers(2, 30), st.integers(1, 40), st.booleans(), st.sampled_from([0.0, 300.0]),
    st.sampled_from([3, 40, 10**6]), st.integers(0, 2**31),
)  # fmt: skip
def test_the_ratio_is_that_of_plain_sums_in_blocks_of_any_size(D, N, L, leave_one_out, away, block, seed):
    """Also of features far from the origin and of a generated batch far from the real one."""
    generator = torch.Generator().manual_seed(seed)
    generated, real = torch.randn(N, D, generator=generator) + away, torch.randn(L, D, generator=generator)
    generated[::7] += 60.0  # some so far away that a kernel there is no float

    def log_density(data, variance, leave_one_out):
        x, y = generated.double(), data.double()
        log_kernel = -0.5 / variance * (x.unsqueeze(1) - y).square().sum(-1)
        if leave_one_out:
            log_kernel.fill_diagonal_(-torch.inf)
        return log_kernel.logsumexp(1) - np.log(len(data) - leave_one_out)

    expected = log_density(generated, 0.7, leave_one_out) - log_density(real, 0.7, False)
    before, module.BLOCK_SIZE = module.BLOCK_SIZE, block
    try:
        found = KDELogRatio(0.7, None, leave_one_out)(generated, real)
        bounded = JensenShannon(0.7, None, leave_one_out)(generated.double(), real.double())
    finally:
        module.BLOCK_SIZE = before
    torch.testing.assert_close(found.double(), expected, rtol=1e-5, atol=3e-5 * (1 + 60 + away) ** 2)
    # log q / ((p + q) / 2), of densities and not of their logarithms' ratio
    middle = torch.logaddexp(expected, torch.zeros_like(expected)) - np.log(2)
    torch.testing.assert_close(bounded, expected - middle, rtol=1e-6, atol=1e-6)
    assert (bounded <= np.log(2) + 1e-9).all()


@given(st.integers(1, 3), st.integers(2, 30), st.integers(1, 90), st.booleans(), st.integers(0, 2**31))
def test_equal_sizes_are_parts_of_the_larger_sample(D, N, L, leave_one_out, seed):
    generator = torch.Generator().manual_seed(seed)
    generated, real = (torch.randn(size, D, generator=generator, dtype=torch.float64) for size in (N, L))

    def mean_log_density(data, parts, i, left_out):
        found = []
        for k in range(parts):
            some = [data[j] for j in range(k, len(data), parts) if j != left_out]
            found.append(gaussian_kde(generated[i : i + 1], torch.stack(some), 0.7)[0])
        return sum(found) / parts

    of_real, of_generated, expected = max(1, round(L / N)), max(1, min(N // 2, round(N / L))), []
    for i in range(N):
        own = mean_log_density(generated, of_generated, i, i if leave_one_out else -1)
        expected.append(own - mean_log_density(real, of_real, i, -1))
    ours = KDELogRatio(0.7, None, leave_one_out, equal_sizes=True)(generated, real)
    assert torch.allclose(ours, torch.stack(expected), atol=1e-6)


@given(st.floats(4, 200), st.integers(0, 2**31))
def test_anscombe_gives_counts_of_any_mean_a_variance_of_one(mean, seed):
    counts = torch.from_numpy(np.random.default_rng(seed).poisson(mean, 20000)).double()
    assert 0.9 < anscombe_transform(counts).var() < 1.1


@given(st.lists(st.floats(-50, 500), min_size=2, max_size=40))
def test_anscombe_keeps_the_order_and_is_odd(values):
    x = torch.tensor(values, dtype=torch.float64).sort().values
    assert (anscombe_transform(x).diff() >= 0).all()
    assert torch.equal(anscombe_transform(-x), -anscombe_transform(x))
    assert torch.allclose(anscombe_transform(x.abs()), 2 * (x.abs() + 3 / 8).sqrt() - 2 * (3 / 8) ** 0.5)


@pytest.mark.parametrize("kind", [KDELogRatio, JensenShannon, partial(MMD, shared=False)])
def test_stabilised_costs_are_those_of_transformed_counts(kind):
    generated, real = torch.rand(20, 3) * 30, torch.rand(50, 3) * 30
    plain, stabilised = kind(0.8), kind(0.8, anscombe=True)
    assert torch.equal(stabilised(generated, real), plain(anscombe_transform(generated), anscombe_transform(real)))
    assert not torch.allclose(stabilised(generated, real), plain(generated, real))


@pytest.mark.parametrize(("N", "L"), [(40, 400), (400, 40)])
def test_equal_sizes_take_away_the_bias_of_thin_tails(N, L):
    """Of two samples of one distribution: the mean log ratio where it has a twentieth of its mass."""
    torch.manual_seed(0)

    def bias(ratio):
        found = []
        for _ in range(200):
            generated, real = torch.rand(N, 1).log().neg(), torch.rand(L, 1).log().neg()
            found.append(ratio(generated, real)[(generated > 3)[:, 0]].sum() / N)
        return float(torch.stack(found).mean()), float(torch.stack(found).std()) / 200**0.5

    (plain, _), (equal, error) = (bias(KDELogRatio(0.1, None, equal_sizes=equal)) for equal in (False, True))
    assert abs(equal) < 4 * error < abs(plain) / 2


@pytest.mark.parametrize("ratio", [KDELogRatio, JensenShannon])
def test_a_cost_carries_no_gradient(ratio):
    generated = torch.randn(6, 3, requires_grad=True)
    assert not ratio()(generated, torch.randn(5, 3)).requires_grad


@pytest.mark.parametrize("divergence", [KDELogRatio(), MMD(shared=False)])
def test_equal_samples_cost_nothing_on_average(divergence):
    """With as many real as generated scenes and the self term left out, no side is favoured (exchangeability)."""
    costs = torch.stack([divergence(torch.randn(100, 2), torch.randn(99, 2)).mean() for _ in range(60)])
    assert costs.mean().abs() < 4 * costs.std() / 60**0.5


def test_shared_mmd_is_the_unbiased_estimate():
    generated, real = torch.randn(15, 2), torch.randn(12, 2) + 1

    def kernel(a, b):
        return torch.exp(-0.5 / 0.8 * (a - b).square().sum())

    def mean(pairs):
        return torch.stack([kernel(a, b) for a, b in pairs]).mean()

    G, R = list(generated), list(real)
    expected = mean([(a, b) for i, a in enumerate(G) for j, b in enumerate(G) if i != j])
    expected = expected + mean([(a, b) for i, a in enumerate(R) for j, b in enumerate(R) if i != j])
    expected = expected - 2 * mean([(a, b) for a in G for b in R])
    cost = MMD(0.8)(generated, real)
    assert cost.shape == (15,)
    assert torch.allclose(cost, expected.expand(15), atol=1e-5)


def test_the_witness_is_the_gradient_of_mmd(small):
    """sum_T q(T) witness(T) grad log q(T) = grad MMD^2, exactly, on an enumerable grammar."""
    guide = LSTMGuide(small.grammar, 4, hidden=8)
    log_q = guide.log_prob(small.derivations)
    squared = (small.features.unsqueeze(1) - small.features).square().sum(-1)
    kernel = torch.exp(-0.5 * squared)
    difference = log_q.exp() - small.target
    exact = torch.autograd.grad(difference @ kernel @ difference, guide.parameters(), retain_graph=True)
    witness = (2 * kernel @ difference).detach()
    score = torch.autograd.grad((log_q.exp().detach() * witness * log_q).sum(), guide.parameters())
    for a, b in zip(exact, score, strict=True):
        assert torch.allclose(a, b, atol=1e-6)


def test_the_bounded_cost_is_the_gradient_of_jensen_shannon(small):
    """sum_T q(T) cost(T) grad log q(T) = 2 grad JS(p, q), exactly, on an enumerable grammar."""
    guide = LSTMGuide(small.grammar, 4, hidden=8)
    log_q = guide.log_prob(small.derivations)
    q, p = log_q.exp(), small.target
    log_m = ((p + q) / 2).log()
    divergence = ((q * (log_q - log_m)).sum() + (p * (p.log() - log_m)).sum()) / 2
    exact = torch.autograd.grad(divergence, guide.parameters(), retain_graph=True)
    cost = JensenShannon().cost_of_log_ratio(log_q - p.log()).detach()
    score = torch.autograd.grad((q.detach() * cost * log_q).sum(), guide.parameters())
    for a, b in zip(exact, score, strict=True):
        assert torch.allclose(2 * a, b, atol=1e-6)


@pytest.mark.parametrize(
    ("generated", "real", "says"),
    [
        (torch.zeros(5, 2), torch.zeros(5, 3), "expected generated"),
        (torch.zeros(1, 2), torch.zeros(5, 2), "at least 2 generated"),
        (torch.zeros(5, 2), torch.zeros(0, 2), "at least 2 generated"),
        (torch.full((5, 2), torch.nan), torch.zeros(5, 2), "finite"),
    ],
)
def test_bad_features_are_named(generated, real, says):
    for divergence in (KDELogRatio(), JensenShannon(), MMD()):
        with pytest.raises(ProbsceneError, match=says):
            divergence(generated, real)


def test_blocks_have_densities_of_their_own():
    """A block in which the two sides have nothing in common leaves the other's costs as they are, up to a constant."""
    one, real = torch.randn(40, 2), torch.randn(30, 2)
    other, far = torch.randn(40, 3), torch.randn(30, 3) + 100
    both = torch.cat([one, other], 1), torch.cat([real, far], 1)
    each = JensenShannon(0.5, 0.1), JensenShannon(0.5, None)
    found = Blockwise((2, 3), each)(*both)
    assert torch.allclose(found, each[0](one, real) + math.log(2), atol=1e-5)
    assert torch.allclose(Blockwise((2, 3), (each[0], None))(*both), each[0](one, real))
    joint = each[1](*both)
    assert joint.std() < 1e-5 < found.std()
    with pytest.raises(ProbsceneError, match="expected generated"):
        Blockwise((2, 3), each)(one, torch.cat([real, far], 1))
