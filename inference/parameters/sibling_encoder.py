"""Siblings that are alike in a site: cars of one lane, mugs of one colour.

Two nodes are alike in a site where both their u lie in the same half of 0..1, as a program's ``side > 0.5`` divides
them, or close to one another. Of those alike in each of the sites before, the network of a parameter guide sees a
node's place among them, how many they are, and the value of the last one before it. Axis letters: N scenes, M nodes, S
sites of nodes, W ways to be alike, two for each site, H units.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn

CLOSE = 0.12  # of u
LOGITS = 4.0  # a logit of this is 1 for the network
FEATURES = 6  # of each way
PAIRS = 4_000_000  # of nodes, times sites, that are looked at together, at most


class SiblingLinks(NamedTuple):
    """Who is alike whom.

    Attributes:
        place: ``(N, M, 4 W)``, a node's place among those alike, and one over their number; 0 where nothing is known.
        last: ``(N, M, W)`` int64, the last one before it; -1 for none.
    """

    place: Tensor
    last: Tensor


class SiblingEncoder(nn.Module):
    """From what is known of those alike to H units.

    Args:
        sites: S.
        hidden: H.
    """

    def __init__(self, sites: int, hidden: int):
        super().__init__()
        self.read = nn.Linear(2 * max(1, sites) * FEATURES, hidden)

    def links(self, together: Tensor, own: Tensor, before: SiblingLinks | None = None, first: int = 0) -> SiblingLinks:
        """Of nodes of which some sites are known.

        Args:
            together: ``(N, M, M)`` bool, who is whose sibling, itself included.
            own: ``(N, M, S)`` u, NaN where they are not known.
            before: of these nodes in the sites before number ``first``; nobody's where None.
            first: the first site that is looked at.
        """
        ways, (N, M, S) = 2 * max(1, own.shape[2]), own.shape
        if before is None:
            place, last = own.new_zeros(N, M, ways, 4), torch.full((N, M, ways), -1)
        else:
            place, last = before.place.unflatten(2, (ways, 4)).clone(), before.last.clone()
        sites = (~own.isnan()).any(1).any(0).nonzero().flatten()  # of the others nothing is known
        sites = sites[sites >= first]
        at_once = max(1, PAIRS // max(1, M**2 * max(1, len(sites))))
        parts = zip(together.split(at_once), own[..., sites].split(at_once), strict=True)
        columns = torch.cat([sites, sites + S])
        if len(sites):
            found = [self._links(*some) for some in parts]
            place[:, :, columns], last[:, :, columns] = (torch.cat(part) for part in zip(*found, strict=True))
        return SiblingLinks(place.flatten(2), last)

    def _links(self, together: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """Of the ways of some sites, ``(N, M, W, 4)`` and ``(N, M, W)``."""
        v, M = u.transpose(1, 2).contiguous(), u.shape[1]  # sums along the last axis are much faster
        known, half = ~v.isnan(), v > 0.5
        both = together.unsqueeze(1) & known.unsqueeze(2) & known.unsqueeze(3)
        close = (v.unsqueeze(3) - v.unsqueeze(2)).abs() < CLOSE
        alike = torch.cat([(half.unsqueeze(3) == half.unsqueeze(2)) & both, close & both], 1)
        earlier = alike & torch.ones(M, M, dtype=torch.bool).tril(-1)
        number, known = alike.sum(3).clamp(min=1), known.repeat(1, 2, 1)
        part = (earlier.sum(3) + 0.5) / number
        place = torch.stack([2 * part - 1, part.logit() / LOGITS, 1 / number, known.to(part.dtype)], -1)
        last = (earlier * torch.arange(1, M + 1, dtype=torch.int16)).amax(3).long() - 1
        return (place * known.unsqueeze(-1)).transpose(1, 2).to(u.dtype), last.transpose(1, 2)

    def forward(self, place: Tensor, last: Tensor, u: Tensor) -> Tensor:
        """``(N, M', H)`` of some of the nodes.

        Args:
            place, last: of them, ``(N, M', ...)``, see ``SiblingLinks``.
            u: of one site of all nodes so far, ``(N, J)``; NaN where they have none.
        """
        found = u.gather(1, last.clamp(min=0).flatten(1)).view(last.shape)
        there = (last >= 0) & ~found.isnan()
        return self.read(torch.cat([place, (2 * found - 1).where(there, 0.0), there.to(u.dtype)], -1))
