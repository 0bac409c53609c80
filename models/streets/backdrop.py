"""What closes the view at the end of a street: a wall of trees or of roofs, far off, that has no label.

Roads bend and cities go on, so a real frame shows little horizon. Axis letters: P columns of a wall.
"""

from functools import cache

import numpy as np
import torch
from torch import Tensor

from probscene.mesh import Mesh
from probscene.world import Meshes

from ..assets.textures import bricks, leaves
from .nodes import Nodes

WIDTH, WIDER = 198.0, 2.2  # metres of a wall's mesh, and by how much it is widened
BEHIND = 15.0  # metres between the middle of the last thing and the wall
WALLS = {"city": (4, 5, 2), "suburban": (0, 1, 2, 3, 4), "rural": (0, 1, 2, 3)}


def backdrop(nodes: Nodes, farthest: Tensor) -> Meshes:
    """One wall across the end of the street, behind what stands farthest, ``(N, 1)`` metres."""
    options = torch.tensor(WALLS[nodes.scenario])
    share = nodes.only("street", "end")
    which = options[(share * len(options)).long().clamp(max=len(options) - 1)]
    there = torch.ones_like(which, dtype=torch.bool)
    scale = torch.tensor([1.0, WIDER, 1.0])
    x = torch.maximum(nodes.only("street", "view"), farthest + BEHIND)
    return Meshes((), walls(), which, x, 0.0, scale=scale.expand(*which.shape, 3), present=there)


@cache
def walls() -> tuple[Mesh, ...]:
    """Four of trees, two of roofs."""
    return (*(_trees(seed) for seed in range(4)), *(_roofs(seed) for seed in range(2)))


def _trees(seed: int) -> Mesh:
    """Round crowns side by side."""
    rng = np.random.default_rng(seed)
    y = np.linspace(-WIDTH / 2, WIDTH / 2, 265)
    middle = np.cumsum(rng.uniform(0.8, 2.4, 160)) - WIDTH / 2
    size, height = rng.uniform(1.1, 2.6, 160), rng.uniform(5.0, 12.0, 160) * np.repeat(rng.uniform(0.6, 1.3, 16), 10)
    away = (y[:, None] - middle) / size
    top = (height * np.clip(1 - away**4, 0, 1) ** 0.25).max(1)
    return _wall(y, np.maximum(top, 2.5), (84, 102, 60), leaves(seed, 256), 9.0)


def _roofs(seed: int) -> Mesh:
    """Steps of eaves and ridges."""
    rng = np.random.default_rng([seed, 1])
    y, top = [], []
    at = -WIDTH / 2
    while at < WIDTH / 2:
        end = min(at + rng.uniform(8.0, 20.0), WIDTH / 2)
        eaves, ridge = rng.uniform(8.0, 17.0), rng.choice([0.0, 3.0])
        y += [at, at + 0.3 * (end - at), at + 0.7 * (end - at), end]
        top += [eaves, eaves + ridge, eaves + ridge, eaves]
        at = end
    return _wall(np.array(y), np.array(top), (188, 174, 156), bricks(seed), 24.0)


def _wall(y: np.ndarray, top: np.ndarray, colour, texture: np.ndarray, tile: float) -> Mesh:
    """Upright, facing the camera, its top along ``y, top (P,)``."""
    P = len(y)
    low, high = np.stack([0 * y, y, 0 * y], 1), np.stack([0 * y, y, top], 1)
    positions = np.concatenate([low, high])
    k = np.arange(P - 1)[np.diff(y) > 0]
    faces = np.concatenate([np.stack([k + 1, k, P + k], 1), np.stack([k + 1, P + k, P + k + 1], 1)])
    uv = np.stack([-positions[:, 1] * WIDER / tile, -positions[:, 2] / tile], 1)
    return Mesh(positions, faces, colour, np.zeros(len(faces), bool), uv=uv[faces], texture=texture)
