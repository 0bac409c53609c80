"""Counts that depend on context, as tallies: how many children a node has, over all nodes and by rank.

The rank of a node is the number of nodes of its kind before it below the same parent: the first road, the second. Axis
letters: N scenes, P nodes.
"""

import numpy as np
from numpy.typing import NDArray

from probscene.app.structures import Relation
from probscene.inference.tally import Tally, tally, tally_images
from probscene.relations import PerParent

RANKS = ("first", "second", "third", "fourth", "fifth")
PARENTS, ALL, OTHERS, LATER = "parents", "all", "others", "later"
GROUPS = (PARENTS, ALL, *RANKS, LATER, OTHERS)
"""What is tallied of a relation: parents an image; children of every parent, of the one of each rank, of those of
higher ranks together, and of all but the first."""


def tallies(found: PerParent, weight: NDArray[np.float32]) -> dict[str, Tally]:
    """Tallies of one relation, by ``GROUPS``.

    Args:
        weight: ``(R, N)`` resamples of the scenes.
    """
    scene, rank, count = (x.numpy() for x in found)
    chosen = {ALL: rank >= 0} | {name: rank == i for i, name in enumerate(RANKS)}
    chosen |= {LATER: rank >= len(RANKS), OTHERS: rank >= 1}
    out = {PARENTS: tally_images(np.bincount(scene, minlength=weight.shape[1]), weight)}
    return out | {name: tally(count[mask], scene[mask], weight) for name, mask in chosen.items()}


def label(relation: Relation, group: str) -> str:
    """A group of a relation in words."""
    parent, child = relation
    words = {
        PARENTS: f"{parent} per image",
        ALL: f"{child} per {parent}",
        OTHERS: f"{child} per {parent} but the first",
    }
    return words.get(group, f"{child} per {group} {parent}")
