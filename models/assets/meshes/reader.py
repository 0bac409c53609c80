"""One mesh file as the arrays of a ``probscene.mesh.Mesh``, in metres as the file has them: OBJ, PLY and STL through
trimesh, glTF by ``gltf``.

All of its parts become one, with their transforms; corner normals are made anew, smooth where faces meet at less than
40 degrees. Transparency and normal maps are not drawn. A mesh that is inside out is turned.
"""

import math
import warnings
from contextlib import contextmanager
from pathlib import Path
from typing import TypedDict

import numpy as np

from probscene.errors import DataError

from ..solids import corner_normals, volume
from . import gltf
from .part import Part, check_geometry, check_number, decoded, is_tinted, opened
from .polygons import Polygons, unfillable
from .sources import Texture, textures_of
from .texture_sheet import sheet

SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl")
CREASE = math.radians(40)
Y_UP = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])  # from x left, y up, z forward to x forward, y left, z up


class Fields(TypedDict):
    """Fields of a ``Mesh``."""

    positions: np.ndarray
    triangles: np.ndarray
    colour: np.ndarray
    tinted: np.ndarray
    normals: np.ndarray
    uv: np.ndarray | None
    texture: np.ndarray | None


def read(file: Path) -> Fields:
    """Fields of a ``Mesh``: +x forward, +y left, +z up; neither moved nor scaled.

    Raises:
        DataError: the file is no mesh, has no triangles or more than 200,000, has values that are not finite, or names
            a file that is not there or is no picture.
    """
    parts = gltf.parts(file) if file.suffix.lower() in (".glb", ".gltf") else _through_trimesh(file)
    if not parts:
        raise DataError(f"expected a mesh with triangles, got none in {file}; export it again, triangulated.")
    if not all(part.uv is None or np.isfinite(part.uv).all() for part in parts):
        raise DataError(f"expected finite texture coordinates, got NaN or infinity in {file}; export it again.")
    before = np.cumsum([0, *(len(p.positions) for p in parts)])
    positions = np.concatenate([p.positions for p in parts])
    if file.suffix.lower() not in (".ply", ".stl"):
        positions = positions @ Y_UP.T
    triangles = np.concatenate([p.triangles + n for p, n in zip(parts, before, strict=False)])
    colour = np.concatenate([p.colour for p in parts])
    tinted = np.concatenate([np.full(len(p.triangles), p.tinted) for p in parts])
    uv, texture, flat = sheet([(p.uv, p.texture, len(p.triangles)) for p in parts])
    colour = colour * flat
    positions, triangles, kept = _welded(positions, triangles)
    if not kept.any():
        raise DataError(f"expected triangles with an area, got none in {file}; export it again.")
    check_number(file, len(triangles))
    colour, tinted, uv = colour[kept], tinted[kept], None if uv is None else uv[kept]
    if volume(positions - positions.mean(0), triangles) < -0.02 * np.prod(np.ptp(positions, 0)):
        triangles, uv = triangles[:, ::-1], None if uv is None else uv[:, ::-1]
    return {
        "positions": positions,
        "triangles": triangles,
        "colour": np.rint(np.clip(colour, 0, 255)).astype(np.uint8),
        "tinted": tinted,
        "normals": corner_normals(positions, triangles, CREASE),
        "uv": uv,
        "texture": texture,
    }


@contextmanager
def _quiet():
    """trimesh says nothing."""
    import trimesh  # takes a second

    log = trimesh.util.log
    before, log.disabled = log.disabled, True
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield trimesh
    finally:
        log.disabled = before


def _through_trimesh(file: Path) -> list[Part]:
    """Every piece of geometry where the scene has it."""
    textures = textures_of(file)
    with _quiet() as trimesh:
        try:
            scene = trimesh.load_scene(str(file), process=False)
        except Exception as error:  # whatever it stumbles on, the file is at fault
            fault = f"{type(error).__name__}: {error}"
            raise DataError(
                f"expected a mesh that trimesh can read, got {file} ({fault}); export it again, triangulated."
            ) from None
        return _parts(file, scene, textures, trimesh.Trimesh)


