"""Cars, vans, trucks and buses: a body of stations from nose to tail, wheels in their arches.

Each station of a body has four points a side: the sill, the belt under the windows, the rail over them and the edge of
the roof. In front and behind of the cabin these are the bonnet's or the boot's. The paint is near white and tinted.
"""

from typing import NamedTuple

import numpy as np

from probscene.mesh import Mesh

from ..solids import ROUND, Solid, box, circle, finish, place, solid

PAINT, GLASS, TYRE, RIM, TRIM = (238, 238, 238), (34, 40, 46), (26, 26, 28), (150, 152, 156), (44, 45, 48)
LAMP, TAIL, PLATE = (240, 240, 228), (158, 20, 22), (236, 236, 230)
STATIONS = 15
SIDE, WINDOW, RAIL, TOP = 0, 1, 2, 3  # of the seven panels of a ring and its floor, on the left


class Body(NamedTuple):
    """What a car is drawn from; x in metres from its middle forward, z above the ground.

    ``nose``, ``cowl``, ``header``, ``rear`` and ``deck`` are (x, z) of the roof's edge where the bonnet begins, where
    the windscreen begins and ends, and where the rear window does. ``pillars`` are the x at which side windows end,
    start and end again; ``quarter`` says whether there is a window behind the last, ``panel`` whether none but the
    front one is of glass.
    """

    length: float
    width: float
    axles: tuple[float, float]
    wheel: float
    nose: float
    cowl: tuple[float, float]
    header: tuple[float, float]
    rear: tuple[float, float]
    deck: tuple[float, float]
    tail: float
    pillars: tuple[float, float, float]
    belt: float
    boot: bool = False
    quarter: bool = False
    panel: bool = False
    upright: float = 0.80
    sill: float = 0.24


CARS = (
    Body(4.62, 1.80, (1.38, -1.34), 0.32, 0.72, (0.98, 0.95), (0.14, 1.43), (-0.92, 1.41), (-1.62, 1.04), 0.98,
         (-0.22, -0.30, -1.08), 0.93, boot=True),  # a saloon
    Body(4.88, 1.86, (1.47, -1.45), 0.34, 0.74, (1.00, 0.97), (0.08, 1.45), (-1.05, 1.42), (-1.86, 1.06), 1.02,
         (-0.28, -0.37, -1.20), 0.95, boot=True),  # a large saloon
    Body(4.26, 1.79, (1.27, -1.31), 0.32, 0.74, (0.92, 0.98), (0.12, 1.47), (-1.62, 1.40), (-2.00, 1.00), 0.92,
         (-0.22, -0.30, -1.10), 0.94),  # a hatchback
    Body(3.98, 1.70, (1.20, -1.24), 0.30, 0.74, (0.90, 1.00), (0.16, 1.48), (-1.60, 1.42), (-1.88, 1.02), 0.94,
         (-0.20, -0.28, -1.00), 0.95),  # a small hatchback
    Body(4.72, 1.82, (1.38, -1.32), 0.32, 0.73, (0.98, 0.96), (0.14, 1.45), (-1.86, 1.42), (-2.22, 1.02), 0.92,
         (-0.22, -0.30, -1.08), 0.94, quarter=True),  # an estate
    Body(4.55, 1.88, (1.34, -1.32), 0.36, 0.92, (0.96, 1.14), (0.24, 1.68), (-1.78, 1.64), (-2.12, 1.18), 1.08,
         (-0.20, -0.29, -1.12), 1.08, quarter=True, upright=0.84, sill=0.30),  # an SUV
    Body(3.56, 1.63, (1.16, -1.16), 0.29, 0.78, (1.00, 1.00), (0.34, 1.50), (-1.42, 1.46), (-1.66, 1.04), 0.96,
         (-0.14, -0.22, -0.92), 0.96, upright=0.84),  # a city car
    Body(4.40, 1.83, (1.40, -1.36), 0.32, 0.82, (1.16, 1.02), (0.32, 1.62), (-1.74, 1.60), (-2.06, 1.04), 0.96,
         (-0.10, -0.18, -1.06), 1.00, quarter=True, upright=0.84),  # a people carrier
)  # fmt: skip
VANS = (
    Body(4.90, 1.92, (1.55, -1.42), 0.33, 0.96, (1.62, 1.16), (0.92, 1.88), (-2.26, 1.92), (-2.38, 1.16), 1.02,
         (0.28, 0.20, -1.02), 1.14, panel=True, upright=0.90, sill=0.28),  # a panel van
    Body(5.90, 2.02, (1.95, -1.72), 0.35, 1.04, (2.08, 1.30), (1.38, 2.30), (-2.80, 2.46), (-2.90, 1.30), 1.10,
         (0.78, 0.70, -1.30), 1.26, panel=True, upright=0.90, sill=0.32),  # a high one
    Body(4.95, 1.92, (1.58, -1.42), 0.33, 0.98, (1.62, 1.16), (0.90, 1.88), (-2.24, 1.92), (-2.40, 1.16), 1.02,
         (0.28, 0.20, -1.02), 1.14, quarter=True, upright=0.90, sill=0.28),  # a minibus
    Body(4.42, 1.80, (1.38, -1.32), 0.31, 0.82, (1.28, 1.06), (0.56, 1.80), (-2.06, 1.80), (-2.14, 1.10), 1.00,
         (0.02, -0.06, -1.00), 1.06, panel=True, upright=0.88, sill=0.26),  # a delivery van
)  # fmt: skip


