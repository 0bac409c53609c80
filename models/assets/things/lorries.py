"""Trucks and buses: upright bodies stacked from rings, loads, wheels on two or three axles.

Lengths in metres; x from the middle of the vehicle forward, as in ``vehicles``.
"""

import numpy as np

from probscene.mesh import Mesh

from ..solids import Solid, box, finish, join, loft, stretch, tube
from .vehicles import GLASS, LAMP, PAINT, PLATE, TAIL, TRIM, wheel

CARGO, TARPAULIN, STEEL = (226, 226, 222), (92, 112, 138), (150, 152, 154)


def trucks() -> tuple[Mesh, ...]:
    """A box truck, a small one, a flatbed with planks, a tipper, a refuse lorry and an articulated lorry; then two
    buses."""
    small = _truck(6.2, 2.05, 1.75, 1.0, ((1.95, 0.40), (-1.55, 0.40)), _cargo(-3.1, 1.10, 2.10, 0.85, 2.75, PAINT))
    large = _truck(8.4, 2.45, 1.95, 1.35, ((2.95, 0.50), (-2.25, 0.50)), _cargo(-4.2, 1.95, 2.50, 1.05, 3.60, CARGO))
    flat = _truck(7.0, 2.35, 1.85, 1.2, ((2.40, 0.46), (-1.90, 0.46)), _flatbed(-3.5, 1.45, 2.40, 1.0))
    tipper = _truck(7.2, 2.45, 1.95, 1.3, ((2.35, 0.50), (-1.30, 0.50), (-2.60, 0.50)), _tipper(-3.6, 1.40, 2.45))
    refuse = _truck(8.0, 2.45, 1.85, 1.2, ((2.70, 0.50), (-1.40, 0.50), (-2.70, 0.50)), _hopper(-4.0, 1.90, 2.45))
    cover = _cargo(-6.6, 4.15, 2.50, 1.10, 3.85, TARPAULIN)
    long = _truck(13.2, 2.48, 2.25, 1.6, ((5.30, 0.50), (2.40, 0.50), (-3.30, 0.50), (-4.60, 0.50)), cover)
    return (small, large, flat, tipper, refuse, long, _bus(11.6, 5), _bus(9.2, 4))


def _tower(levels, marks, panels) -> Solid:
    """Rings stacked along z, from the front left corner along the left side to the back and round.

    Args:
        levels: (z, x of the front, x of the back, half of the width) from below.
        marks: x between the corners at which a side is divided, from the front.
        panels: ((level, panels of the left side), colour) of what is not painted; panel -1 is the front, -2 the back.
    """
    n = len(marks) + 1
    rings = []
    for z, front, back, half in levels:
        xs = [front, *np.clip(marks, back, front), back]
        rings.append([(x, half, z) for x in xs] + [(x, -half, z) for x in reversed(xs)])
    R = 2 * (n + 1)
    colour, tinted = np.full((len(levels) - 1, R, 3), PAINT, float), np.ones((len(levels) - 1, R), bool)
    for (level, where), paint in panels:
        columns = [c for k in where for c in ((R - 1,) if k == -1 else (n,) if k == -2 else (k, 2 * n - k))]
        colour[level, columns], tinted[level, columns] = paint, False
    return loft(rings, colour, tinted)


def _wheels(axles, width: float) -> list[Solid]:
    return [
        wheel(x, side * width / 2, radius, side, width=0.30 + 0.25 * (k > 0))
        for k, (x, radius) in enumerate(axles)
        for side in (1, -1)
    ]


def _truck(length, width, cab, belt, axles, *load: Solid) -> Mesh:
    front, half = length / 2, width / 2
    top = belt + 1.35
    levels = [(0.45, front - 0.04, front - cab, half * 0.97), (0.85, front, front - cab, half)]
    levels += [(belt + 0.05, front - 0.02, front - cab, half), (top - 0.30, front - 0.28, front - cab, half * 0.96)]
    levels += [(top, front - 0.42, front - cab, half * 0.88)]
    marks = (front - 0.36, front - cab + 0.45)
    body = _tower(levels, marks, [((2, (-1, 1)), GLASS), ((0, (-1,)), TRIM), ((2, (-2,)), TRIM)])
    chassis = box((length - 0.6, width * 0.42, 0.25), (-0.15, 0, 0.55), TRIM)
    lamps = [box((0.04, 0.36, 0.18), (front, y * (half - 0.28), 0.62), LAMP) for y in (1, -1)]
    grille = box((0.04, width * 0.45, 0.24), (front, 0, 0.92), TRIM)
    lights = [box((0.06, 0.34, 0.14), (0.10 - front, y * (half - 0.30), 0.70), TAIL) for y in (1, -1)]
    plate = box((0.05, 0.52, 0.12), (front, 0, 0.58), PLATE)
    mirrors = [box((0.10, 0.16, 0.40), (front - 0.45, y * (half + 0.04), belt + 0.35), TRIM) for y in (1, -1)]
    return finish(body, chassis, *lamps, grille, *lights, plate, *mirrors, *_wheels(axles, width), *load)


