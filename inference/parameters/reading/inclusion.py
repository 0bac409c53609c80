"""How likely it is that an object is found, by its values: what is far, small or behind something is found less often.

What is read in a target is of the objects that are found there. Each counts as much as there are such objects for one
that is found, one over its probability of inclusion [1]. That is a logistic regression for each kind, on objects of
renders, which are known whether they are found or not. Axis letters: K objects, L images, M nodes, S sites.

References:
    [1] Horvitz, Thompson, *A generalization of sampling without replacement from a finite universe*, JASA 1952.
"""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

LEAST = 0.1  # probability; what is found less often counts as this does
FEWEST = 20  # objects of a kind that are found, and that are not, by which it is told
PRIOR = 1.0  # precision of the coefficients


class Inclusion:
    """Of objects by kind and u.

    Args:
        kind: ``(K,)`` int64.
        u: ``(K, S)``, NaN where one has no such site.
        found: ``(K,)`` bool.
        turns: ``(S,)`` bool, the sites on a circle.
    """

    def __init__(self, kind: Tensor, u: Tensor, found: Tensor, turns: Tensor):
        self.turns, self.weights = turns, dict[int, Tensor]()
        for each in kind.unique().tolist():
            some = kind == each
            number = int(found[some].sum())
            if each >= 0 and number >= FEWEST and int(some.sum()) - number >= FEWEST:
                self.weights[each] = _regression(features(u[some], turns), found[some])

    def weight(self, kind: Tensor, u: Tensor) -> Tensor:
        """``(L, M)`` of nodes with ``u (L, M, S)``; of each kind, 1 in the mean, and 1 where nothing is known."""
        weight = torch.ones(kind.shape)
        for each, coefficients in self.weights.items():
            some = kind == each
            if some.any():
                inverse = 1 / (features(u[some], self.turns) @ coefficients).sigmoid().clamp(min=LEAST)
                weight[some] = inverse / inverse.mean()
        return weight


def features(u: Tensor, turns: Tensor) -> Tensor:
    """``(K, 1 + 2 S)``: one, and of each site two functions whose mean is 0 over 0..1; 0 where there is none."""
    x, angle = 2 * u - 1, 2 * math.pi * u
    one, other = torch.where(turns, angle.cos(), x), torch.where(turns, angle.sin(), 1.5 * x.square() - 0.5)
    return torch.cat([torch.ones(len(u), 1), one.nan_to_num(0.0), other.nan_to_num(0.0)], 1)


def _regression(x: Tensor, found: Tensor) -> Tensor:
    """Coefficients of a logistic regression, with a normal prior on all but the first one."""
    x, y = x.double(), found.double()
    coefficients = torch.zeros(x.shape[1], dtype=torch.float64, requires_grad=True)
    optimiser = torch.optim.LBFGS([coefficients], max_iter=50, line_search_fn="strong_wolfe")

    def closure() -> Tensor:
        optimiser.zero_grad()
        loss = F.binary_cross_entropy_with_logits(x @ coefficients, y, reduction="sum")
        loss = loss + 0.5 * PRIOR * coefficients[1:].square().sum()
        loss.backward()
        return loss

    with torch.enable_grad():
        optimiser.step(closure)
    return coefficients.detach().float()
