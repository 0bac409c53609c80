"""One mesh file through trimesh, as the arrays of a ``probscene.mesh.Mesh``, in metres as the file has them.

All of its parts become one, with their transforms; corner normals are made anew, smooth where faces meet at less than
40 degrees. Transparency and normal maps are not drawn. A mesh that is inside out is turned.
"""

import math
import warnings
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple, TypedDict

import numpy as np

from probscene.errors import DataError

from ..solids import corner_normals, volume
from .polygons import Polygons, unfillable
from .sources import Sources, sources
from .texture_sheet import sheet

SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl")
CREASE = math.radians(40)
Y_UP = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])  # from x left, y up, z forward to x forward, y left, z up


class Part(NamedTuple):
    """``positions (V, 3)``; ``triangles (F, 3)``; ``colour (F, 3)`` of 255; ``tinted``; and with a texture
    ``uv (F, 3, 2)``, v downward, and ``texture (h, w, 3)``."""

    positions: np.ndarray
    triangles: np.ndarray
    colour: np.ndarray
    tinted: bool
    uv: np.ndarray | None
    texture: np.ndarray | None


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
        DataError: the file is no mesh, has no triangles, has values that are not finite, or names a file that is not
            there or is no picture.
    """
    named = sources(file)
    with _quiet() as trimesh:
        try:
            scene = trimesh.load_scene(str(file), process=False)
        except Exception as error:  # whatever it stumbles on, the file is at fault
            fault = f"{type(error).__name__}: {error}"
            raise DataError(
                f"Expected a mesh that trimesh can read, actual {file} ({fault}); export it again, triangulated."
            ) from None
        parts = [part for part in _parts(file, scene, named, trimesh.Trimesh) if len(part.triangles)]
    if not parts:
        raise DataError(f"Expected a mesh with triangles, actual an empty one in {file}; export it again.")
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
        raise DataError(f"Expected triangles with an area, actual none in {file}; export it again.")
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


def _parts(file: Path, scene, named: Sources, triangular: type) -> list[Part]:
    """Every piece of geometry where the scene has it."""
    parts = []
    for node in scene.graph.nodes_geometry:
        transform, name = scene.graph[node]
        piece = scene.geometry[name]
        if not isinstance(piece, triangular):
            raise DataError(f"Expected triangles, actual {type(piece).__name__} in {file}; triangulate it.")
        positions, triangles = np.asarray(piece.vertices, float), np.asarray(piece.faces)
        if len(triangles) == 0:
            continue
        if (at := unfillable(positions, _ply_faces(file, piece))) is not None:
            raise DataError(
                f"Expected triangles or convex polygons, actual one with a dent, face {at} of {file}; triangulate it."
            )
        if triangles.ndim != 2 or triangles.shape[1] != 3:
            raise DataError(f"Expected triangles, actual faces of {triangles.shape[1:]} in {file}; triangulate it.")
        if triangles.min() < 0 or triangles.max() >= len(positions):
            raise DataError(
                f"Expected vertices 0..{len(positions) - 1}, actual {triangles.max()} in {file}; export it again."
            )
        if not (np.isfinite(positions[triangles]).all() and np.isfinite(transform).all()):
            raise DataError(f"Expected finite vertices, actual NaN or infinity in {file}; export it again.")
        positions = positions @ transform[:3, :3].T + transform[:3, 3]
        colour, tinted, uv, texture = _look(file, piece, named)
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
        raise DataError(f"Expected triangles, actual faces of several lengths in {file}; triangulate it.")
    return corners


def _look(file: Path, piece, named: Sources):
    """Colour, tint, uv and texture of one piece of geometry."""
    triangles, visual = np.asarray(piece.faces), piece.visual
    white = np.full((len(triangles), 3), 255.0)
    if visual.kind in ("vertex", "face"):
        colour = visual.vertex_colors[triangles].mean(1) if visual.kind == "vertex" else visual.face_colors
        return _srgb(colour[:, :3], named.linear_vertices), False, None, None
    if visual.kind != "texture":
        return white * (200 / 255), False, None, None
    material = visual.material
    factor = getattr(material, "baseColorFactor", None)
    image = getattr(material, "baseColorTexture", None)
    if hasattr(material, "diffuse"):
        factor, image = material.diffuse, material.image
    name = str(getattr(material, "name", "") or "")
    if image is None and (texture := named.textures.get(name)):
        raise DataError(f"Expected a picture, actual {texture}, which {file} names; replace it by a PNG or JPEG.")
    base = white if factor is None else _srgb(np.asarray(factor, float)[:3], named.linear_factors) * np.ones_like(white)
    if (own := getattr(visual, "vertex_attributes", {}).get("color")) is not None and len(own) == len(piece.vertices):
        own = np.asarray(own, float)[:, :3] * (1 if np.asarray(own).dtype.kind == "u" else 255)
        base = base * _srgb(own[triangles].mean(1), named.linear_vertices) / 255
    tinted = any(word in name.lower() for word in ("paint", "tint"))
    if image is None or visual.uv is None or len(visual.uv) != len(piece.vertices):
        return base, tinted, None, None
    uv = np.asarray(visual.uv, float)[triangles] * [1, -1] + [0, 1]
    if not np.isfinite(uv).all():
        raise DataError(f"Expected finite texture coordinates, actual NaN or infinity in {file}; export it again.")
    if hasattr(material, "diffuse"):
        base = white  # OBJ exporters write a Kd that the texture replaces
    try:
        return base, tinted, uv, np.asarray(image.convert("RGB"))  # decodes it only now
    except (OSError, SyntaxError, ValueError) as error:
        texture = named.textures.get(name, "one")
        raise DataError(
            f"Expected a picture that decodes, actual {texture}, which {file} names ({error}); replace it."
        ) from None


def _srgb(colour: np.ndarray, linear: bool) -> np.ndarray:
    """Of 255."""
    colour = np.asarray(colour, float)
    if not linear:
        return colour
    share = np.clip(colour / 255, 0, 1)
    return 255 * np.where(share <= 0.0031308, 12.92 * share, 1.055 * share ** (1 / 2.4) - 0.055)


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
