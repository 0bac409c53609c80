"""Trees, bushes and hedges: rough balls of leaves on tapered trunks. Leaves are tinted, wood is not."""

import math

import numpy as np

from probscene.mesh import Mesh

from ..solids import ROUND, Solid, ball, finish, join, lathe, loft, mapped, place, solid, tube
from ..textures import leaves

BARK, BIRCH = (98, 82, 66), (196, 192, 184)
GREENS = ((118, 146, 66), (104, 136, 70), (134, 150, 72), (92, 124, 62), (140, 158, 88))
FIR = (70, 100, 66)


def trees() -> tuple[Mesh, ...]:
    """Five broad-leaved trees, a birch, two poplars, two firs and a pine."""
    broad, needles = leaves(40), leaves(41, needle=True)
    made = [
        _broad(1, 8.0, 3.1, 0.62, GREENS[0]),
        _broad(2, 10.5, 3.9, 0.66, GREENS[1]),
        _broad(3, 6.2, 2.2, 0.60, GREENS[2]),
        _broad(4, 12.5, 4.4, 0.70, GREENS[3]),
        _broad(5, 5.0, 1.7, 0.58, GREENS[4]),
        _broad(6, 9.0, 2.2, 0.72, GREENS[4], BIRCH),
        _column(7, 13.0, 1.45, GREENS[1]),
        _column(8, 8.5, 1.1, GREENS[3]),
    ]
    firs = [_fir(9, 11.0, 2.5, 6), _fir(10, 7.0, 1.9, 5), _pine(11, 9.5)]
    return (*(finish(tree, texture=broad) for tree in made), *(finish(tree, texture=needles) for tree in firs))


def bushes() -> tuple[Mesh, ...]:
    """Three loose bushes, a clipped ball, and two hedges along y."""
    made = [
        _heap(20, 1.3, 0.85, 3, GREENS[0]),
        _heap(21, 1.9, 1.25, 4, GREENS[3]),
        _heap(22, 0.9, 0.55, 2, GREENS[4]),
        _rough(np.random.default_rng(23), (0.6, 0.6, 0.58), (0, 0, 0.55), GREENS[1], 6, 10, 0.03, 0.8),
        _hedge(24, 2.5, 1.2, 0.7),
        _hedge(25, 4.0, 1.6, 0.8),
    ]
    texture = leaves(42)
    return tuple(finish(bush, texture=texture) for bush in made)


def _shaded(rng: np.random.Generator, part: Solid, colour, tile: float = 1.7) -> Solid:
    """Lighter above than below, every face a little different; textured."""
    height = part.positions[part.triangles].mean(1)[:, 2]
    low, high = height.min(), height.max()
    light = 0.74 + 0.42 * (height - low) / (high - low) + rng.normal(0, 0.06, len(height))
    return mapped(part._replace(colour=np.asarray(colour) * light[:, None]), tile, rng.random(2))


def _rough(rng, radii, at, colour, rows: int = 5, sides: int = 8, rough: float = 0.14, tile: float = 1.7) -> Solid:
    """A ball with dents and bumps, not below the ground."""
    plain = ball((1, 1, 1), rows=rows, sides=sides)
    calm = rough * np.where(np.hypot(*plain.positions.T[:2]) < 0.01, 0.4, 1.0)
    bumpy = plain.positions * (1 + rng.normal(0, calm))[:, None]
    turn = rng.uniform(0, 2 * math.pi)
    made = solid(bumpy, plain.triangles, (255, 255, 255), True, math.radians(80))
    made = place(made, yaw=turn)
    moved = made.positions * radii + at
    moved[:, 2] = np.maximum(moved[:, 2], 0)
    return _shaded(rng, solid(moved, made.triangles, (255, 255, 255), True, math.radians(80)), colour, tile)


def _trunk(rng, height: float, radius: float, colour=BARK) -> Solid:
    lean = rng.normal(0, 0.03 * height, 2)
    path = [(0, 0, 0), (lean[0] * 0.4, lean[1] * 0.4, height * 0.5), (*lean, height)]
    return mapped(tube(path, (radius, radius * 0.75, radius * 0.4), 6, colour), 1.7)


