"""What a run's feature network counts in images: an estimate of the truth that needs no label, and no truth.

The counts are read from the features by name: a class's own, or its counts in each group (``"car 1"``, ``"car 2"``),
which are counts of the group's children in the order of the model's ``Groups``. Axis letters: L images, D features, C
classes.
"""

import re

import numpy as np
import torch
from torch import Tensor

from probscene.model import SceneModel
from probscene.relations import PerParent, relations

from .structure_counts import Counts, Relation


def estimate_counts(
    model: SceneModel, names: tuple[str, ...], features: Tensor
) -> tuple[Counts, Counts, dict[Relation, PerParent]] | None:
    """Rounded counts ``(L, C)``, total ``(L,)``, and children of each group; None if the features are no counts.

    Args:
        names: of the features.
        features: ``(L, D)``.
    """
    column = dict(zip(names, features.round().clamp(min=0).long().numpy().T, strict=True))
    parts = {name: [name] if name in column else _numbered(names, name) for name in model.classes}
    if not all(parts.values()):
        return None
    counts = np.stack([sum(column[part] for part in parts[name]) for name in model.classes], 1)
    total = column["total"] if "total" in column else counts.sum(1)
    groups, children = model.groups, {}
    for parent, child in relations(model.grammar):
        if groups is not None and parent == groups.kind and child in parts and parent in column:
            each = np.stack([column[part] for part in parts[child]], 1)
            children[parent, child] = _children(np.minimum(column[parent], each.shape[1]), each)
    return counts, total, children


def class_counts(model: SceneModel, names: tuple[str, ...], features: Tensor) -> Tensor | None:
    """Counts ``(L, c)`` as they were read, not rounded, of the c classes that features count; None if they count none.

    Args:
        names: of the features.
        features: ``(L, D)``, objects.
    """
    column = dict(zip(names, features.T, strict=True))
    parts = [[name] if name in column else _numbered(names, name) for name in model.classes]
    found = [torch.stack([column[part] for part in each]).sum(0) for each in parts if each]
    return torch.stack(found, 1) if found else None


def counted_classes(model: SceneModel, names: tuple[str, ...]) -> tuple[str, ...]:
    """The classes that features of these names count, the columns of ``class_counts``."""
    return tuple(name for name in model.classes if name in names or _numbered(names, name))


def _numbered(names: tuple[str, ...], name: str) -> list[str]:
    return [each for each in names if re.fullmatch(rf"{re.escape(name)} \d+", each)]


def _children(number: Counts, each: Counts) -> PerParent:
    """Of the first ``number (L,)`` groups in ``each (L, G)``."""
    scene, rank = (np.arange(each.shape[1]) < number[:, None]).nonzero()
    return PerParent(*map(torch.from_numpy, (scene, rank, each[scene, rank])))
