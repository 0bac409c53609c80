"""What lines a road, along x: raised pavements and lawns, kerbs, fences, walls and guard rails."""

import numpy as np

from probscene.mesh import Mesh

from .solids import box, finish, loft, mapped
from .textures import bricks, leaves, paving

STEEL, DARK, CONCRETE = (150, 154, 156), (58, 62, 62), (172, 170, 164)
LENGTHS = (8.0, 32.0, 128.0)  # metres, of each slab, kerb and lawn


def slabs() -> tuple[Mesh, ...]:
    """Raised pavement, a box of each of ``LENGTHS`` along x, 1 m wide and 1 m high.

    It is to be scaled to a width of 1.2 to 3 m and a height of 0.08 to 0.25 m: two rows of slabs to a metre across at
    a width of 2 m. The sides look right then.
    """
    return _lining(paving(90, rows=4, columns=2), (176, 172, 166), (2.0, 1.0), 0.13)


def kerbs() -> tuple[Mesh, ...]:
    """Kerb stones, 0.15 m wide and 0.12 m high, a joint every metre."""
    return _lining(paving(91, rows=1, columns=4, bond=False), (188, 186, 180), (4.0, 1.0), 1.0, (0.15, 0.12))


def lawns() -> tuple[Mesh, ...]:
    """Raised grass, 1 m wide and 1 m high, to be scaled as ``slabs``."""
    return _lining(leaves(92), (112, 130, 70), (2.0, 1.0), 0.13)


def _lining(texture, colour, tile, upright: float, size=(1.0, 1.0)) -> tuple[Mesh, ...]:
    made = []
    for length in LENGTHS:
        part = mapped(box((length, *size), colour=colour), tile)
        sides = np.abs(part.normals[..., 2:3]) < 0.5
        made.append(finish(part._replace(uv=part.uv * np.where(sides, (1.0, upright), 1.0)), texture=texture))
    return tuple(made)


def fences() -> tuple[Mesh, ...]:
    """6 m along x: pickets, railings on a plinth, a wall of bricks with a coping, a guard rail."""
    pickets = [box((0.09, 0.03, 0.95), (x, 0, 0.05), (226, 224, 216), True) for x in np.arange(-2.88, 2.9, 0.24)]
    rails = [box((6.0, 0.04, 0.07), (0, -0.03, z), (216, 214, 206), True) for z in (0.25, 0.75)]
    bars = [box((0.025, 0.025, 0.85), (x, 0, 0.3), DARK) for x in np.arange(-2.9, 2.95, 0.3)]
    iron = [box((6.0, 0.2, 0.32), colour=CONCRETE), box((6.0, 0.04, 0.04), (0, 0, 1.12), DARK)]
    wall, coping = box((6.0, 0.24, 1.2), colour=(184, 128, 106)), box((6.0, 0.34, 0.09), (0, 0, 1.2), CONCRETE)
    guard = [(0.0, 0.0), (0.07, 0.06), (0.0, 0.12), (0.07, 0.19), (0.0, 0.26), (-0.02, 0.26), (-0.02, 0.0)]
    beam = loft([[(x, y, 0.48 + z) for y, z in guard] for x in (-3.0, 3.0)], STEEL)
    posts = [box((0.1, 0.08, 0.72), (x, -0.06, 0), STEEL) for x in (-2.0, 0.0, 2.0)]
    return (
        finish(*pickets, *rails),
        finish(*iron, *bars),
        finish(mapped(wall, (1.44, 1.28)), mapped(coping, (60.0, 60.0)), texture=bricks(93)),
        finish(beam, *posts),
    )
