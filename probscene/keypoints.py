"""Keypoints of a drawing's nodes, and whether they are seen. Axis letters: N scenes, M nodes, K keypoints, P points."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from .drawing import Drawing, Layer
from .request import Renderable

OUTSIDE, HIDDEN, VISIBLE = 0, 1, 2
_PAIRS = 1 << 20  # of points and sprites, at once


@dataclass(frozen=True, eq=False)
class Keypoints:
    """Where the keypoints of nodes are.

    Attributes:
        names: of the keypoints, by kind; a kind without keypoints is not in it.
        kind: ``(N, M)`` int64, the drawing's.
        points: ``(N, M, K, 3)`` float64, x and y in pixels of the canvas as of ``Drawing``, and COCO's visibility:
            2 seen, 1 behind another object, 0 outside the canvas or not drawn, where x and y are 0, too. Those of a
            node are in the order of its kind's names; K is the largest number of them.
    """

    names: dict[str, tuple[str, ...]]
    kind: Tensor
    points: Tensor


def keypoints(drawing: Renderable, canvas: tuple[int, int]) -> Keypoints | None:
    """What the sprites of a drawing name, see ``Sprites``; None where they name nothing, as in worlds and requests.

    A keypoint is hidden where a sprite that is drawn later has an alpha of at least one half, unless that sprite has
    the same node's label. Where several layers of a node name the same keypoint, the first counts.

    Args:
        canvas: height and width, pixels.
    """
    if not isinstance(drawing, Drawing):
        return None
    names: dict[str, tuple[str, ...]] = {}
    for layer in drawing.layers:
        for kind in () if layer.keypoints is None else layer.kinds:
            names[kind] = tuple(dict.fromkeys((*names.get(kind, ()), *layer.keypoint_names)))
    if not names:
        return None
    points = torch.zeros(*drawing.kind.shape, max(map(len, names.values())), 3, dtype=torch.float64)
    named = torch.zeros(points.shape[:3], dtype=torch.bool)
    for number, layer in enumerate(drawing.layers):
        if layer.keypoints is None:
            continue
        for kind in layer.kinds:
            scene, node = (layer.present & (drawing.kind == drawing.kinds.index(kind))).nonzero().T
            for k, name in enumerate(layer.keypoint_names):
                place = names[kind].index(name)
                new = ~named[scene, node, place]
                n, m = scene[new], node[new]
                named[n, m, place] = True
                points[n, m, place] = _seen(drawing, canvas, number, n, m, layer.keypoints[n, m, k])
    return Keypoints(names, drawing.kind, points)


def _seen(drawing: Drawing, canvas: tuple[int, int], number: int, scene: Tensor, node: Tensor, at: Tensor) -> Tensor:
    """``(P, 3)`` points ``at (P, 2)`` of nodes that layer ``number`` draws, with their visibility."""
    inside = ((at >= 0) & (at < torch.tensor(canvas[::-1]))).all(1)
    hidden = torch.zeros(len(at), dtype=torch.bool)
    for i, layer in enumerate(drawing.layers[number:]):
        columns = torch.arange(layer.present.shape[1])
        for some in torch.arange(len(at)).split(max(1, _PAIRS // max(1, len(columns)))):
            covers = layer.present[scene[some]]
            if i == 0:
                covers = covers & (columns > node[some, None])
            elif layer.labelled:
                covers = covers & (columns != node[some, None])
            hidden[some] |= _opaque(layer, scene[some], at[some], covers)
    visibility = torch.where(hidden, HIDDEN, VISIBLE).double()
    return torch.where(inside[:, None], torch.cat([at, visibility[:, None]], 1), OUTSIDE)


def _opaque(layer: Layer, scene: Tensor, at: Tensor, covers: Tensor) -> Tensor:
    """``(P,)`` bool, whether one of the layer's sprites, of those in ``covers (P, M)``, is opaque at a point."""
    point, column = covers.nonzero().numpy().T
    row = scene.numpy()[point]

    def of(value: Tensor) -> np.ndarray:
        return value.numpy()[row, column].astype(np.float64)

    dx, dy = at.numpy()[point, 0] - of(layer.x), at.numpy()[point, 1] - of(layer.y)
    cos, sin = np.cos(of(layer.angle)), np.sin(of(layer.angle))
    right, down = (cos * dx - sin * dy) / of(layer.scale_x), (sin * dx + cos * dy) / of(layer.scale_y)
    sprite, found = layer.sprite.numpy()[row, column], torch.zeros(len(at), dtype=torch.bool)
    for index in np.unique(sprite):
        alpha = layer.atlas.sprites[index][..., 3]
        height, width = alpha.shape
        mine = np.flatnonzero(sprite == index)
        u, v = np.floor(right[mine] + width / 2).astype(np.int64), np.floor(down[mine] + height / 2).astype(np.int64)
        on = (u >= 0) & (u < width) & (v >= 0) & (v < height)
        mine, u, v = mine[on], u[on], v[on]
        found[point[mine[alpha[v, u] >= 128]]] = True
    return found
