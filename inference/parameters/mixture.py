"""Distributions on 0..1 that begin as the uniform one: mixtures of logistic distributions on the logit scale.

A logistic distribution of location 0 and scale 1 is the logit of a uniform number, so all parameters 0 give the uniform
distribution, exactly. Axis letters: K components; all else is batch.
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from .sites import U_EPS

MIN_LOG_SCALE = -6.0  # logarithm of the least scale
MAX_LOGIT = 14.0  # logits between which a quantile lies; those of what is nearest to 0 and 1
BISECTION_STEPS, NEWTON_STEPS = 20, 2  # of bisection, and of Newton's method from there


class LogisticMixture(NamedTuple):
    """A mixture for each entry of a batch.

    Attributes:
        weight: ``(..., K)`` logits of the components.
        location: ``(..., K)``.
        log_scale: ``(..., K)``.
    """

    weight: Tensor
    location: Tensor
    log_scale: Tensor

    @staticmethod
    def from_raw(raw: Tensor) -> "LogisticMixture":
        """From a network's ``(..., 3 K)``; zeros give the uniform distribution."""
        weight, location, log_scale = raw.chunk(3, -1)
        return LogisticMixture(weight, location, log_scale.clamp(MIN_LOG_SCALE, 2.0))

    def log_prob(self, u: Tensor) -> Tensor:
        """``(...)`` log density at ``u (...)``."""
        logit = u.clamp(U_EPS, 1 - U_EPS).logit()
        z = (logit.unsqueeze(-1) - self.location) * (-self.log_scale).exp()
        each = F.logsigmoid(z) + F.logsigmoid(-z) - self.log_scale
        return torch.logsumexp(F.log_softmax(self.weight, -1) + each, -1) - F.logsigmoid(logit) - F.logsigmoid(-logit)

    def cdf(self, logit: Tensor) -> Tensor:
        """``(...)`` probability of less than the sigmoid of ``logit (...)``."""
        return self._below()(logit)

    def _below(self) -> Callable[[Tensor], Tensor]:
        """``cdf``, with what does not go by the value computed once."""
        weight, rate = self.weight.softmax(-1), (-self.log_scale).exp()
        return lambda logit: (weight * ((logit.unsqueeze(-1) - self.location) * rate).sigmoid()).sum(-1)

    def icdf(self, v: Tensor) -> Tensor:
        """``(...)`` the u below which a probability of ``v (...)`` lies; its gradient by the parameters is that of the
        implicit function."""
        with torch.no_grad():
            cdf = self._below()
            low = torch.full_like(v, -MAX_LOGIT)
            high = torch.full_like(v, MAX_LOGIT)
            for _ in range(BISECTION_STEPS):
                middle = (low + high) / 2
                below = cdf(middle) < v
                low, high = torch.where(below, middle, low), torch.where(below, high, middle)
            logit, slack = (low + high) / 2, high - low  # the root may be an end of the interval
            for _ in range(NEWTON_STEPS):
                slope = (self.log_prob(logit.sigmoid()) + F.logsigmoid(logit) + F.logsigmoid(-logit)).exp()
                newton = logit - (cdf(logit) - v) / slope
                logit = torch.where((newton > low - slack) & (newton < high + slack), newton, logit)
            u = logit.sigmoid().clamp(U_EPS, 1 - U_EPS)
        return self.reparameterise(u)

    def reparameterise(self, u: Tensor) -> Tensor:
        """``u (...)``, with the gradient by the parameters that the quantile has which it is: that of the implicit
        function."""
        if not torch.is_grad_enabled() or not self.location.requires_grad:
            return u
        u = u.detach()
        below = self.cdf(u.logit())
        return u - (below - below.detach()) / self.log_prob(u).exp().detach().clamp(min=U_EPS)
