"""What is counted of structures: objects of each class, and, where kinds hang below others, the children of each node.

Children are counted over all nodes and by rank, the number of nodes of the node's kind before it below the same parent.

Axis letters: N scenes, C classes, P nodes of a parent's kind in all scenes.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from probscene.derivation import Derivation
from probscene.derive import derive_complete
from probscene.inference.statistics.count_metrics import Tally, tally, tally_images
from probscene.model import SceneModel
from probscene.policy import Policy
from probscene.relations import PerParent, per_parent, relations
from probscene.threads import threads

from ..chunks import chunk_randomness

BATCH_SIZE = 500

Counts = NDArray[np.int64]
Relation = tuple[str, str]
"""Names of a kind and of one that hangs below it."""
RANKS = ("first", "second", "third", "fourth", "fifth")
PARENTS, ALL, OTHERS, LATER = "parents", "all", "others", "later"
GROUPS = (PARENTS, ALL, *RANKS, LATER, OTHERS)
"""What is tallied of a relation: parents an image; children of every parent, of the one of each rank, of those of
higher ranks together, and of all but the first."""


@dataclass(frozen=True, eq=False)
class StructureCounts:
    """Counts of scenes.

    Attributes:
        counts: ``(N, C)`` int64 objects of each of the model's classes.
        children: by relation, the nodes of the parent's kind with the number of their children; empty where nothing
            nests, or where only the counts are known.
    """

    counts: Counts
    children: dict[Relation, PerParent]

    def __len__(self) -> int:
        return len(self.counts)


def count_structures(model: SceneModel, derivation: Derivation) -> StructureCounts:
    """The counts of derivations of a model's grammar."""
    kind = model.grammar.kind
    every = derivation.counts(len(model.grammar.kinds))
    children = {(a, b): per_parent(derivation, kind(a), kind(b)) for a, b in relations(model.grammar)}
    return StructureCounts(every[:, [kind(name) for name in model.classes]].numpy(), children)


def sample_counts(
    model: SceneModel, policy: Policy, num: int, seed: int, callback: Callable[[int], None] | None = None
) -> StructureCounts:
    """The counts of ``num`` structures that a policy derives; nothing is rendered. The same for the same seed.

    Args:
        callback: called with the number of structures of each batch.
    """
    parts = []
    for number, first in enumerate(range(0, num, BATCH_SIZE)):
        size = min(BATCH_SIZE, num - first)
        with threads(1), chunk_randomness(seed, number):
            derivation, _ = derive_complete(model.grammar, policy, size, model.max_steps)
        parts.append(count_structures(model, derivation))
        if callback is not None:
            callback(size)
    return concatenate(parts)


def concatenate(parts: list[StructureCounts]) -> StructureCounts:
    """All scenes of several batches, one batch after the other."""
    first = np.cumsum([0, *(len(part) for part in parts)])
    children = {}
    for relation in parts[0].children:
        batches = [part.children[relation] for part in parts]
        scene = torch.cat([found.scene + int(start) for found, start in zip(batches, first, strict=False)])
        children[relation] = PerParent(
            scene, *(torch.cat(x) for x in zip(*(found[1:] for found in batches), strict=True))
        )
    return StructureCounts(np.concatenate([part.counts for part in parts]), children)


def tallies(found: PerParent, weight: NDArray[np.float32]) -> dict[str, Tally]:
    """Tallies of one relation, by ``GROUPS``.

    Args:
        weight: ``(R, N)`` resamples of the scenes.
    """
    scene, rank, count = (x.numpy() for x in found)
    masks = {ALL: rank >= 0} | {name: rank == i for i, name in enumerate(RANKS)}
    masks |= {LATER: rank >= len(RANKS), OTHERS: rank >= 1}
    out = {PARENTS: tally_images(np.bincount(scene, minlength=weight.shape[1]), weight)}
    return out | {name: tally(count[mask], scene[mask], weight) for name, mask in masks.items()}


def group_label(relation: Relation, group: str) -> str:
    """A group of a relation in words."""
    parent, child = relation
    words = {
        PARENTS: f"{parent} per image",
        ALL: f"{child} per {parent}",
        OTHERS: f"{child} per {parent} but the first",
    }
    return words.get(group, f"{child} per {group} {parent}")