def _broad(seed: int, height: float, radius: float, crown: float, colour, bark=BARK) -> Solid:
    """A crown of clumps about a middle one; ``crown`` is its share of the height."""
    rng = np.random.default_rng(seed)
    top, middle = height * crown / 2, height * (1 - crown / 2)
    clumps = [_rough(rng, (radius * 0.72, radius * 0.72, top * 0.9), (0, 0, middle + 0.1 * top), colour, 6, 8)]
    start = rng.uniform(0, 2 * math.pi)
    for k in range(4):
        angle, up = start + k * math.pi / 2 + rng.normal(0, 0.2), rng.uniform(-0.42, 0.25)
        at = (radius * 0.52 * math.cos(angle), radius * 0.52 * math.sin(angle), middle + up * top)
        size = radius * rng.uniform(0.44, 0.56)
        clumps.append(_rough(rng, (size, size, top * rng.uniform(0.42, 0.55)), at, colour, 5, 7))
    return join(_trunk(rng, height * (1 - crown * 0.6), 0.022 * height + 0.05, bark), *clumps)


def _column(seed: int, height: float, radius: float, colour) -> Solid:
    """A poplar: a flame of leaves down to a short trunk."""
    rng = np.random.default_rng(seed)
    flame = [_rough(rng, (radius, radius, height * 0.40), (0, 0, height * 0.48), colour, 8, 9, 0.10)]
    flame.append(_rough(rng, (radius * 0.62, radius * 0.62, height * 0.30), (0, 0, height * 0.70), colour, 6, 8, 0.12))
    return join(_trunk(rng, height * 0.3, 0.16), *flame)


def _fir(seed: int, height: float, radius: float, tiers: int) -> Solid:
    """Tiers of branches, their tips hanging down."""
    rng = np.random.default_rng(seed)
    parts, sides = [_trunk(rng, height * 0.3, 0.14)], 10
    low = 0.10 * height
    for k in range(tiers):
        share = k / tiers
        r, z = radius * (1 - share) ** 0.9 + 0.12, low + (height - low) * share * 0.92
        rise = (height - low) * 1.75 / tiers * (1 - 0.25 * share)
        z_top = min(z + rise, height)
        tier = lathe([(r * 0.25, z + 0.1 * rise), (r, z), (0.0, z_top)], sides, colour=(255, 255, 255), tinted=True)
        jag = np.where(np.arange(len(tier.positions)) % 2, 1.0, 0.8) + rng.normal(0, 0.06, len(tier.positions))
        moved = tier.positions * np.stack([jag, jag, np.ones_like(jag)], 1)
        moved[:, 2] -= np.where(jag > 0.9, 0.06 * rise, 0)
        tier = place(solid(moved, tier.triangles, (255, 255, 255), True, ROUND), yaw=rng.uniform(0, math.pi))
        parts.append(_shaded(rng, tier, FIR))
    return join(*parts)


def _pine(seed: int, height: float) -> Solid:
    """A long bare trunk under flat clumps."""
    rng = np.random.default_rng(seed)
    clumps = [
        _rough(rng, (r, r * 0.9, 0.7), (x, y, z * height), FIR, 5, 8)
        for r, x, y, z in ((1.5, 0, 0, 0.92), (1.3, 0.9, 0.4, 0.78), (1.2, -0.9, -0.2, 0.72), (1.0, 0.1, -0.9, 0.62))
    ]
    return join(_trunk(rng, height * 0.9, 0.2, (126, 88, 64)), *clumps)


def _heap(seed: int, width: float, height: float, clumps: int, colour) -> Solid:
    rng = np.random.default_rng(seed)
    parts = []
    for k in range(clumps):
        angle, away = 2 * math.pi * k / clumps, width * (0.24 if clumps > 1 else 0)
        size, tall = width * rng.uniform(0.27, 0.33), height * rng.uniform(0.52, 0.62)
        at = (away * math.cos(angle), away * math.sin(angle), tall * 0.72)
        parts.append(_rough(rng, (size, size, tall), at, colour, 5, 8, 0.10, 0.8))
    return join(*parts)


def _hedge(seed: int, length: float, height: float, width: float) -> Solid:
    """Clipped, along y."""
    rng = np.random.default_rng(seed)
    outline = np.array([(-0.5, 0), (0.5, 0), (0.52, 0.55), (0.44, 1), (0.0, 1.03), (-0.44, 1), (-0.52, 0.55)])
    rings = []
    for y in np.linspace(-length / 2, length / 2, 7):
        x, z = outline[:, 0] * width, outline[:, 1] * height
        rings.append(np.stack([x + rng.normal(0, 0.03, 7), np.full(7, y), z + rng.normal(0, 0.03, 7) * (z > 0)], 1))
    return _shaded(rng, loft(rings, (255, 255, 255), True, ROUND), GREENS[1])
