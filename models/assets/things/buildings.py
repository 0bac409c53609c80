"""Detached houses, town houses and blocks, their fronts facing +x. Walls are tinted; roofs, cornices and doors not.

A mesh has one texture (``facades``): walls take its storeys, roofs its upper quarter, all else a bare place of it.
"""

import math

import numpy as np

from probscene.mesh import Mesh

from ..solids import Solid, box, finish, join, loft, place, prism
from .facades import BARE, ROOF, WALL, facade

RED, BROWN, SLATE, GREY = (176, 92, 66), (128, 92, 74), (92, 94, 102), (150, 148, 144)
WHITE, STONE, BRICK, CLAY = (236, 234, 228), (196, 190, 178), (176, 116, 92), (190, 138, 112)
HOUSES, TOWN, BLOCKS = range(0, 6), range(6, 11), range(11, 16)  # which of ``buildings()`` are what


def buildings() -> tuple[Mesh, ...]:
    """``HOUSES`` stand alone, ``TOWN`` houses side by side, ``BLOCKS`` are larger."""
    return (*_houses(), *_town(), *_blocks())


def _houses() -> tuple[Mesh, ...]:
    shutters = (86, 116, 96)
    two, bricked = facade(50, 2, 4, (0.36, 0.5), ground="door"), facade(51, 2, 3, (0.40, 0.48), "bricks", ground="door")
    low, boards = facade(52, 1, 4, (0.42, 0.5)), facade(53, 2, 3, (0.38, 0.5), "boards", shutters=(70, 84, 110))
    green = facade(54, 2, 4, (0.34, 0.5), shutters=shutters)
    garage = box((5.5, 3.4, 2.6), (-0.6, 6.5, 0), WHITE, True)
    gate = box((0.06, 2.6, 2.1), (2.15, 6.5, 0.02), (150, 146, 138))
    lid = box((5.8, 3.7, 0.18), (-0.6, 6.5, 2.6), GREY)
    return (
        finish(_walls(8.0, 10.0, 5.4, 2.5, 4, WHITE), _gable(8.0, 10.0, 5.4, 3.0, RED, WHITE),
               _chimney(-1.0, 2.6, 6.5, 8.9), *map(_bare, (garage, gate, lid)), texture=two),
        finish(_walls(9.0, 9.0, 5.6, 3.0, 3, BRICK), _gable(9.0, 9.0, 5.6, 3.8, SLATE, BRICK, turned=True),
               _chimney(1.5, -2.0, 6.5, 9.6), texture=bricked),
        finish(_walls(9.0, 12.0, 3.1, 3.0, 4, (232, 220, 192)), _hip(9.0, 12.0, 3.1, 2.9, BROWN),
               _chimney(-0.5, 2.0, 4.5, 6.6), texture=low),
        finish(_walls(7.5, 9.0, 5.5, 3.0, 3, (206, 214, 216)), _gable(7.5, 9.0, 5.5, 3.2, GREY, (206, 214, 216)),
               *_porch(3.75, 0.0), texture=boards),
        finish(_walls(10.0, 10.0, 5.6, 2.5, 4, (238, 226, 196)), _hip(10.0, 10.0, 5.6, 3.0, RED),
               _chimney(0.5, -2.5, 6.0, 9.0), *_porch(5.0, 1.25), texture=green),
        finish(_walls(13.0, 9.0, 4.6, 3.0, 3, CLAY), _gable(13.0, 9.0, 4.6, 3.9, BROWN, CLAY, turned=True),
               texture=bricked),  # a barn
    )  # fmt: skip


