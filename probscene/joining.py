"""One drawing out of those of several programs, each of which drew some of the scenes.

Axis letters: N scenes, M nodes, S strips of ground.
"""

from dataclasses import fields, replace
from typing import TypeVar

import torch
from torch import Tensor
from torch.nn.functional import pad

from .camera_effects import CameraEffects
from .drawing import Drawing, Layer
from .errors import ModelError
from .request import Renderable, Request, Values
from .world import Ground, MeshLayer, Part, World, resolve_scene

AnyLayer = TypeVar("AnyLayer", Layer, MeshLayer)


def join_drawings(kind: Tensor, kinds: tuple[str, ...], drawn: list[tuple[Tensor, Renderable]]) -> Renderable:
    """The drawing whose scene i comes from the drawing that owns it.

    Args:
        kind: ``(N, M)`` of the joint scenes, index into ``kinds``.
        drawn: pairs of ``own (N,)`` bool, disjoint and together all scenes, and a drawing of N scenes.

    Raises:
        ModelError: drawings in 2D and worlds in 3D, or backgrounds that differ.
    """
    drawings = [(own, drawing) for own, drawing in drawn if isinstance(drawing, Drawing)]
    worlds = [(own, world) for own, world in drawn if isinstance(world, World)]
    if len(drawings) == len(drawn):
        backgrounds = {(red, green, blue) for _, drawing in drawings for red, green, blue in [drawing.background]}
        if len(backgrounds) > 1:
            raise ModelError(f"expected scenarios with one background, got {sorted(backgrounds)}; draw it as a layer.")
        layers = _layers(kind, [(own, drawing.kind.shape[1], drawing.layers) for own, drawing in drawings])
        return Drawing(kind, kinds, layers, backgrounds.pop(), _photo([(own, d.photo) for own, d in drawings]))
    requests = [(own, request) for own, request in drawn if isinstance(request, Request)]
    if len(requests) == len(drawn):
        return _request(kind, kinds, requests)
    if len(worlds) != len(drawn):
        raise ModelError(
            "expected scenarios that all draw sprites, or all build worlds, or all request images of a generator, "
            "got several of these; join those alike."
        )
    return World(
        kind,
        kinds,
        _layers(kind, [(own, world.kind.shape[1], world.layers) for own, world in worlds]),
        _chosen([(own, world.camera) for own, world in worlds]),
        _chosen([(own, world.light) for own, world in worlds]),
        _ground([(own, world.ground) for own, world in worlds]),
        _chosen([(own, world.photo) for own, world in worlds]),
    )


def _request(kind: Tensor, kinds: tuple[str, ...], parts: list[tuple[Tensor, Request]]) -> Request:
    """All values, each present only in its own scenes."""
    M, objects, scene = kind.shape[1], [], []
    for own, part in parts:
        own = own.unsqueeze(1)
        for some in part.objects:
            values = {key: _as_wide(value, M) for key, value in some.values.items()}
            objects.append(Values(_as_wide(some.present & own, M), values))
        scene += [Values(some.present & own, some.values) for some in part.scene]
    parent = _rows([(own, _as_wide(part.parent, M)) for own, part in parts])
    seed, photo = _rows([(own, part.seed) for own, part in parts]), _photo([(own, part.photo) for own, part in parts])
    return Request(kind, kinds, parent, seed, tuple(objects), tuple(scene), photo)


def _layers(kind: Tensor, drawn: list[tuple[Tensor, int, tuple[AnyLayer, ...]]]) -> tuple[AnyLayer, ...]:
    """All layers, each present only in its own scenes; those of M own nodes as wide as the joint nodes."""
    found = []
    for own, M, layers in drawn:
        for layer in layers:
            present = layer.present & own.unsqueeze(1)
            of_nodes = layer.labelled or layer.present.shape[1] == M
            values = {key: value for key, value in vars(layer).items() if isinstance(value, Tensor)}
            values["present"] = present
            if of_nodes:
                values = {key: _as_wide(value, kind.shape[1]) for key, value in values.items()}
            found.append(replace(layer, **values))
    return tuple(found)


def _as_wide(value: Tensor, M: int) -> Tensor:
    """``(N, m, ...)`` with M columns: cut, or padded with zeros. An own scene's nodes are never cut."""
    value = value[:, :M]
    return pad(value, (0, 0) * (value.ndim - 2) + (0, M - value.shape[1])).contiguous()


def _chosen(parts: list[tuple[Tensor, Part]]) -> Part:
    """Every tensor of a dataclass, scene by scene from the part that owns it."""
    names = [field.name for field in fields(parts[0][1])]
    return type(parts[0][1])(**{name: _rows([(own, getattr(part, name)) for own, part in parts]) for name in names})


def _photo(parts: list[tuple[Tensor, CameraEffects | None]]) -> CameraEffects | None:
    """Scenarios without a photo keep their images as they are among others with one."""
    if all(photo is None for _, photo in parts):
        return None
    return _chosen(
        [(own, resolve_scene(CameraEffects(), len(own)) if photo is None else photo) for own, photo in parts]
    )


def _ground(parts: list[tuple[Tensor, Ground | None]]) -> Ground | None:
    """Grounds with as many strips as the one that has most; strips are added that have no width."""
    grounds = [(own, ground) for own, ground in parts if ground is not None]
    if not grounds:
        return None
    if len(grounds) < len(parts):
        raise ModelError("expected scenarios that all have a ground, or none, got both; give every scenario one.")
    strips = max(ground.surface.shape[1] for _, ground in grounds)
    surfaces, wide = (), []
    for own, ground in grounds:
        more = strips - ground.surface.shape[1]
        surface = torch.cat([ground.surface, ground.surface[:, -1:].expand(-1, more)], 1) + len(surfaces)
        last = ground.edges[:, -1:] if ground.edges.shape[1] else torch.zeros(len(own), 1)
        edges = torch.cat([ground.edges, last.expand(-1, more)], 1)
        wide.append((own, replace(ground, surfaces=(), edges=edges, surface=surface)))
        surfaces += ground.surfaces
    edges, surface, offset = (
        _rows([(own, getattr(g, key)) for own, g in wide]) for key in ("edges", "surface", "offset")
    )
    return Ground(surfaces, edges, surface, offset)


def _rows(values: list[tuple[Tensor, Tensor]]) -> Tensor:
    """Tensors of one shape, scene by scene from the one that owns it."""
    _, whole = values[0]
    for own, value in values[1:]:
        whole = torch.where(own.view(-1, *[1] * (value.ndim - 1)), value, whole)
    return whole