def cars() -> tuple[Mesh, ...]:
    """Saloons, hatchbacks, estate, SUV, city car, people carrier."""
    return tuple(_car(body) for body in CARS)


def vans() -> tuple[Mesh, ...]:
    """Panel vans, minibus, delivery van."""
    return tuple(_car(body) for body in VANS)


def _car(body: Body) -> Mesh:
    wheels = [wheel(x, side * (body.width / 2 - 0.015), body.wheel, side) for x in body.axles for side in (1, -1)]
    mirrors = [
        box((0.10, 0.15, 0.13), (body.cowl[0] - 0.30, side * body.width / 2, body.belt + 0.03), PAINT, True)
        for side in (1, -1)
    ]
    half = body.length / 2
    plates = [box((0.03, 0.50, 0.11), (x, 0, z), PLATE) for x, z in ((half, 0.42), (-half, body.tail - 0.22))]
    bumper = box((0.04, body.width * 0.66, 0.13), (0.01 - half, 0, body.sill + 0.08), TRIM)
    return finish(_shell(body), *wheels, *mirrors, *plates, bumper)


def _shell(body: Body) -> Solid:
    """The painted body with its windows and lamps, one closed surface."""
    rings, glass = _stations(body), _windows(body)
    positions = rings.reshape(-1, 3)
    colour, tinted = np.full((STATIONS - 1, 8, 3), PAINT, float), np.ones((STATIONS - 1, 8), bool)
    for panels, (i, paint) in [
        *(((WINDOW, 6 - WINDOW), (i, GLASS)) for i in glass),
        *(((RAIL, TOP, 6 - RAIL), (i, GLASS)) for i in _screens(body)),
        ((WINDOW, 6 - WINDOW), (0, LAMP)),
        ((WINDOW, 6 - WINDOW), (STATIONS - 2, TAIL)),
    ]:
        colour[i, panels], tinted[i, panels] = paint, False
    colour[:, 7], tinted[:, 7] = TRIM, False
    i, j = (a.reshape(-1) for a in np.meshgrid(np.arange(STATIONS - 1), np.arange(8), indexing="ij"))
    a, b = i * 8 + j, i * 8 + (j + 1) % 8
    triangles = [np.stack([a, b, b + 8], 1), np.stack([a, b + 8, a + 8], 1)]
    colours, tints = [colour.reshape(-1, 3)] * 2, [tinted.reshape(-1)] * 2
    for end, lamp, middle in ((0, LAMP, TRIM), (STATIONS - 1, TAIL, PAINT)):
        low, belt, rail, top = (rings[end, k] for k in range(4))
        extra = [point * [1, side * 0.5, 1] for side in (1, -1) for point in (belt, rail)]
        points, n = end * 8 + np.arange(8), len(positions)
        positions = np.concatenate([positions, extra])
        lower, upper = (n, n + 2), (n + 1, n + 3)  # belt and rail, left and right
        faces, paints = _fan(points[0], points[7], points[6], lower[1], lower[0], points[1]), [PAINT] * 4
        faces += _fan(points[1], lower[0], upper[0], points[2]) + _fan(lower[1], points[6], points[5], upper[1])
        faces += _fan(lower[0], lower[1], upper[1], upper[0])
        faces += _fan(points[3], points[2], upper[0], upper[1], points[5], points[4])
        paints += [lamp] * 4 + [middle] * 2 + [PAINT] * 4
        triangles.append(np.array(faces)[:, ::-1] if end else np.array(faces))
        colours.append(np.array(paints, float))
        tints.append(np.array([paint == PAINT for paint in paints]))
    return solid(positions, np.concatenate(triangles), np.concatenate(colours), np.concatenate(tints), crease=0.62)


def _fan(*points) -> list[tuple[int, int, int]]:
    return [(points[0], points[k], points[k + 1]) for k in range(1, len(points) - 1)]


def _screens(body: Body) -> tuple[int, ...]:
    """Stations after which the roof's panels are of glass: the windscreen and the rear window."""
    return (5, *((9, 10) if body.boot else () if body.panel else (12,)))


def _windows(body: Body) -> tuple[int, ...]:
    return (6, *(() if body.panel else (8,)), *((10,) if body.quarter else ()))