def _town() -> tuple[Mesh, ...]:
    """Three to four storeys, ridge along the street."""
    three = facade(60, 3, 3, (0.40, 0.58), ground="shops")
    four = facade(61, 4, 3, (0.38, 0.60), ground="door")
    bricked = facade(62, 3, 2, (0.42, 0.58), "bricks", ground="door")
    tall = facade(63, 4, 4, (0.40, 0.62), ground="shops", shutters=(112, 126, 118))
    made = []
    for texture, depth, width, height, bay, bays, wall, roof in (
        (three, 11.0, 7.8, 9.6, 2.6, 3, (226, 206, 160), RED),
        (four, 12.0, 9.0, 12.4, 3.0, 3, (214, 214, 206), SLATE),
        (bricked, 10.0, 6.0, 9.0, 3.0, 2, (168, 100, 78), BROWN),
        (tall, 12.0, 10.4, 12.8, 2.6, 4, (222, 186, 150), RED),
        (four, 11.0, 12.0, 12.0, 3.0, 3, (186, 198, 186), BROWN),
    ):
        parts = [
            _walls(depth, width, height, bay, bays, wall),
            _gable(depth, width, height, 3.2, roof, wall, over=0.12),
        ]
        parts.append(_bare(box((0.35, width + 0.02, 0.30), (depth / 2 + 0.05, 0, height - 0.35), STONE)))
        parts += [_dormer(depth, height, y, roof) for y in np.arange(-width / 2 + 2.2, width / 2 - 1.5, 3.0)]
        parts.append(_chimney(-0.5, width * 0.36, height + 2, height + 4.2))
        made.append(finish(*parts, texture=texture))
    return tuple(made)


def _blocks() -> tuple[Mesh, ...]:
    """Five to eight storeys with flat roofs."""
    flats = facade(70, 6, 4, (0.50, 0.50), roof="felt", ground="windows")
    shops = facade(71, 5, 4, (0.44, 0.58), "bricks", "felt", "shops")
    office = facade(72, 6, 4, (0.84, 0.56), "panels", "felt", "shops")
    old = facade(73, 5, 4, (0.36, 0.62), "plaster", "felt", "shops", (150, 140, 120))
    made = []
    for texture, depth, width, height, bay, wall, balconies in (
        (flats, 13.0, 19.5, 18.0, 3.25, (220, 214, 200), 5),
        (shops, 12.8, 16.0, 16.0, 3.2, (184, 122, 98), 0),
        (office, 16.0, 24.0, 21.0, 4.0, (196, 202, 208), 0),
        (old, 14.0, 16.8, 17.0, 2.8, (226, 206, 168), 0),
        (flats, 13.0, 13.0, 19.2, 3.25, (206, 178, 150), 5),
    ):
        storey = height / (5 if texture is shops or texture is old else 6)
        parts = [_walls(depth, width, height, bay, 4, wall)]
        parts.append(_bare(box((depth + 0.5, width + 0.5, 0.45), (0, 0, height - 0.1), STONE)))
        parts.append(_bare(box((4.0, 5.0, 2.2), (-1.5, 1.0, height + 0.3), GREY)))
        for k in range(balconies):
            for y in (-width / 2 + 1.5 * bay, width / 2 - 1.5 * bay):
                parts.append(_bare(box((1.2, bay * 0.9, 1.05), (depth / 2 + 0.6, y, storey * (k + 1) + 0.1), WHITE)))
        if not balconies:
            parts.append(_bare(box((0.5, width + 0.1, 0.28), (depth / 2 + 0.1, 0, storey - 0.2), STONE)))
        made.append(finish(*parts, texture=texture))
    return tuple(made)


def _bare(part: Solid) -> Solid:
    """With the texture's bare place all over."""
    return part._replace(uv=np.broadcast_to([0.5, BARE], part.uv.shape))


