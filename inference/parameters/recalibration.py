"""Recalibration of readings as likelihoods: a slope, a scale and a share of outliers a site, by maximum likelihood [1].

A reader says a normal distribution, cut off at 0 and 1, of a value u whose prior is uniform. Its mean and standard
deviation are those of a network that was trained for a while, averaged over the cells of an object: too wide by a fifth
or more, and where much is cut off the mean is far outside. Of renders with known u, the distribution of mean
.5 + slope (mean - .5) and of standard deviation scale * sd is taken that is likeliest, mixed with a uniform one: a few
objects look like others that are turned, and their readings say nothing. The slope is 1 of what is read on a circle.
Axis letters: K objects, S sites.

References:
    [1] Kuleshov, Fenner, Ermon, *Accurate uncertainties for deep learning using calibrated regression*, ICML 2018.
"""

import math
from typing import NamedTuple

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor

from .reader import cut_off_mass

MIN_KNOWN = 100  # objects of a site, with known u, that it takes
MAX_FACTOR = 4.0  # and one over that, of slopes and scales
OUTLIERS = 1e-4, 0.02, 0.5  # least share, the first guess, and the largest
TURNS = torch.arange(-1.0, 2.0)  # by which a reading on a circle may be off


class Recalibration(NamedTuple):
    """Of each site.

    Attributes:
        slope, scale, outliers: ``(S,)``.
    """

    slope: Tensor
    scale: Tensor
    outliers: Tensor

    @staticmethod
    def identity(sites: int) -> "Recalibration":
        """Leaves readings as they are."""
        return Recalibration(torch.ones(sites), torch.ones(sites), torch.zeros(sites))

    @staticmethod
    def from_readings(mean: Tensor, sd: Tensor, u: Tensor, turns: Tensor) -> "Recalibration":
        """Of readings ``(K, S)`` of objects whose u ``(K, S)`` is known, NaN where it is not; the identity of a site of
        which few are known.

        Args:
            turns: ``(S,)`` bool, sites that are read on a circle.
        """
        found = Recalibration.identity(u.shape[1])
        for s in range(u.shape[1]):
            known = ~u[:, s].isnan()
            of_site = tuple(part[known, s] for part in (mean, sd, u))
            found.slope[s], found.scale[s], found.outliers[s] = likeliest(*of_site, circle=bool(turns[s]))
        return found

    def apply(self, mean: Tensor, sd: Tensor) -> tuple[Tensor, Tensor]:
        """Readings ``(K, S)``, recalibrated."""
        return torch.where(self.slope == 1, mean, 0.5 + self.slope * (mean - 0.5)), self.scale * sd


def likeliest(mean: Tensor, sd: Tensor, u: Tensor, circle: bool) -> tuple[float, float, float]:
    """Slope, scale and outliers of one site's readings ``(K,)`` of known u ``(K,)``; of few objects those of
    ``Recalibration.identity``."""
    if len(u) < MIN_KNOWN:
        return 1.0, 1.0, 0.0
    mean, sd, u, limit = mean.double(), sd.double(), u.double(), math.log(MAX_FACTOR)

    def loss(at: np.ndarray) -> float:
        slope = 1.0 if circle else math.exp(at[2])
        nats = negative_log_likelihood(0.5 + slope * (mean - 0.5), math.exp(at[0]) * sd, u, circle)
        return float(with_outliers(nats, at[1]).mean())

    start = [0.0, OUTLIERS[1]] if circle else [0.0, OUTLIERS[1], 0.0]
    bounds = [(-limit, limit), (OUTLIERS[0], OUTLIERS[2]), (-limit, limit)][: len(start)]
    found = minimize(loss, np.array(start), method="Nelder-Mead", bounds=bounds).x
    return (1.0 if circle else math.exp(found[2])), math.exp(found[0]), float(found[1])


def with_outliers(nats: Tensor, share: float) -> Tensor:
    """Of ``negative_log_likelihood``, where a share of the readings says nothing."""
    if share == 0:
        return nats
    return -torch.logaddexp(math.log(1 - share) - nats, torch.full_like(nats, math.log(share)))


def negative_log_likelihood(mean: Tensor, sd: Tensor, u: Tensor, circle: bool) -> Tensor:
    """``(...)`` nats of u under readings on 0..1 or on a circle."""
    constant = math.log(2 * math.pi) / 2
    if circle:
        z = (u - mean.remainder(1.0)).unsqueeze(-1) + TURNS.to(u.dtype)
        return sd.log() - (-0.5 * (z / sd.unsqueeze(-1)).square()).logsumexp(-1) + constant
    return 0.5 * ((u - mean) / sd).square() + sd.log() + cut_off_mass(mean, sd).log() + constant
