"""Features of renders that are taken again for other scenes of equal counts.

A fit has tens of thousands of scenes rendered, most of them with counts that were rendered before. Where rendering is
slow, features of a few renders of each are enough: what a feature network says goes by what is there, and the rest,
layout and looks, is noise that a scene may share with another. The more a guide knows, the fewer counts are new.

Axis letters: N scenes, D features, R renders, C counts.
"""

from collections.abc import Callable

import torch
from torch import Tensor

from probscene.derivation import Derivation
from probscene.model import SceneModel
from probscene.sampling import Scenes

from .features.counting.grouping import group_of


class RenderPool:
    """Renders of a fit, by the counts of their scenes: of all kinds, and of each group where a model has groups.

    Args:
        model: the scene model.
        least: so many renders of the same counts before one of them, at random, is taken again.

    Attributes:
        drawn: scenes that were rendered.
        asked: scenes that were looked at.
    """

    def __init__(self, model: SceneModel, least: int):
        self.model, self.least, self.drawn, self.asked = model, least, 0, 0
        self._rows: dict[bytes, list[int]] = {}
        self._counts: list[Tensor] = []
        self._features: list[Tensor] = []

    def around(self, observe: Callable[[Scenes], Tensor]) -> Callable[[Scenes], Tensor]:
        """``observe``, called only for scenes of whose counts there are not enough renders."""

        def features(scenes: Scenes) -> Tensor:
            counts = self._counts_of(scenes.derivation)
            found: list[int] = []
            for row in counts:
                known = self._rows.get(row.numpy().tobytes(), [])
                enough = len(known) >= self.least
                found.append(known[int(torch.randint(len(known), ()))] if enough else -1)
            new = torch.tensor([row < 0 for row in found], dtype=torch.bool)
            made = observe(scenes.some(new)) if new.any() else None
            if made is not None:
                found = self._with(found, counts, made)
            self.asked += len(found)
            return torch.stack([self._features[row] for row in found])

        return features

    def state(self) -> dict[str, Tensor]:
        """All renders, ``(R, C)`` and ``(R, D)``, and how many scenes were looked at; nothing where there are none."""
        if not self._features:
            return {}
        return {
            "counts": torch.stack(self._counts),
            "features": torch.stack(self._features),
            "asked": torch.tensor(self.asked),
        }

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Go on from a ``state``."""
        self.__init__(self.model, self.least)
        if tensors:
            self._keep(tensors["counts"], tensors["features"])
            self.asked = int(tensors["asked"])

    def _with(self, found: list[int], counts: Tensor, made: Tensor) -> list[int]:
        rows = iter(range(len(self._features), len(self._features) + len(made)))
        found = [next(rows) if row < 0 else row for row in found]
        first = len(self._features)
        self._keep(counts[torch.tensor([row >= first for row in found])], made)
        return found

    def _keep(self, counts: Tensor, features: Tensor) -> None:
        for row, feature in zip(counts, features, strict=True):
            self._rows.setdefault(row.numpy().tobytes(), []).append(len(self._features))
            self._counts.append(row)
            self._features.append(feature)
        self.drawn += len(features)

    def _counts_of(self, derivation: Derivation) -> Tensor:
        """``(N, C)`` int16."""
        kinds, groups, kind = len(self.model.grammar.kinds), self.model.groups, derivation.kind
        whole = derivation.counts(kinds)
        if groups is None:
            return whole.to(torch.int16)
        is_group = kind == self.model.grammar.kind(groups.kind)
        group = group_of(kind, derivation.parent, self.model.grammar.kind(groups.kind))
        rank = (is_group.cumsum(1) - 1).gather(1, group.clamp(min=0)).clamp(max=groups.max_groups - 1)
        inside = (group >= 0) & (kind >= 0)
        each = torch.zeros(len(kind), groups.max_groups * kinds, dtype=whole.dtype)
        each.scatter_add_(1, (rank * kinds + kind).where(inside, 0), inside.to(whole.dtype))
        return torch.cat([whole, each], 1).to(torch.int16)
