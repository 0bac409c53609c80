"""Which sites a reader can read, and how, by renders of the prior that nothing was trained on.

A site is read on a line, on a circle, where u = 0 and u = 1 look alike, or on a circle that u goes round twice, where
two values look alike: in the way that is likeliest once readings are recalibrated. Skill is the share of the variance
of u that a reading explains; of a site of which few objects were seen, only as much as is sure. Axis letters: K
objects, S sites.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from .reader import normal, truncated_mean
from .recalibration import likeliest, negative_log_likelihood, with_outliers

LINE, CIRCLE, TWICE = range(3)
MIN_SKILL = 0.2  # of a site that is learnt
MAX_COSINE = 0.96  # of how sure it is which of two values that look alike u is
MIN_OBJECTS = 20  # or readings of a site in the target, to conclude anything from
MIN_SD = 2e-3
NUM_GUESSES = 41  # constants, of which the best is the guess without a reading
STANDARD_ERRORS = 2.0  # subtracted from an estimated share, and by which a circle is likelier than a line


class Skill(NamedTuple):
    """Of each site.

    Attributes:
        geometry: ``(S,)`` int64, ``LINE``, ``CIRCLE`` or ``TWICE``.
        explained: ``(S,)`` share of the variance that a reading explains, at least; NaN where the site was seen in
            fewer than two objects.
    """

    geometry: Tensor
    explained: Tensor

    def select(self, sites: slice) -> "Skill":
        """Of some sites."""
        return Skill(self.geometry[sites], self.explained[sites])

    @property
    def turns(self) -> Tensor:
        """``(S,)`` bool, which are read on a circle."""
        return self.geometry != LINE

    @property
    def readable(self) -> Tensor:
        """``(S,)`` bool."""
        return self.explained > MIN_SKILL

    @staticmethod
    def from_readings(raw: Tensor, u: Tensor) -> "Skill":
        """Of the reader's output for objects ``(K, S, ...)`` whose u ``(K, S)`` is known; NaN where there is none."""
        geometries, shares = [], []
        for s in range(u.shape[1]):
            there = ~u[:, s].isnan()
            true, output = u[there, s], raw[there, s]
            if len(true) < 2:
                geometries.append(LINE)
                shares.append(torch.nan)
                continue
            found = [_on_a_line(output, true), _on_a_circle(output, true), _on_a_circle_twice(output, true)]
            way = LINE
            for other in (CIRCLE, TWICE):
                better = found[way].nats - found[other].nats
                if float(better.mean()) > STANDARD_ERRORS * float(better.std()) / len(true) ** 0.5:
                    way = other
            geometries.append(way)
            shares.append(found[way].share - STANDARD_ERRORS * found[way].error)
        return Skill(torch.tensor(geometries), torch.tensor(shares))

    def read(self, raw: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation of u, ``(K, S)`` each, from a reader's output ``(K, S, ...)``. Where two values
        look alike, one of them is drawn by the reader's probability."""
        mean, sd = normal(raw)
        for s, way in enumerate(self.geometry.tolist()):
            if way == CIRCLE:
                mean[:, s] = _turned(raw[:, s], 1).remainder(1.0)
                sd[:, s] = _spread(raw[:, s, 2:4], 1)
            if way == TWICE:
                half = _turned(raw[:, s], 2).remainder(0.5)
                toward = (raw[:, s, 2:4] * _direction(half)).sum(-1)  # -1 for the other one, 1 for this
                other = torch.rand(len(raw)) > (1 + toward.clamp(-1, 1)) / 2
                mean[:, s], sd[:, s] = half + 0.5 * other, _spread(raw[:, s, 4:6], 2)
        return mean, sd.clamp(min=MIN_SD)


def _turned(output: Tensor, times: int) -> Tensor:
    """u by the cosine and sine of so many turns, -0.5..0.5 over ``times``."""
    cosine, sine = output[..., 2 * times], output[..., 2 * times + 1]
    return torch.atan2(sine, cosine) / (2 * torch.pi * times)


class _Reading(NamedTuple):
    """How well a site is read in one way, recalibrated.

    Attributes:
        nats: ``(K,)`` negative log likelihood of u.
        share: of the variance of u that is explained, against the best guess without a reading.
        error: its standard error, by the delta method.
    """

    nats: Tensor
    share: float
    error: float


def _on_a_line(output: Tensor, true: Tensor) -> _Reading:
    mean, sd = normal(output)
    slope, scale, outliers = likeliest(mean, sd, true, circle=False)
    mean, sd = 0.5 + slope * (mean - 0.5), scale * sd
    nats = with_outliers(negative_log_likelihood(mean, sd, true, circle=False), outliers)
    return _Reading(nats, *_explained(truncated_mean(mean, sd), true, 0))


def _on_a_circle(output: Tensor, true: Tensor) -> _Reading:
    read = _turned(output, 1)
    return _Reading(_circular_nats(read, _spread(output[:, 2:4], 1), true), *_explained(read, true, 1))


def _on_a_circle_twice(output: Tensor, true: Tensor) -> _Reading:
    """The likelihood of u's place on the circle, and of the one of its two places there."""
    read = _turned(output, 2)
    nats = _circular_nats(2 * read, 2 * _spread(output[:, 4:6], 2), (2 * true).remainder(1.0)) - math.log(2)
    toward = (output[:, 2:4] * _direction(read)).sum(-1).clamp(-MAX_COSINE, MAX_COSINE)
    is_it = _circular_difference(true, read, 1.0).abs() < 0.25
    return _Reading(nats - ((1 + toward.where(is_it, -toward)) / 2).log(), *_explained(read, true, 2))


def _circular_nats(read: Tensor, sd: Tensor, true: Tensor) -> Tensor:
    sd = sd.clamp(min=MIN_SD)
    _, scale, outliers = likeliest(read, sd, true, circle=True)
    return with_outliers(negative_log_likelihood(read, scale * sd, true, circle=True), outliers)


def _explained(read: Tensor, true: Tensor, times: int) -> tuple[float, float]:
    """The share of u's variance that is explained and its standard error; on a line, or on a circle that u goes round
    so many times."""
    whole = 1 / max(times, 1)
    guess = torch.linspace(0, whole, NUM_GUESSES).unsqueeze(1)

    def squared(output: Tensor) -> Tensor:
        return (_circular_difference(output, true, whole) if times else output - true).square()

    error, least = squared(read), squared(guess[squared(guess).mean(1).argmin()])
    part = float(error.mean() / least.mean())
    return 1 - part, float((error - part * least).std() / least.mean()) / len(true) ** 0.5


def _circular_difference(one: Tensor, other: Tensor, whole: float) -> Tensor:
    return (one - other + whole / 2).remainder(whole) - whole / 2


def _direction(u: Tensor) -> Tensor:
    return torch.stack([(2 * torch.pi * u).cos(), (2 * torch.pi * u).sin()], -1)


def _spread(vector: Tensor, times: int) -> Tensor:
    """The standard deviation of u on a circle, of the mean of its cosine and sine."""
    length = vector.norm(dim=-1).clamp(0.05, 0.999)
    return (-2 * length.log()).sqrt() / (2 * torch.pi * times)
