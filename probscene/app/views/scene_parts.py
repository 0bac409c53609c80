"""A 3D scene in pieces, one for each object and strip of ground, as viewers and exchange formats take them.

World axes, metres. Axis letters: N scenes, M nodes, F triangles of a piece.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from probscene.mesh import Mesh
from probscene.world import World

NEAR, FAR, SIDE = -20.0, 150.0, 60.0  # metres of ground that are shown before, behind and beside the camera


class Piece(NamedTuple):
    """An object's triangles.

    Attributes:
        name: such as ``"car 3"``, unique but where several layers draw a node.
        positions: ``(3F, 3)`` corners, three a triangle, in the object's own axes.
        normals: ``(3F, 3)``, likewise.
        uv: ``(3F, 2)`` texture coordinates, v downward, or None.
        texture: ``(h, w, 3)`` uint8 sRGB that multiplies the colour, or None.
        colour: ``(3F, 3)`` sRGB in 0..255.
        matrix: ``(4, 4)`` from the object's axes to the world's.
    """

    name: str
    positions: NDArray[np.float32]
    normals: NDArray[np.float32]
    uv: NDArray[np.float32] | None
    texture: NDArray[np.uint8] | None
    colour: NDArray[np.float64]
    matrix: NDArray[np.float64]


def pieces(world: World, scene: int) -> Iterator[Piece]:
    """All that stands in a scene, then its ground in strips."""
    for number, layer in enumerate(world.layers):
        for node in layer.present[scene].nonzero().flatten().tolist():
            kind = int(world.kind[scene, node]) if layer.labelled else -1
            name = f"{world.kinds[kind]} {node}" if kind >= 0 else f"decoration {number}.{node}"
            tint = layer.tint[scene, node].numpy().astype(np.float64)
            matrix = _placed(*(float(getattr(layer, key)[scene, node]) for key in ("x", "y", "z", "yaw")))
            matrix[:3, :3] *= layer.scale[scene, node].numpy()
            yield _of_mesh(layer.meshes[int(layer.mesh[scene, node])], name, tint, matrix)
    if world.ground is not None:
        yield from _of_ground(world, scene)


def camera_matrix(world: World, scene: int) -> NDArray[np.float64]:
    """``(4, 4)`` from the camera's axes (x right, y down, z forward) to the world's."""
    camera = world.camera
    yaw, pitch, roll = (float(getattr(camera, key)[scene]) for key in ("yaw", "pitch", "roll"))
    to_world = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    turn = _about(2, yaw) @ _about(1, pitch) @ _about(0, roll)
    matrix = np.eye(4)
    matrix[:3, :3] = turn @ to_world
    matrix[:3, 3] = [float(getattr(camera, key)[scene]) for key in ("x", "y", "z")]
    return matrix


def intrinsics(world: World, scene: int) -> NDArray[np.float64]:
    """``(3, 3)``, in the convention of ``world``."""
    camera = world.camera
    focal, x, y = (float(getattr(camera, key)[scene]) for key in ("focal", "centre_x", "centre_y"))
    return np.array([[focal, 0, x], [0, focal, y], [0, 0, 1]])


def _of_mesh(mesh: Mesh, name: str, tint: NDArray[np.float64], matrix: NDArray[np.float64]) -> Piece:
    corners = mesh.positions[mesh.triangles]  # (F, 3, 3)
    if mesh.normals is None:
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        normals = np.repeat(normal[:, None], 3, 1)
    else:
        normals = mesh.normals
    tinted = np.ones(len(corners), bool) if mesh.tinted is None else mesh.tinted
    colour = np.repeat(mesh.colour * np.where(tinted[:, None], tint, 1.0), 3, 0)
    uv = None if mesh.texture is None or mesh.uv is None else mesh.uv.reshape(-1, 2)
    return Piece(name, corners.reshape(-1, 3), normals.reshape(-1, 3), uv, mesh.texture, colour, matrix)


def _of_ground(world: World, scene: int) -> Iterator[Piece]:
    ground = world.ground
    if ground is None:
        return
    x, y, offset = (float(torch.as_tensor(v)[scene]) for v in (world.camera.x, world.camera.y, ground.offset))
    edges = [y - SIDE, *np.clip(ground.edges[scene].numpy().astype(float), y - SIDE, y + SIDE), y + SIDE]
    for strip, (right, left) in enumerate(zip(edges, edges[1:], strict=False)):
        if left <= right:
            continue
        surface = ground.surfaces[int(ground.surface[scene, strip])]
        xy = np.array([[x + NEAR, right], [x + FAR, right], [x + FAR, left], [x + NEAR, left]])
        corners = xy[[0, 1, 2, 0, 2, 3]]
        positions = np.c_[corners, np.zeros(6)].astype(np.float32)
        # As a Surface says: rows run along +x, columns along -y.
        uv = np.c_[-corners[:, 1] / surface.tile[1], (corners[:, 0] - offset) / surface.tile[0]]
        up = np.tile(np.array([0, 0, 1], np.float32), (6, 1))
        colour = np.full((6, 3), 255.0)
        yield Piece(f"ground {strip}", positions, up, uv.astype(np.float32), surface.texture, colour, np.eye(4))


def _placed(x: float, y: float, z: float, yaw: float) -> NDArray[np.float64]:
    matrix = np.eye(4)
    matrix[:3, :3] = _about(2, yaw)
    matrix[:3, 3] = x, y, z
    return matrix


def _about(axis: int, angle: float) -> NDArray[np.float64]:
    """A rotation about x, y or z, anticlockwise as seen from its tip."""
    matrix, (i, j) = np.eye(3), [(1, 2), (2, 0), (0, 1)][axis]
    matrix[i, i] = matrix[j, j] = math.cos(angle)
    matrix[i, j], matrix[j, i] = -math.sin(angle), math.sin(angle)
    return matrix
