"""Features of renders that are taken again for other scenes of equal counts.

A fit has tens of thousands of scenes rendered, most of them with counts that were rendered before. Where rendering is
slow, features of a few renders of each are enough: what a feature network says goes by what is there, and the rest,
layout and looks, is noise that a scene may share with another. The more a guide knows, the fewer counts are new.

Axis letters: N scenes, D features, R renders, C counts.
"""

from collections.abc import Callable

import torch
from torch import Tensor

from probscene.derivation import Derivation, group_of
from probscene.model import SceneModel
from probscene.sampling import Scenes


class RenderCache:
    """Renders of a fit, by the counts of their scenes: of all kinds, and of each group where a model has groups.

    Args:
        model: the scene model.
        least: so many renders of the same counts before one of them, at random, is taken again.

    Attributes:
        drawn: scenes that were rendered.
        asked: scenes that were looked at.
    """

    def __init__(self, model: SceneModel, least: int):
        self.model, self.least, self.asked = model, least, 0
        self._rows: dict[bytes, list[int]] = {}
        self._counts: list[Tensor] = []
        self._features: list[Tensor] = []

    @property
    def drawn(self) -> int:
        return len(self._features)

    def around(self, observe: Callable[[Scenes], Tensor]) -> Callable[[Scenes], Tensor]:
        """``observe``, called only for scenes of whose counts there are not enough renders."""

        def features(scenes: Scenes) -> Tensor:
            counts = self._counts_of(scenes.derivation)
            row = torch.tensor([self._known(each) for each in counts])
            new = row < 0
            if new.any():
                row[new] = torch.arange(self.drawn, self.drawn + int(new.sum()))
                self._keep(counts[new], observe(scenes.select(new)))
            self.asked += len(row)
            return torch.stack([self._features[each] for each in row])

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
        self.asked = 0
        for kept in (self._rows, self._counts, self._features):
            kept.clear()
        if tensors:
            self._keep(tensors["counts"], tensors["features"])
            self.asked = int(tensors["asked"])

    def _known(self, counts: Tensor) -> int:
        """A render of these counts; -1 where there are not enough."""
        rows = self._rows.get(counts.numpy().tobytes(), [])
        return rows[int(torch.randint(len(rows), ()))] if len(rows) >= self.least else -1

    def _keep(self, counts: Tensor, features: Tensor) -> None:
        for each, feature in zip(counts, features, strict=True):
            self._rows.setdefault(each.numpy().tobytes(), []).append(self.drawn)
            self._counts.append(each)
            self._features.append(feature)

    def _counts_of(self, derivation: Derivation) -> Tensor:
        """``(N, C)`` int16."""
        kinds, groups, kind = len(self.model.grammar.kinds), self.model.groups, derivation.kind
        whole = derivation.counts(kinds)
        if groups is None:
            return whole.to(torch.int16)
        group_kind = self.model.grammar.kind(groups.kind)
        group = group_of(kind, derivation.parent, group_kind)
        rank = ((kind == group_kind).cumsum(1) - 1).gather(1, group.clamp(min=0)).clamp(max=groups.max_groups - 1)
        inside = (group >= 0) & (kind >= 0)
        each = torch.zeros(len(kind), groups.max_groups * kinds, dtype=whole.dtype)
        each.scatter_add_(1, (rank * kinds + kind).where(inside, 0), inside.to(whole.dtype))
        return torch.cat([whole, each], 1).to(torch.int16)