def _cargo(back, front, width, floor, top, colour) -> Solid:
    """A closed box with a rail about its floor."""
    middle, length = (back + front) / 2, front - back
    cargo = box((length, width, top - floor - 0.12), (middle, 0, floor + 0.12), colour, colour == PAINT)
    return join(cargo, box((length + 0.02, width + 0.02, 0.12), (middle, 0, floor), STEEL))


def _flatbed(back, front, width, floor) -> Solid:
    """Drop sides, and planks and a crate on it."""
    middle, length = (back + front) / 2, front - back
    sides = [box((length, 0.06, 0.45), (middle, y * width / 2, floor), PAINT, True) for y in (1, -1)]
    ends = [box((0.06, width, 0.45 + 0.9 * (x == front)), (x, 0, floor), STEEL) for x in (back + 0.03, front)]
    planks = box((length * 0.55, width * 0.5, 0.55), (middle - 0.4, -0.3, floor + 0.1), (176, 140, 92))
    crate = box((1.1, 1.0, 0.95), (front - 0.8, 0.5, floor + 0.1), (128, 104, 72))
    return join(box((length, width, 0.12), (middle, 0, floor - 0.02), (104, 90, 72)), *sides, *ends, planks, crate)


def _tipper(back, front, width) -> Solid:
    """A skip that widens upward, heaped with gravel."""
    levels = [(1.0, front - 0.25, back + 0.35, width * 0.42), (2.35, front, back, width / 2)]
    heap = [(2.3, front - 0.1, back + 0.1, width * 0.47), (2.65, front - 1.2, back + 1.3, width * 0.15)]
    return join(_tower(levels, (), []), _plain(_tower(heap, (), []), (134, 124, 108)))


def _plain(part: Solid, colour) -> Solid:
    return part._replace(colour=np.broadcast_to(colour, part.colour.shape), tinted=np.zeros_like(part.tinted))


def _hopper(back, front, width) -> Solid:
    """A refuse body, rounded above, its tailgate dark."""
    half = width / 2
    levels = [(0.95, front, back + 0.5, half), (2.2, front, back, half), (2.9, front, back + 0.15, half)]
    levels += [(3.25, front - 0.1, back + 0.6, half * 0.8)]
    return _tower(levels, (), [((0, (-2,)), TRIM), ((1, (-2,)), STEEL)])


def _bus(length: float, windows: int) -> Mesh:
    """A city bus: a row of windows a side, doors as dark as these, its number over the windscreen."""
    front, half = length / 2, 1.25
    levels = [(0.32, front - 0.05, -front + 0.05, half - 0.03), (1.05, front, -front, half)]
    levels += [(2.45, front - 0.12, -front + 0.08, half - 0.03), (2.75, front - 0.18, -front + 0.12, half - 0.06)]
    levels += [(3.02, front - 0.45, -front + 0.35, half - 0.25)]
    pitch = (length - 0.9) / windows
    marks = [front - 0.45 - pitch * k - gap for k in range(windows) for gap in (0.0, pitch - 0.12)]
    glazed = [2 * k + 1 for k in range(windows)]
    body = _tower(levels, marks, [((1, (-1, -2, *glazed)), GLASS), ((2, (-1,)), (30, 30, 32))])
    doors = [box((1.15, 0.03, 1.95), (x, -half, 0.42), (48, 54, 60)) for x in (front - 1.1, -0.4)]
    lamps = [box((0.04, 0.40, 0.20), (front, y * 0.88, 0.62), LAMP) for y in (1, -1)]
    lights = [box((0.04, 0.25, 0.45), (-front, y * 0.98, 0.60), TAIL) for y in (1, -1)]
    number = box((0.03, 1.3, 0.2), (front - 0.14, 0, 2.5), (236, 168, 40))
    mirror = tube([(front - 0.1, 1.2, 2.3), (front + 0.22, 1.36, 2.1), (front + 0.2, 1.36, 1.75)], 0.07, 4, TRIM)
    mirrors = [stretch(mirror, (1, y, 1)) for y in (1, -1)]
    axles = ((front - 2.6, 0.48), (-front + 2.9, 0.48))
    return finish(body, *doors, *lamps, *lights, number, *mirrors, *_wheels(axles, 2 * half))
