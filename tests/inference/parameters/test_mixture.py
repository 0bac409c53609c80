"""Distributions on 0..1 that begin as the uniform one."""

import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st

from probscene.inference.parameters.mixture import LogisticMixture

seeds = st.integers(0, 2**31)


def mixture(seed, spread=1.5):
    return LogisticMixture.from_raw(spread * torch.randn(7, 12, generator=torch.Generator().manual_seed(seed)).double())


@given(st.floats(0, 1))
@example(0.5)  # where bisection starts
def test_zeros_are_the_uniform_distribution(u):
    zeros = LogisticMixture.from_raw(torch.zeros(1, 12))
    assert float(zeros.log_prob(torch.tensor([u]))) == pytest.approx(0, abs=1e-5)
    assert float(zeros.icdf(torch.tensor([u]))) == pytest.approx(u, abs=2e-6)


@given(seeds)
def test_densities_integrate_to_one(seed):
    found = mixture(seed)
    logits = torch.linspace(-40, 40, 80_001).double()  # du = u (1 - u) dlogit
    u = logits.sigmoid()
    inside = (u > 1e-6) & (u < 1 - 1e-6)
    density = found._replace(**{k: v[:, None] for k, v in found._asdict().items()}).log_prob(u.expand(7, -1)).exp()
    mass = torch.where(inside, density * u * (1 - u), 0.0).sum(1) * (logits[1] - logits[0])
    beyond = found.cdf(torch.tensor(1e-6).double().logit().expand(7)) + 1
    beyond = beyond - found.cdf(torch.tensor(1 - 1e-6).double().logit().expand(7))
    assert torch.allclose(mass + beyond, torch.ones(7).double(), atol=2e-3)


@given(seeds)
def test_quantiles_invert_the_distribution_function(seed):
    found = mixture(seed)
    v = torch.rand(7, generator=torch.Generator().manual_seed(seed)).double()
    u = found.icdf(v)
    inside = (u > 2e-6) & (u < 1 - 2e-6)
    assert torch.allclose(found.cdf(u.logit())[inside], v[inside], atol=1e-6)


def test_the_gradient_of_a_quantile_is_that_of_finite_differences():
    raw = torch.randn(5, 12, generator=torch.Generator().manual_seed(0)).double().requires_grad_()
    v = torch.rand(5, generator=torch.Generator().manual_seed(1)).double()
    assert torch.autograd.gradcheck(lambda x: LogisticMixture.from_raw(x).icdf(v), raw, eps=1e-5, atol=1e-4)
