"""Which sites a reader can read, and how, by renders of the prior that nothing was trained on.

A site is read on a line, on a circle, where u = 0 and u = 1 look alike, or on a circle that u goes round twice, where
two values look alike. Skill is the share of the variance of u that a reading explains; of a site of which few objects
were seen, only as much as is sure. Axis letters: K objects, S sites.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from .reader import normal, truncated_mean

LINE, CIRCLE, TWICE = range(3)
MIN_SKILL = 0.2  # of a site that is learnt
CIRCLE_REMAINDER = 0.8  # of the variance that a line leaves, and a circle of what it goes round once, at most
MIN_OBJECTS = 20  # or readings of a site in the target, to conclude anything from
MIN_SD = 2e-3
NUM_GUESSES = 41  # constants, of which the best is the guess without a reading
STANDARD_ERRORS = 2.0  # that are subtracted from an estimated share


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
            found = [
                _explained(truncated_mean(*normal(output)), true, 0),
                _explained(_turned(output, 1), true, 1),
                _explained(_turned(output, 2), true, 2),
            ]
            each = [share for share, _ in found]
            way = CIRCLE if 1 - each[1] < CIRCLE_REMAINDER * (1 - each[0]) else LINE
            way = TWICE if 1 - each[2] < CIRCLE_REMAINDER * (1 - each[way]) else way
            geometries.append(way)
            shares.append(each[way] - STANDARD_ERRORS * found[way][1])
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


def _explained(read: Tensor, true: Tensor, times: int) -> tuple[float, float]:
    """The share of u's variance that a reading explains, against the best guess without one, and its standard error, by
    the delta method; on a line, or on a circle that u goes round so many times."""
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
