"""A cache of features of renders, by the counts of their scenes.

A fit has tens of thousands of scenes rendered, most of them with counts that were rendered before. Where rendering is
slow, features of a few renders of each counts are enough: layout and looks are noise that scenes of equal counts may
share. The more a guide knows, the fewer of its counts are new.

Axis letters: N scenes, D features, R renders, C counts.
"""

from collections.abc import Callable

import torch
from torch import Tensor

from probscene.derivation import Derivation, group_of
from probscene.model import SceneModel
from probscene.sampling import Scenes


class RenderCache:
    """Features of a fit's renders, by the counts of their scenes: of all kinds, and of each group where a model has
    groups.

    Args:
        model: the scene model.
        renders_per_key: renders of the same counts from which on one of them, at random, stands for a new one.

    Attributes:
        rendered: scenes that were rendered, R.
        requested: scenes whose features were requested.
    """

    def __init__(self, model: SceneModel, renders_per_key: int):
        self.model, self.renders_per_key, self.requested = model, renders_per_key, 0
        self._rows: dict[bytes, list[int]] = {}
        self._counts: list[Tensor] = []
        self._features: list[Tensor] = []

    @property
    def rendered(self) -> int:
        return len(self._features)

    def wrap(self, embed: Callable[[Scenes], Tensor]) -> Callable[[Scenes], Tensor]:
        """``embed``, called only for scenes of whose counts there are not enough renders."""

        def features(scenes: Scenes) -> Tensor:
            counts = self._counts_of(scenes.derivation)
            row = torch.tensor([self._lookup(key) for key in counts])
            new = row < 0
            if new.any():
                row[new] = torch.arange(self.rendered, self.rendered + int(new.sum()))
                self._add(counts[new], embed(scenes.select(new)))
            self.requested += len(row)
            return torch.stack([self._features[index] for index in row])

        return features

    def state(self) -> dict[str, Tensor]:
        """All renders, ``(R, C)`` and ``(R, D)``, and how many scenes were requested; empty where there are none."""
        if not self._features:
            return {}
        return {
            "counts": torch.stack(self._counts),
            "features": torch.stack(self._features),
            "asked": torch.tensor(self.requested),
        }

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Go on from a ``state``."""
        self.requested = 0
        for part in (self._rows, self._counts, self._features):
            part.clear()
        if tensors:
            self._add(tensors["counts"], tensors["features"])
            self.requested = int(tensors["asked"])

    def _lookup(self, counts: Tensor) -> int:
        """A render of these counts; -1 where there are not enough."""
        rows = self._rows.get(counts.numpy().tobytes(), [])
        return rows[int(torch.randint(len(rows), ()))] if len(rows) >= self.renders_per_key else -1

    def _add(self, counts: Tensor, features: Tensor) -> None:
        for key, feature in zip(counts, features, strict=True):
            self._rows.setdefault(key.numpy().tobytes(), []).append(self.rendered)
            self._counts.append(key)
            self._features.append(feature)

    def _counts_of(self, derivation: Derivation) -> Tensor:
        """``(N, C)`` int16."""
        kinds, groups, kind = len(self.model.grammar.kinds), self.model.groups, derivation.kind
        scene_counts = derivation.counts(kinds)
        if groups is None:
            return scene_counts.to(torch.int16)
        group_kind = self.model.grammar.kind(groups.kind)
        group = group_of(kind, derivation.parent, group_kind)
        rank = ((kind == group_kind).cumsum(1) - 1).gather(1, group.clamp(min=0)).clamp(max=groups.max_groups - 1)
        inside = (group >= 0) & (kind >= 0)
        group_counts = torch.zeros(len(kind), groups.max_groups * kinds, dtype=scene_counts.dtype)
        group_counts.scatter_add_(1, (rank * kinds + kind).where(inside, 0), inside.to(scene_counts.dtype))
        return torch.cat([scene_counts, group_counts], 1).to(torch.int16)
