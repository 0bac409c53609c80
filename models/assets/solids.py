"""Closed solids, what the project's own meshes are built of: box, prism, lathe, tube, ball, loft.

A solid is coloured triangle by triangle, faces outward, and knows its corner normals: faces that meet at less than an
angle (``crease``) share one, so that what is round looks round. Metres and radians. Axis letters: V vertices,
F triangles, S rings, R points of a ring.
"""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from probscene.mesh import Mesh

ROUND = math.radians(66)  # crease of what is round, down to six sides
SHARP = math.radians(20)
_CROWD = 256  # faces at a vertex, of which all pairs are compared
_CELLS = 32  # into which a unit of length is cut, to find normals that are nearly the same
_PAIRS = 1 << 22  # compared at a time, for the memory's sake


Tinted = bool | Sequence[bool] | np.ndarray


class Solid(NamedTuple):
    """``positions (V, 3)``; ``triangles (F, 3)``; ``colour (F, 3)`` sRGB; ``tinted (F,)``; ``normals (F, 3, 3)``;
    ``uv (F, 3, 2)``."""

    positions: np.ndarray
    triangles: np.ndarray
    colour: np.ndarray
    tinted: np.ndarray
    normals: np.ndarray
    uv: np.ndarray


def solid(positions, triangles, colour, tinted: Tinted = False, crease: float = SHARP) -> Solid:
    """A closed surface turned outward, without what has no area.

    Args:
        positions: ``(V, 3)``; those at the same place become one.
        triangles: ``(F, 3)``, all anticlockwise as seen from outside, or all clockwise.
        colour: ``(3,)`` or ``(F, 3)``.
        tinted: bool or ``(F,)``.
        crease: faces whose normals differ by less share the normal at a common corner.
    """
    positions, triangles = np.asarray(positions, float), np.asarray(triangles)
    _, first, same = np.unique(np.round(positions, 6), axis=0, return_index=True, return_inverse=True)
    positions, triangles = positions[first], same.reshape(-1)[triangles]
    colour = np.broadcast_to(np.asarray(colour, float), (len(triangles), 3))
    tinted = np.broadcast_to(np.asarray(tinted, bool), (len(triangles),))
    kept = np.linalg.norm(_across(positions, triangles), axis=1) > 1e-9
    triangles, colour, tinted = triangles[kept], colour[kept], tinted[kept]
    if volume(positions, triangles) < 0:
        triangles = triangles[:, ::-1]
    uv = np.zeros((len(triangles), 3, 2))
    return Solid(positions, triangles, colour, tinted, corner_normals(positions, triangles, crease), uv)


def volume(positions: np.ndarray, triangles: np.ndarray) -> float:
    """Cubic metres inside of a closed surface, negative where it is inside out."""
    a, b, c = (positions[triangles[:, k]].astype(float) for k in range(3))
    return float(np.einsum("fi,fi->", a, np.cross(b, c)) / 6)


def _across(positions: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    a, b, c = (positions[triangles[:, k]] for k in range(3))
    return np.cross(b - a, c - a)


def corner_normals(positions: np.ndarray, triangles: np.ndarray, crease: float) -> np.ndarray:
    """``(F, 3, 3)`` unit normals: at each corner the mean, by area, of the faces there that are within ``crease``.

    Where more than 256 faces meet, those whose normals differ by less than about two degrees are taken as one, so that
    a fan or many copies in one place do not take all pairs of them.
    """
    across, least = _across(positions, triangles), math.cos(crease) - 1e-9
    unit = across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-30)
    order = np.argsort(triangles.reshape(-1), kind="stable")  # corners by their vertex
    face = order // 3
    many = np.bincount(triangles.reshape(-1), minlength=len(positions))
    start = np.cumsum(many) - many
    paired = np.where(many <= _CROWD, many, 0)
    pairs = np.cumsum(paired**2)
    sums = np.zeros((len(order), 3))
    cuts = np.searchsorted(pairs, np.arange(_PAIRS, pairs[-1], _PAIRS))
    for low, high in pairwise(np.unique([0, *cuts, len(many)])):  # vertices
        number = np.repeat(paired[low:high], many[low:high])  # of each corner's pairs
        first, last = start[low], start[low] + len(number)
        one = np.repeat(np.arange(len(number)), number)  # every pair of corners at the same vertex
        before = np.repeat(start[low:high], many[low:high]) - np.cumsum(number) + number
        other = np.arange(len(one)) + np.repeat(before, number)
        near = np.einsum("ij,ij->i", unit[face[first + one]], unit[face[other]]) > least
        sums[first:last] = _totals(one[near], across[face[other[near]]], len(number))
    for vertex in np.flatnonzero(many > _CROWD):
        there = slice(start[vertex], start[vertex] + many[vertex])
        sums[there] = _sums_of_crowd(unit[face[there]], across[face[there]], least)
    normals = np.empty_like(sums)
    normals[order] = sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-30)
    return normals.reshape(-1, 3, 3)


