"""Which kinds of objects can hang below which, and how many of one kind each node of another has.

What a context-free grammar cannot weigh shows here: cars on the first road, and cars on the second. Axis letters: N
scenes, M nodes, P nodes of the parent's kind in all scenes.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from .derivation import Derivation
from .grammar import Grammar


class PerParent(NamedTuple):
    """The nodes of one kind, scene by scene and each scene's in the order of derivation, and what hangs below each.

    Attributes:
        scene: ``(P,)`` int64 index of its scene.
        rank: ``(P,)`` int64, how many nodes of its kind come before it below the same parent (or below none).
        count: ``(P,)`` int64, how many nodes of the other kind are its children.
    """

    scene: Tensor
    rank: Tensor
    count: Tensor


def relations(grammar: Grammar) -> tuple[tuple[str, str], ...]:
    """Every pair (parent, child) of kinds that some derivation of the grammar has, in the order of ``grammar.kinds``.

    Every symbol of a grammar is reached and ends, so whatever two rules allow together, some derivation does.
    """
    V, kinds = len(grammar.nonterminals), len(grammar.kinds)
    loose = torch.zeros(V, kinds, dtype=torch.bool)  # what a nonterminal derives below the owner of itself
    held = torch.zeros(kinds, kinds, dtype=torch.bool)
    while _grow(grammar, loose, held):
        pass
    return tuple((grammar.kinds[i], grammar.kinds[j]) for i, j in held.nonzero().tolist())


def _grow(grammar: Grammar, loose: Tensor, held: Tensor) -> bool:
    """One round over the rules; whether it found more."""
    before = int(loose.sum() + held.sum())
    for k, v in enumerate(grammar.lhs.tolist()):
        objects = grammar.objects[k].tolist()
        produced = [
            (owner, torch.tensor([kind])) for kind, owner in _pairs(grammar.objects[k], grammar.object_owner[k])
        ]
        produced += [
            (owner, loose[child].nonzero().flatten())
            for child, owner in _pairs(grammar.children[k], grammar.child_owner[k])
        ]
        for owner, found in produced:
            table = loose[v] if owner < 0 else held[objects[owner]]
            table[found] = True
    return int(loose.sum() + held.sum()) > before


def _pairs(symbols: Tensor, owners: Tensor) -> list[tuple[int, int]]:
    return [(s, o) for s, o in zip(symbols.tolist(), owners.tolist(), strict=True) if s >= 0]


def per_parent(derivation: Derivation, parent: int, child: int) -> PerParent:
    """How many children of kind ``child`` each node of kind ``parent`` has, by indices of ``grammar.kinds``."""
    kind, above = derivation.kind, derivation.parent
    M = kind.shape[1]
    scene, node = (kind == parent).nonzero(as_tuple=True)
    owned = ((kind == child) & (above >= 0)).nonzero(as_tuple=True)
    number = torch.zeros(kind.numel(), dtype=torch.int64)
    number.index_add_(0, owned[0] * M + above[owned], torch.ones_like(owned[0]))
    return PerParent(scene, _ranks(scene * (M + 1) + above[scene, node] + 1), number[scene * M + node])


def _ranks(group: Tensor) -> Tensor:
    """``(P,)`` how many entries before each one are of the same group."""
    order = torch.argsort(group, stable=True)
    _, sizes = torch.unique_consecutive(group[order], return_counts=True)
    first = torch.repeat_interleave(sizes.cumsum(0) - sizes, sizes)
    ranks = torch.empty_like(group)
    ranks[order] = torch.arange(len(group)) - first
    return ranks
