"""Scene graphs of parameter guides. Axis letters: N scenes, M nodes."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from probscene.derivation import Derivation
from probscene.grammar import Grammar


class SceneGraph(NamedTuple):
    """Relations of the nodes of scenes.

    Attributes:
        kind: ``(N, M)`` int64; -1 pads.
        parent, before: ``(N, M)`` int64 node index of the parent and of the sibling before, -1 for none.
        rank, number: ``(N, M)`` int64 place among its siblings, and how many they are with it.
        same_rank, same_number: the same among siblings of its own kind.
    """

    kind: Tensor
    parent: Tensor
    before: Tensor
    rank: Tensor
    number: Tensor
    same_rank: Tensor
    same_number: Tensor

    @property
    def siblings(self) -> Tensor:
        """``(N, M, M)`` bool, which nodes are siblings; each is its own."""
        parent = self.parent.where(self.kind >= 0, -2)
        return (parent.unsqueeze(-1) == parent.unsqueeze(-2)) & (parent > -2).unsqueeze(-1)

    @staticmethod
    def from_nodes(kind: Tensor, parent: Tensor) -> "SceneGraph":
        """Of nodes in the order of a derivation, each ``(N, M)``."""
        there = kind >= 0
        siblings = (parent.unsqueeze(-1) == parent.unsqueeze(-2)) & there.unsqueeze(-1) & there.unsqueeze(-2)
        same = siblings & (kind.unsqueeze(-1) == kind.unsqueeze(-2))
        earlier = siblings.tril(-1)
        index = torch.arange(kind.shape[1]).expand_as(earlier)
        before = index.where(earlier, -1).amax(-1)
        return SceneGraph(kind, parent, before, earlier.sum(-1), siblings.sum(-1), same.tril(-1).sum(-1), same.sum(-1))


class ClassNodes(NamedTuple):
    """The nodes of derivations that have a class, without gaps: only these can be read in an image.

    Attributes:
        kind, parent: ``(N, M')``, the parent the nearest that has a class.
        slot: ``(N, M')`` int64, which node of the derivation each is.
        place: ``(N, M)`` int64, the reverse; whatever for nodes without a class.
    """

    kind: Tensor
    parent: Tensor
    slot: Tensor
    place: Tensor

    @staticmethod
    def from_derivation(grammar: Grammar, classes: Sequence[str], derivation: Derivation) -> "ClassNodes":
        """Of derivations."""
        kind, parent = derivation.kind, derivation.parent
        has_class = torch.zeros(len(grammar.kinds) + 1, dtype=torch.bool)
        has_class[[grammar.kind(name) for name in classes]] = True
        while True:
            above = parent.clamp(min=0)
            hidden = (parent >= 0) & ~has_class[kind.gather(1, above)]
            if not hidden.any():
                break
            parent = torch.where(hidden, parent.gather(1, above), parent)
        there = has_class[kind]
        order = (~there).long().argsort(dim=1, stable=True)
        place = order.argsort(1)
        slot = order[:, : max(1, int(there.sum(1).max()) if len(kind) else 1)]
        mapped = torch.where(parent >= 0, place.gather(1, parent.clamp(min=0)), -1)
        seen = there.gather(1, slot)
        return ClassNodes(kind.gather(1, slot).where(seen, -1), mapped.gather(1, slot).where(seen, -1), slot, place)

    def gather(self, values: Tensor) -> Tensor:
        """``(N, M', ...)`` of values of the derivation's nodes ``(N, M, ...)``. There may be fewer, or more, where a
        scenario's own program has drawn them; what is taken is of no use in scenes of another."""
        slot = self.slot.clamp(max=values.shape[1] - 1)
        return values.gather(1, slot.view(*slot.shape, *(1,) * (values.ndim - 2)).expand(-1, -1, *values.shape[2:]))

    def scatter(self, values: Tensor, others: Tensor) -> Tensor:
        """``(N, M)`` of values ``(N, M')``; ``others (N, M)``, as wide as in ``gather``, where a node has no class."""
        M = others.shape[1]
        place = F.pad(self.place[:, :M], (0, max(0, M - self.place.shape[1])), value=values.shape[1])
        at = place.clamp(max=values.shape[1] - 1)
        back = values.gather(1, at)
        there = (place < values.shape[1]) & (self.kind.gather(1, at) >= 0)
        return back.where(there, others)


def class_of(kind: Tensor, kinds: Tensor) -> Tensor:
    """Which of the classes, whose kinds in the grammar are ``(C,)``, nodes ``(N, M)`` are; -1 for none."""
    same = kind.unsqueeze(-1) == kinds
    return same.int().argmax(-1).where(same.any(-1), -1)