def _sums_of_crowd(unit: np.ndarray, across: np.ndarray, least: float) -> np.ndarray:
    """``(F, 3)`` for each face at a vertex: the sum of ``across`` of those whose normal has a cosine above ``least``
    with its own."""
    _, cell = np.unique(np.round(unit * _CELLS), axis=0, return_inverse=True)
    cell = cell.reshape(-1)
    normal, total = (_totals(cell, values, cell.max() + 1) for values in (unit, across))
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    rows = np.array_split(normal, 1 + len(normal) ** 2 // _PAIRS)
    return np.concatenate([(some @ normal.T > least).astype(float) @ total for some in rows])[cell]


def _totals(index: np.ndarray, values: np.ndarray, number: int) -> np.ndarray:
    """``(number, 3)`` sums of the rows of ``values`` that have the same index."""
    return np.stack([np.bincount(index, values[:, k], number) for k in range(3)], 1)


def loft(rings, colour, tinted: Tinted = False, crease: float = SHARP, ends=None) -> Solid:
    """Rings joined one to the next, the first and last, which are convex, filled.

    Args:
        rings: ``(S, R, 3)``.
        colour: ``(3,)`` or ``(S - 1, R, 3)``, of the quadrangle after each point.
        tinted: bool or ``(S - 1, R)``.
        ends: colour of both ends; that of the first quadrangles if None.
    """
    rings = np.asarray(rings, float)
    S, R = rings.shape[:2]
    colour = np.broadcast_to(np.asarray(colour, float), (S - 1, R, 3))
    tinted = np.broadcast_to(np.asarray(tinted, bool), (S - 1, R))
    i, j = (a.reshape(-1) for a in np.meshgrid(np.arange(S - 1), np.arange(R), indexing="ij"))
    a, b = i * R + j, i * R + (j + 1) % R
    triangles = [np.stack([a, b, b + R], 1), np.stack([a, b + R, a + R], 1)]
    colours, tints = [colour.reshape(-1, 3)] * 2, [tinted.reshape(-1)] * 2
    for end, flip in ((0, True), (S - 1, False)):
        flat = _zigzag(R) + end * R
        triangles.append(flat[:, ::-1] if flip else flat)
        row = min(end, S - 2)
        paint = colour[row, 1:-1] if ends is None else np.broadcast_to(np.asarray(ends, float), (R - 2, 3))
        colours.append(paint)
        tints.append(tinted[row, 1:-1] if ends is None else np.zeros(R - 2, bool))
    triangles, colours, tints = (np.concatenate(x) for x in (triangles, colours, tints))
    return solid(rings.reshape(-1, 3), triangles, colours, tints, crease)


def _zigzag(R: int) -> np.ndarray:
    """``(R - 2, 3)`` triangles across a ring: those of points in line with their neighbours have an area, too."""
    faces = []
    for k in range((R - 1) // 2):
        faces.append((k, k + 1, R - 1 - k))
        if R - 2 - k > k + 1:
            faces.append((k + 1, R - 2 - k, R - 1 - k))
    return np.array(faces)


def box(size, at=(0.0, 0.0, 0.0), colour=(200, 200, 200), tinted: Tinted = False) -> Solid:
    """Length, width and height; ``at`` is the middle of its underside."""
    x, y, z = size
    return prism([(-x / 2, -y / 2), (x / 2, -y / 2), (x / 2, y / 2), (-x / 2, y / 2)], z, at, colour, tinted)


def prism(
    outline,
    height,
    at=(0.0, 0.0, 0.0),
    colour=(200, 200, 200),
    tinted: Tinted = False,
    crease: float = SHARP,
) -> Solid:
    """A convex outline ``(R, 2)`` in x and y, raised from ``at``."""
    flat = np.asarray(outline, float)
    rings = [np.column_stack([flat, np.full(len(flat), z)]) for z in (0.0, height)]
    return place(loft(rings, colour, tinted, crease), at)


def circle(radius: float, sides: int, turn: float = 0.0) -> np.ndarray:
    """``(sides, 2)``"""
    angle = 2 * math.pi * (np.arange(sides) + turn) / sides
    return radius * np.stack([np.cos(angle), np.sin(angle)], 1)


def lathe(profile, sides: int, at=(0.0, 0.0, 0.0), colour=(200, 200, 200), tinted: Tinted = False) -> Solid:
    """Turned about z: ``profile`` is a list of (radius, z) from below; ``colour`` may be one for each step of it."""
    unit = circle(1.0, sides)
    rings = [np.column_stack([r * unit, np.full(sides, z)]) for r, z in profile]
    colour = np.asarray(colour, float)
    if colour.ndim == 2:
        colour = np.repeat(colour[:, None], sides, 1)
    return place(loft(rings, colour, tinted, ROUND), at)


def tube(path, radius, sides: int = 5, colour=(200, 200, 200), tinted: Tinted = False) -> Solid:
    """Along a path ``(S, 3)``, with one radius or one for each point; one colour, or one for each step."""
    path = np.asarray(path, float)
    radii = np.broadcast_to(np.asarray(radius, float), len(path))
    along = np.gradient(path, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    side = np.eye(3)[np.abs(path[-1] - path[0]).argmin()]
    unit, rings = circle(1.0, sides, 0.5), []
    for point, ahead, r in zip(path, along, radii, strict=True):
        across = np.cross(ahead, side)
        across /= np.linalg.norm(across)
        rings.append(point + r * (unit[:, :1] * across + unit[:, 1:] * np.cross(ahead, across)))
    colour, tinted = np.asarray(colour, float), np.asarray(tinted, bool)
    if colour.ndim == 2:
        colour = np.repeat(colour[:, None], sides, 1)
    return loft(rings, colour, np.repeat(tinted[:, None], sides, 1) if tinted.ndim else tinted, ROUND)


def hoop(radius: float, thick: float, sides: int, colour, around: int = 3) -> Solid:
    """A ring about y: a thin tube that closes on itself."""
    angle, section = 2 * math.pi * np.arange(sides) / sides, circle(thick, around)
    away = radius + section[None, :, 0]
    x, z = away * np.cos(angle)[:, None], away * np.sin(angle)[:, None]
    points = np.stack([x, np.broadcast_to(section[:, 1], x.shape), z], 2).reshape(-1, 3)
    i, j = (a.reshape(-1) for a in np.meshgrid(np.arange(sides), np.arange(around), indexing="ij"))
    a, b = i * around + j, i * around + (j + 1) % around
    c, d = ((k + around) % (sides * around) for k in (b, a))
    return solid(points, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]), colour, False, math.pi * 0.7)


def ball(
    radii,
    at=(0.0, 0.0, 0.0),
    colour=(200, 200, 200),
    tinted: Tinted = False,
    rows: int = 4,
    sides: int = 7,
) -> Solid:
    """An ellipsoid about ``at``, ``radii`` along x, y and z."""
    angle = math.pi * np.arange(rows + 1) / rows
    made = lathe([(math.sin(a), -math.cos(a)) for a in angle], sides, colour=colour, tinted=tinted)
    return place(stretch(made, radii), at)


def place(part: Solid, at=(0.0, 0.0, 0.0), roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0) -> Solid:
    """Turned about x, then y, then z, right-handed, then moved."""
    turn = np.eye(3)
    for axis, angle in enumerate((roll, pitch, yaw)):
        c, s = math.cos(angle), math.sin(angle)
        one = np.eye(3)
        p, q = (axis + 1) % 3, (axis + 2) % 3
        one[[p, p, q, q], [p, q, p, q]] = c, -s, s, c
        turn = one @ turn
    return part._replace(positions=part.positions @ turn.T + np.asarray(at), normals=part.normals @ turn.T)


def stretch(part: Solid, by) -> Solid:
    """Scaled along x, y and z; a negative factor mirrors."""
    by = np.broadcast_to(np.asarray(by, float), 3)
    normals = part.normals / by
    normals /= np.maximum(np.linalg.norm(normals, axis=2, keepdims=True), 1e-30)
    part = part._replace(positions=part.positions * by, normals=normals)
    if np.prod(by) > 0:
        return part
    return part._replace(triangles=part.triangles[:, ::-1], normals=normals[:, ::-1], uv=part.uv[:, ::-1])


def join(*parts: Solid) -> Solid:
    """All as one, in order."""
    before = np.cumsum([0, *(len(p.positions) for p in parts)])
    triangles = np.concatenate([p.triangles + n for p, n in zip(parts, before, strict=False)])
    columns = (np.concatenate([p[k] for p in parts]) for k in (0, 2, 3, 4, 5))
    positions, *rest = columns
    return Solid(positions, triangles, *rest)


def mapped(part: Solid, tile: float | tuple[float, float], offset=(0.0, 0.0)) -> Solid:
    """With texture coordinates along the two axes that each face is most parallel to.

    ``tile`` is how many metres across and up (or across and along) one texture covers.
    """
    corners, across = part.positions[part.triangles], _across(part.positions, part.triangles)
    axis = np.abs(across).argmax(1)
    u = np.where((axis == 0)[:, None], corners[..., 1], corners[..., 0])
    v = np.where((axis == 2)[:, None], corners[..., 1], corners[..., 2])
    return part._replace(uv=np.stack([u, -v], 2) / np.broadcast_to(tile, 2) + np.asarray(offset))


def finish(*parts: Solid, texture: np.ndarray | None = None) -> Mesh:
    """The parts as a mesh, its lowest point at z = 0, centred in x and y."""
    whole = join(*parts)
    low, high = whole.positions.min(0), whole.positions.max(0)
    moved = whole.positions - [(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]]
    colour = np.rint(np.clip(whole.colour, 0, 255)).astype(np.uint8)
    uv = None if texture is None else whole.uv
    return Mesh(moved, whole.triangles, colour, whole.tinted, whole.normals, uv, texture)
