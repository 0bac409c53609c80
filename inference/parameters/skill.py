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
GEOMETRY_MARGINS = 0.05, 0.15  # by which a circle, and one that u goes round twice, must explain more
MIN_OBJECTS = 20  # or readings of a site in the target, to conclude anything from
MIN_SD = 2e-3
NUM_GUESSES = 41  # constants, of which the best is the guess without a reading
STANDARD_ERRORS = 2.0  # that are subtracted from an estimated share


class Skill(NamedTuple):
    """Of each site.

    Attributes:
        way: ``(S,)`` int64, ``LINE``, ``CIRCLE`` or ``TWICE``.
        share: ``(S,)`` of the variance that is explained, at least; NaN where the site was seen in fewer than two
            objects.
    """

    way: Tensor
    share: Tensor

    @property
    def turns(self) -> Tensor:
        """``(S,)`` bool, which are read on a circle."""
        return self.way != LINE

    @property
    def readable(self) -> Tensor:
        """``(S,)`` bool."""
        return self.share > MIN_SKILL

    @staticmethod
    def from_readings(raw: Tensor, u: Tensor) -> "Skill":
        """Of the reader's output for objects ``(K, S, ...)`` whose u ``(K, S)`` is known; NaN where there is none."""
        ways, shares = [], []
        for s in range(u.shape[1]):
            there = ~u[:, s].isnan()
            true, output = u[there, s], raw[there, s]
            if len(true) < 2:
                ways.append(LINE)
                shares.append(torch.nan)
                continue
            found = [
                _explained(truncated_mean(*normal(output)), true, 0),
                _explained(_turned(output, 1), true, 1),
                _explained(_turned(output, 2), true, 2),
            ]
            each = [share for share, _ in found]
            way = CIRCLE if each[1] > each[0] + GEOMETRY_MARGINS[0] else LINE
            way = TWICE if each[2] > each[way] + GEOMETRY_MARGINS[1] else way
            ways.append(way)
            shares.append(each[way] - STANDARD_ERRORS * found[way][1])
        return Skill(torch.tensor(ways), torch.tensor(shares))

    def explained_variance(self, raw: Tensor, u: Tensor) -> Tensor:
        """``(S,)`` the share of u's variance that readings of other objects ``(K, S, ...)`` explain by linear
        regression, as a reader that has since learnt to expect some values guesses toward them. NaN for a site that
        fewer than ``MIN_OBJECTS`` of the objects have."""
        shares = []
        for s, way in enumerate(self.way.tolist()):
            there = ~u[:, s].isnan()
            true, output = u[there, s], raw[there, s]
            if len(true) < MIN_OBJECTS:
                shares.append(torch.nan)
                continue
            turned = slice(2 * way, 2 * way + 2)
            y = _direction(way * true) if way else true.unsqueeze(1)
            x = output[:, turned] if way else truncated_mean(*normal(output)).unsqueeze(1)
            x, y = x - x.mean(0), y - y.mean(0)
            left = y - x @ torch.linalg.lstsq(x, y, driver="gelsd").solution
            shares.append(1 - float(left.square().sum() / y.square().sum()))
        return torch.tensor(shares)

    def read(self, raw: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation of u, ``(K, S)`` each, from a reader's output ``(K, S, ...)``. Where two values
        look alike, one of them is drawn by the reader's probability."""
        mean, sd = normal(raw)
        for s, way in enumerate(self.way.tolist()):
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