def _walls(depth: float, width: float, height: float, bay: float, bays: int, colour) -> Solid:
    """A box whose sides show the storeys, windows ``bay`` metres apart, symmetric about the middle of each side."""
    part = box((depth, width, height), colour=colour, tinted=True)
    corners, normal = part.positions[part.triangles], part.normals
    front = np.abs(normal[..., 0]) > 0.5
    along = np.where(front, corners[..., 1] + width / 2, corners[..., 0] + depth / 2)
    length = np.where(front, width, depth)
    shift = (length - np.round(length / bay) * bay) / 2
    v = WALL[1] + (WALL[0] - WALL[1]) * corners[..., 2] / height
    uv = np.stack([(along - shift) / (bay * bays), v], 2)
    return part._replace(uv=np.where((np.abs(normal[..., 2]) > 0.5)[..., None], [0.5, BARE], uv))


def _roofed(part: Solid, colour, tile: float = 6.0) -> Solid:
    """Slopes with tiles, what is upright in the wall's own paint."""
    corners, normal = part.positions[part.triangles], part.normals
    slope = normal[..., 2] > 0.15
    across = np.abs(normal[..., 0]) > np.abs(normal[..., 1])
    u = np.where(across, corners[..., 1], corners[..., 0]) / tile
    low, high = corners[..., 2].min(), corners[..., 2].max()
    v = ROOF[1] + (ROOF[0] - ROOF[1]) * (corners[..., 2] - low) / (high - low)
    uv = np.where(slope[..., None], np.stack([u, v], 2), [0.5, BARE])
    tiled = np.all(slope, 1, keepdims=True)
    paint = np.where(tiled, colour, part.colour)
    return part._replace(uv=uv, colour=paint, tinted=~tiled[:, 0] & part.tinted)


def _gable(depth, width, height, rise, colour, wall, turned=False, over: float = 0.45) -> Solid:
    """A ridge along y, or along x where ``turned``; the gables are walls."""
    span, long = (width, depth) if turned else (depth, width)
    eave, drop = span / 2 + over, rise * over / (span / 2)
    outline = [(-eave, -drop), (-eave, 0.16 - drop), (0, rise + 0.16), (eave, 0.16 - drop), (eave, -drop)]
    rings = [[(x, y, height + z) for x, z in outline] for y in (-long / 2 - over, long / 2 + over)]
    part = loft(rings, wall, True)
    return _roofed(place(part, yaw=math.pi / 2 if turned else 0.0), colour)


def _hip(depth, width, height, rise, colour, over: float = 0.45) -> Solid:
    """Four slopes, the ridge along the longer side."""
    x, y = depth / 2 + over, width / 2 + over
    ridge_x, ridge_y = max(0.0, (depth - width) / 2), max(0.0, (width - depth) / 2)
    flat = [(1, 1), (-1, 1), (-1, -1), (1, -1)]
    low = [(a * x, b * y, height - 0.15) for a, b in flat]
    eave = [(a * x, b * y, height + 0.05) for a, b in flat]
    top = [(a * ridge_x, b * ridge_y, height + rise) for a, b in flat]
    return _roofed(loft([low, eave, top], (222, 216, 206), True), colour)


def _chimney(x: float, y: float, low: float, high: float) -> Solid:
    return _bare(box((0.7, 0.55, high - low), (x, y, low), (150, 104, 86)))


def _porch(x: float, y: float) -> list[Solid]:
    posts = [_bare(box((0.14, 0.14, 2.4), (x + 1.2, y + side, 0), WHITE)) for side in (-1.1, 1.1)]
    cover = prism([(0, -1.4), (1.5, -1.4), (1.5, 1.4), (0, 1.4)], 0.2, (x, y, 2.4), GREY)
    return [*posts, _bare(cover)]


def _dormer(depth: float, height: float, y: float, colour) -> Solid:
    """A window in the front slope of the roof."""
    x, low, high = depth / 2 - 0.5, height + 0.35, height + 1.7
    cover = box((2.7, 1.4, 0.12), (x - 1.25, y, high), colour)
    pane = box((0.04, 0.96, 1.0), (x, y, low + 0.18), (46, 54, 62))
    return join(*map(_bare, (box((2.6, 1.2, high - low), (x - 1.3, y, low), WHITE), cover, pane)))