def _parts(file: Path, scene, textures: dict[str, Texture], triangular: type) -> list[Part]:
    parts = []
    for node in scene.graph.nodes_geometry:
        transform, name = scene.graph[node]
        piece = scene.geometry[name]
        if not isinstance(piece, triangular):  # lines or points
            continue
        positions, triangles = np.asarray(piece.vertices, float), np.asarray(piece.faces)
        if len(triangles) == 0:
            continue
        if (at := unfillable(positions, _ply_faces(file, piece))) is not None:
            raise DataError(
                f"expected triangles or convex polygons, got one with a dent, face {at} of {file}; triangulate it."
            )
        check_geometry(file, positions, triangles)
        positions = positions @ transform[:3, :3].T + transform[:3, 3]
        colour, tinted, uv, texture = _base_colours(file, piece, textures)
        if np.linalg.det(transform[:3, :3]) < 0:
            triangles, uv = triangles[:, ::-1], None if uv is None else uv[:, ::-1]
        parts.append(Part(positions, triangles, colour, tinted, uv, texture))
    return parts


def _ply_faces(file: Path, piece) -> Polygons:
    """The faces of a PLY as they are in the file; trimesh takes a binary one's to be all as long as the first."""
    data = piece.metadata.get("_ply_raw", {}).get("face", {}).get("data")
    names = (data.dtype.names or ()) if isinstance(data, np.ndarray) else data or ()
    name = next((name for name in ("vertex_index", "vertex_indices") if name in names), None)
    if name is None or isinstance(data, dict):
        return () if name is None else data[name]
    corners = data[name]["f1"]
    if (data[name]["f0"] != corners.shape[1]).any():
        raise DataError(f"expected triangles, got faces of several lengths in {file}; triangulate it.")
    return corners


def _base_colours(file: Path, piece, textures: dict[str, Texture]):
    """Colour, tint, uv and texture of one piece of geometry."""
    triangles, visual = np.asarray(piece.faces), piece.visual
    white = np.full((len(triangles), 3), 255.0)
    if visual.kind in ("vertex", "face"):
        colour = visual.vertex_colors[triangles].mean(1) if visual.kind == "vertex" else visual.face_colors
        return np.asarray(colour[:, :3], float), False, None, None
    if visual.kind != "texture":
        return white * (200 / 255), False, None, None
    material = visual.material
    factor, image = getattr(material, "diffuse", None), getattr(material, "image", None)
    name = str(getattr(material, "name", "") or "")
    texture = textures.get(name, Texture("one"))
    if image is None and name in textures:  # also where it has options, which trimesh takes for its name
        image = opened(file, texture.path, texture.path)
    tinted = is_tinted(name)
    if image is None or visual.uv is None or len(visual.uv) != len(piece.vertices):
        return white if factor is None else np.asarray(factor, float)[:3] * np.ones_like(white), tinted, None, None
    uv = (np.asarray(visual.uv, float) * texture.scale + texture.offset)[triangles] * [1, -1] + [0, 1]
    return white, tinted, uv, decoded(file, texture.path, image)  # OBJ's texture replaces its Kd


def _welded(positions: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices at one place become one; which triangles ``(F,)`` are left with an area."""
    used = np.unique(triangles)
    grain = max(float(np.ptp(positions[used], axis=0).max()), 1e-9) * 1e-6
    _, first, same = np.unique(np.round(positions[used] / grain), axis=0, return_index=True, return_inverse=True)
    place = np.zeros(len(positions), int)
    place[used] = same.reshape(-1)
    positions, triangles = positions[used][first], place[triangles]
    a, b, c = (positions[triangles[:, k]] for k in range(3))
    kept = np.linalg.norm(np.cross(b - a, c - a), axis=1) > grain * grain
    return positions, triangles[kept], kept
