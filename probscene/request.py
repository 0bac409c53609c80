"""Scenes that somebody else draws: what a model's program asks of its generator, beside ``Drawing`` and ``World``.

Axis letters: N scenes, M nodes.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from .camera_effects import CameraEffects
from .drawing import Drawing, select_scenes
from .errors import ModelError
from .world import World


class Objects:
    """Values of every node of the named kinds, for ``scene.request``.

    Args:
        kinds: the kinds of node, a name or several.
        values: by the name under which a generator finds them: numbers, or tensors that broadcast to ``(N, M)``, or to
            ``(N, M, k)`` for lists of k numbers. Of nodes of other kinds they are not looked at.
    """

    def __init__(self, kinds: str | tuple[str, ...], /, **values: Any):
        self.kinds, self.values = kinds, values


@dataclass(frozen=True, eq=False)
class Values:
    """Named values, resolved on a batch of scenes.

    Attributes:
        present: ``(N, M)`` bool, which nodes have them; ``(N, 1)`` for those of scenes.
        values: each ``(N, M)`` or ``(N, M, k)``; ``(N, 1)`` or ``(N, 1, k)`` of scenes.
    """

    present: Tensor
    values: dict[str, Tensor]

    def select(self, scenes: slice | Tensor) -> "Values":
        """The values of some scenes."""
        return Values(self.present[scenes], {key: value[scenes] for key, value in self.values.items()})


@dataclass(frozen=True, eq=False)
class Request:
    """A batch of scenes for a generator; ``scene.request`` makes it.

    Attributes:
        kind: ``(N, M)`` int64, index into ``kinds``; -1 pads.
        kinds: the grammar's object names.
        parent: ``(N, M)`` int64 node index, -1 for none.
        seed: ``(N,)`` int64, 0 to 2**31 - 1.
        objects: values of nodes.
        scene: values of scenes.
        photo: what a camera makes of the images, every value ``(N,)``; nothing where None.
    """

    kind: Tensor
    kinds: tuple[str, ...]
    parent: Tensor
    seed: Tensor
    objects: tuple[Values, ...]
    scene: tuple[Values, ...]
    photo: CameraEffects | None = None

    def __len__(self) -> int:
        return self.kind.shape[0]

    def __getitem__(self, scenes: slice | Tensor) -> "Request":
        """The same request of some of the scenes."""
        return replace(
            self,
            kind=self.kind[scenes],
            parent=self.parent[scenes],
            seed=self.seed[scenes],
            objects=tuple(some.select(scenes) for some in self.objects),
            scene=tuple(some.select(scenes) for some in self.scene),
            photo=select_scenes(self.photo, scenes),
        )

    def records(self, canvas: tuple[int, int]) -> list[dict[str, Any]]:
        """Each scene as it goes to a generator, see ``scene_of`` in probscene.worker."""
        objects, scene = [_rows(some) for some in self.objects], [_rows(some) for some in self.scene]
        found = []
        for i, (kinds, parents) in enumerate(zip(self.kind.tolist(), self.parent.tolist(), strict=True)):
            nodes = [
                {
                    "id": m + 1,
                    "kind": self.kinds[kind],
                    "parent": parents[m] + 1 or None,
                    "values": _at(objects, i, m),
                }
                for m, kind in enumerate(kinds)
                if kind >= 0
            ]
            record = {"height": canvas[0], "width": canvas[1], "seed": int(self.seed[i])}
            found.append(record | {"values": _at(scene, i, 0), "nodes": nodes})
        return found


Renderable = Drawing | World | Request
"""What a model's program returns."""


def resolve_values(what: str, values: Mapping[str, Any], present: Tensor) -> Values:
    """Broadcast values to ``present (N, M)``.

    Args:
        what: they are of, in words.

    Raises:
        ModelError: a value that is no number, does not broadcast, or is not finite where it is asked for.
    """
    found = {}
    for name, given in values.items():
        try:
            value = torch.as_tensor(given).detach()
        except (TypeError, ValueError, RuntimeError):
            raise ModelError(
                f"expected {name} of {what} as a number or a tensor, got {given!r}; a generator is sent the values "
                "of sites, such as x = pyro.sample(...)."
            ) from None
        try:
            value = value.expand(*present.shape, *value.shape[2:])
        except RuntimeError:
            raise ModelError(
                f"expected {name} of {what} to broadcast to (scenes, nodes) = {tuple(present.shape)}, with one more "
                f"axis for a list of numbers, got shape {tuple(value.shape)}."
            ) from None
        if value.ndim > 3 or (value.is_floating_point() and not torch.isfinite(value[present]).all()):
            fault = f"shape {tuple(value.shape)}" if value.ndim > 3 else "NaN or infinity"
            raise ModelError(f"expected {name} of {what} as finite numbers or lists of them, got {fault}.")
        found[name] = value
    return Values(present, found)


def _rows(values: Values) -> tuple[list, dict[str, list]]:
    return values.present.tolist(), {name: value.tolist() for name, value in values.values.items()}


def _at(layers: list[tuple[list, dict[str, list]]], scene: int, node: int) -> dict[str, Any]:
    found = {}
    for present, values in layers:
        if present[scene][node]:
            found |= {name: rows[scene][node] for name, rows in values.items()}
    return found
