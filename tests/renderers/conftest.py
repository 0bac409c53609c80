"""Meshes, ground and worlds for the tests of the mesh renderer."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from probscene.camera_effects import CameraEffects
from probscene.mesh import Mesh, Surface
from probscene.world import Camera, Ground, Light, Meshes, World, resolve_ground, resolve_meshes, resolve_scene

QUADS = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])


def box(length: float, width: float, height: float, colour=(255, 255, 255), **more) -> Mesh:
    """A cuboid on the ground, each side with the whole of a texture."""
    corners = [[x * length / 2, y * width / 2, z * height] for x in (-1, 1) for y in (-1, 1) for z in (0, 1)]
    triangles = np.concatenate([QUADS[:, [0, 1, 2]], QUADS[:, [0, 2, 3]]])
    uv = np.array([[[0, 1], [0, 0], [1, 0]]] * 6 + [[[0, 1], [1, 0], [1, 1]]] * 6)
    return Mesh(np.array(corners), triangles, colour, uv=uv, **more)


def cylinder(radius: float, height: float, sides: int = 12, colour=(255, 255, 255)) -> Mesh:
    """Upright, round to the light."""
    angle = np.arange(sides) * 2 * np.pi / sides
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    positions = [*(radius * ring), *(radius * ring + [0, 0, height]), [0, 0, 0], [0, 0, height]]
    triangles, normals = [], []
    for i in range(sides):
        j = (i + 1) % sides
        triangles += [(i, j, sides + j), (i, sides + j, sides + i), (2 * sides + 1, sides + i, sides + j)]
        triangles += [(2 * sides, j, i)]
        normals += [ring[[i, j, j]], ring[[i, j, i]], [[0, 0, 1]] * 3, [[0, 0, -1]] * 3]
    return Mesh(np.array(positions), np.array(triangles), colour, normals=np.array(normals))


def surface(name: str, colour, seed: int = 0, tile=(2.0, 3.0), size=(16, 24)) -> Surface:
    """Noise about a colour."""
    noise = np.random.default_rng(seed).normal(0, 20, (*size, 1))
    return Surface(name, np.clip(np.array(colour) + noise, 0, 255).astype(np.uint8), tile)


def world(
    *layers: Meshes, kinds=("car", "tree"), kind=None, camera=None, light=None, ground=None, photo=None, present=None
) -> World:
    """A world without a grammar: ``kind (N, M)``, zeros unless given; ``present`` of every layer without its own."""
    kind = torch.zeros(1, 1, dtype=torch.int64) if kind is None else kind
    number = len(kind)
    everything = torch.ones(kind.shape, dtype=torch.bool) if present is None else present
    resolved = [resolve_meshes(layer, everything if layer.present is None else layer.present) for layer in layers]
    parts = {"camera": camera or Camera(), "light": light or Light(), "photo": photo or CameraEffects()}
    parts = {name: resolve_scene(part, number) for name, part in parts.items()}
    ground = None if ground is None else resolve_ground(ground, number)
    return World(kind, kinds, tuple(resolved), ground=ground, **parts)


def road(**more) -> Ground:
    """Four strips of three surfaces, two of one class."""
    surfaces = surface("road", (90, 90, 95)), surface("grass", (80, 130, 60), 1), surface("road", (200, 200, 200), 2)
    return Ground(surfaces, torch.tensor([[-4.0, 0.0, 0.3]]), torch.tensor([[1, 0, 2, 0]]), **more)


def same(a, b) -> bool:
    """Whether two batches are equal to the byte."""
    space = zip(a.space, b.space, strict=True)
    equal = all(torch.equal(x, y) for x, y in zip(a[:7], b[:7], strict=True))
    return equal and all(torch.equal(x, y) if isinstance(x, torch.Tensor) else x == y for x, y in space)


@pytest.fixture(scope="session")
def shapes() -> SimpleNamespace:
    return SimpleNamespace(box=box, cylinder=cylinder, surface=surface, world=world, road=road, same=same)
