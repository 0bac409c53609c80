"""Masks of whole objects, as if nothing hid them: each object is drawn in a scene of its own.

Axis letters: N scenes, M nodes, H W, K objects.
"""

from collections.abc import Iterator
from dataclasses import replace

import torch
from torch import Tensor

from probscene.batch import RenderBatch, Renderer
from probscene.camera_effects import CameraEffects
from probscene.drawing import Drawing
from probscene.errors import ProbsceneError
from probscene.model import SceneModel
from probscene.request import Renderable, Request
from probscene.world import World, resolve_scene

from ..chunks import CHUNK


def drawable(model: SceneModel, drawing: Renderable) -> Drawing | World:
    """The drawing, where its objects can be drawn alone.

    Raises:
        ProbsceneError: its generator draws whole scenes.
    """
    if isinstance(drawing, Request):
        raise ProbsceneError(
            f"expected a model of sprites or meshes for amodal masks, got {model.name!r}, whose generator draws "
            "whole scenes; leave amodal out."
        )
    return drawing


def masks(
    render: Renderer, drawing: Drawing | World, batch: RenderBatch, category: Tensor
) -> Iterator[tuple[int, int, Tensor]]:
    """Of every object its scene, its node and its mask within the image, ``(H, W)`` bool.

    What is wholly visible is not drawn again.

    Args:
        batch: the render of ``drawing``.
        category: ``(N, M)``, above 0 at the objects.
    """
    labels = getattr(render, "labels", render)
    for some in category.nonzero().split(CHUNK):
        scene, node = some.unbind(1)
        ids = (node + 1).view(-1, 1, 1)
        found = batch.instance[scene] == ids
        hidden = torch.full_like(node, True, dtype=torch.bool)
        if "visible" not in batch.unknown:
            hidden = batch.visible[scene, node] < 1
        if hidden.any():
            found[hidden] = labels(alone(drawing, scene[hidden], node[hidden])).instance == ids[hidden]
        yield from zip(scene.tolist(), node.tolist(), found, strict=True)


def alone(drawing: Drawing | World, scene: Tensor, node: Tensor) -> Drawing | World:
    """K scenes, number k scene ``scene[k]`` with its node ``node[k]`` and nothing else; ``scene, node (K,)`` int64."""
    labelled = tuple(layer for layer in drawing.layers if layer.labelled)
    some = replace(drawing, layers=labelled)[scene]
    chosen = torch.arange(drawing.kind.shape[1]) == node[:, None]
    layers = tuple(replace(layer, present=layer.present & chosen) for layer in some.layers)
    if isinstance(some, World):
        return replace(some, layers=layers, ground=None, photo=resolve_scene(CameraEffects(), len(some)))
    return replace(some, layers=layers, photo=None)