def _stations(body: Body) -> np.ndarray:
    """``(STATIONS, 8, 3)``: sill, belt, rail and roof's edge on the left, then the same on the right, downward."""
    half, arch = body.length / 2, body.wheel * 1.13
    front, back = body.axles
    pillar, after, window = body.pillars
    arch_x = np.array([0.98, 0.55, -0.55, -0.98]) * arch
    low_x = [half - 0.05, half - 0.24, *(front + arch_x), (front + 2 * pillar) / 3, pillar, after]
    low_x = np.array([*low_x, *(back + arch_x), -half + 0.20, -half + 0.05])
    low_z = np.full(STATIONS, body.sill)
    low_z[[3, 4, 10, 11]] = body.wheel + 0.86 * arch
    low_z[[0, -1]] += 0.04

    # The roof's edge, at the knots that the body names, in straight lines between them.
    nose, tail = half - 0.12, -half + 0.05
    if body.boot:
        knots = {9: body.rear, 11: body.deck, 14: (tail, body.tail)}
    else:
        knots = {12: body.rear, 13: body.deck, 14: (tail, body.tail)}
    knots = {0: (nose, body.nose), 1: (nose - 0.22, body.nose + 0.06), 5: body.cowl, 6: body.header} | knots
    top_x, top_z = (np.interp(np.arange(STATIONS), list(knots), [p[k] for p in knots.values()]) for k in (0, 1))
    top_x[7], top_x[8] = pillar, after
    if not body.boot:
        top_x[[9, 10]] = window, window - 0.09
        top_x[11] = (top_x[10] + top_x[12]) / 2 if not body.quarter else top_x[12] + 0.10
    roof = slice(6, 10 if body.boot else 13)
    across = (top_x[roof] - body.header[0]) / (body.rear[0] - body.header[0])
    top_z[roof] = body.header[1] + across * (body.rear[1] - body.header[1]) + 0.16 * across * (1 - across)

    cabin = np.zeros(STATIONS)
    cabin[roof] = 1
    rail_x, rail_z = top_x.copy(), top_z - np.where(cabin, 0.07, 0.035)
    rail_x[0] += 0.08
    rail_x[6] += 0.08
    belt_x, belt_z = top_x.copy(), np.minimum(body.belt, top_z - 0.08)
    belt_x[0], belt_x[-1] = half, -half
    belt_x[6] = body.cowl[0] - 0.25
    belt_z[0], belt_z[-1] = body.nose - 0.20, body.tail - 0.34
    if body.boot:
        belt_x[9], rail_x[9] = window, body.rear[0] + 0.03
    else:
        belt_x[11], belt_x[12] = body.deck[0] + 0.22, body.deck[0] + 0.08
        rail_x[12] = body.rear[0] + 0.04
    plan = np.interp(np.arange(STATIONS), [0, 1, 3, 12, 13, 14], [0.84, 0.95, 1.0, 1.0, 0.98, 0.90]) * body.width / 2
    back_end = 0.84 if body.boot else body.upright + 0.04
    deck = np.where(np.arange(STATIONS) < 9, 0.86, back_end)
    rail_y = plan * np.where(cabin, body.upright, deck)
    top_y = plan * np.where(cabin, body.upright - 0.13, np.where(np.arange(STATIONS) < 9, 0.62, back_end - 0.13))
    rows = [(low_x, 0.95 * plan, low_z), (belt_x, plan, belt_z), (rail_x, rail_y, rail_z), (top_x, top_y, top_z)]
    left = np.stack([np.stack(row, 1) for row in rows], 1)
    return np.concatenate([left, left[:, ::-1] * [1, -1, 1]], 1)


def wheel(x: float, y: float, radius: float, side: int, width: float = 0.21, sides: int = 10) -> Solid:
    """A tyre with its rim; ``y`` is its outer face, ``side`` 1 on the left of the car."""
    outer, rim, n, m = circle(radius, sides), circle(radius * 0.66, sides), sides, sides // 2
    points = [
        np.column_stack([outer[:, 0], np.full(n, y), outer[:, 1]]),
        np.column_stack([rim[:, 0], np.full(n, y - side * 0.015), rim[:, 1]]),
        np.column_stack([outer[::2, 0], np.full(m, y - side * width), outer[::2, 1]]),  # the inside is hardly seen
    ]
    faces = []
    for i in range(n):
        j = (i + 1) % n
        faces += [(i, j, j + n), (i, j + n, i + n)]
    for i in range(m):
        a, b, c, inner, after = 2 * i, 2 * i + 1, (2 * i + 2) % n, 2 * n + i, 2 * n + (i + 1) % m
        faces += [(b, a, inner), (c, b, after), (b, inner, after)]
    faces += [(a, c, b) for a, b, c in _fan(*(2 * n + i for i in range(m)))]
    hub = _fan(*(n + i for i in range(n)))
    colour = [TYRE] * len(faces) + [RIM] * len(hub)
    made = solid(np.concatenate(points), np.array(faces + hub), np.array(colour, float), False, ROUND)
    return place(made, (x, 0, radius))
