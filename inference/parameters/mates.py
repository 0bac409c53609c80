"""Siblings that are alike: cars of one lane, mugs of one shelf.

Which siblings are alike in the sites before is learnt with everything else. Of a node's mates the network of a
parameter guide sees how many there are, how many came before, and the value of the last one. Axis letters: N scenes, M
nodes, S sites of nodes, H units.
"""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

SCALE, START = 10.0, -2.0  # of the squared difference of u; where its weight starts, before softplus
FARTHEST = -1e4  # logarithm of the weight of a node that is no sibling


class Ties(NamedTuple):
    """How alike a scene's siblings are.

    Attributes:
        share: ``(N, M, M)`` attention of each node to those before it; rows of zeros where there are none.
        place: ``(N, M, 3)``, a node's place among its mates, and one over how many they are.
    """

    share: Tensor
    place: Tensor


class Mates(nn.Module):
    """Zeros for every weight of ``read`` give zeros.

    Args:
        sites: S.
        hidden: H.
    """

    def __init__(self, sites: int, hidden: int):
        super().__init__()
        self.unlike = nn.Parameter(torch.full((max(1, sites), max(1, sites)), START))
        self.recent = nn.Parameter(torch.zeros(max(1, sites)))
        self.read = nn.Linear(5, hidden)

    def ties(self, together: Tensor, own: Tensor, s: int) -> Ties:
        """For site number ``s``.

        Args:
            together: ``(N, M, M)`` bool, who is whose sibling, itself included.
            own: ``(N, M, S)`` u of the sites before ``s``, NaN where there are none.
        """
        known = own[..., :s]
        there = ~known.isnan()
        known = known.nan_to_num(0.0)
        apart = (known.unsqueeze(2) - known.unsqueeze(1)).square()
        apart = torch.where(
            there.unsqueeze(2) & there.unsqueeze(1), apart, 1.0 * (there.unsqueeze(2) ^ there.unsqueeze(1))
        )
        weight = SCALE * F.softplus(self.unlike[s, :s])
        alike = torch.where(together, -(apart @ weight) if s else torch.zeros_like(together, dtype=own.dtype), FARTHEST)
        mass = alike.exp()
        M = together.shape[1]
        earlier = torch.ones(M, M, dtype=torch.bool).tril(-1)
        number, before = mass.sum(-1).clamp(min=1e-3), (mass * earlier).sum(-1)
        score = alike + F.softplus(self.recent[s]) * torch.arange(M)
        some = (together & earlier).any(-1, keepdim=True)
        share = torch.where(some, score.masked_fill(~(together & earlier), FARTHEST).softmax(-1), 0.0)
        return Ties(
            share,
            torch.stack([(before + 0.5) / number.clamp(min=1.0), 1 / number.clamp(min=1.0), 1.0 * some[..., 0]], -1),
        )

    def forward(self, place: Tensor, share: Tensor, u: Tensor) -> Tensor:
        """``(..., H)`` of nodes.

        Args:
            place: ``(..., 3)``, see ``Ties``.
            share: ``(..., J)`` attention to J nodes.
            u: of site ``s`` of these, ``(..., J)``; NaN where they have none.
        """
        there = ~u.isnan()
        mass = (share * there).sum(-1)
        last = (share * u.nan_to_num(0.0)).sum(-1) / mass.clamp(min=1e-6)
        return self.read(torch.cat([place, torch.stack([(2 * last - 1) * (mass > 0), mass], -1)], -1))
