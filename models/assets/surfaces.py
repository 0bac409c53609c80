"""What the ground is covered with: asphalt and its markings, pavements, kerbs, grass, soil.

Rows of a texture run along the road. A marking is a narrow strip of its own, ``MARKING`` metres wide, between two
strips of the asphalt of the same name; it has that asphalt's colour where there is no paint, so it is a ``road``, too.
"""

from functools import cache

import numpy as np

from probscene.mesh import Surface

from .textures import courses, cracks, noise, painted

MARKING = 0.13  # metres, width of a line
DASH, PITCH = 3.0, 9.0  # metres: a dash, and from its start to the next one's
ASPHALTS = {"asphalt": (104, 104, 106), "dark": (78, 79, 83), "worn": (132, 129, 124)}
_LINE = np.array([226.0, 226.0, 220.0])


@cache
def surfaces() -> dict[str, Surface]:
    """Surfaces by name, seamless; ``Surface.name`` is ``road``, ``sidewalk`` or ``terrain``.

    For each asphalt A of ``asphalt``, ``dark`` and ``worn``: ``A``; ``A_dashed``, white dashes of 3 m every 9 m;
    ``A_solid``, a white line; ``A_edge``, the fainter line at the edge of a road; ``A_yellow``, a yellow line. Then
    ``paving``, ``bricks`` and ``kerb`` (sidewalk); ``grass``, ``meadow``, ``median``, ``gravel`` and ``soil``
    (terrain).
    """
    made = {}
    for k, (name, colour) in enumerate(ASPHALTS.items()):
        made[name] = Surface("road", _asphalt(k, colour), (10.24, 5.12))
        for line, (strength, paint, dash) in {
            "dashed": (0.92, _LINE, DASH / PITCH),
            "solid": (0.92, _LINE, 1.0),
            "edge": (0.75, _LINE, 1.0),
            "yellow": (0.85, np.array([214.0, 172.0, 62.0]), 1.0),
        }.items():
            made[f"{name}_{line}"] = Surface("road", _marking(k, colour, strength, paint, dash), (PITCH, 0.5))
    made["paving"] = Surface("sidewalk", _slabs(10, (158, 154, 148), 8, 8, 10.0), (4.0, 4.0))
    made["bricks"] = Surface("sidewalk", _slabs(11, (150, 118, 104), 32, 16, 9.0), (3.2, 3.2))
    made["kerb"] = Surface("sidewalk", _slabs(12, (170, 168, 163), 4, 1, 7.0, bond=False), (4.0, 4.0))
    made["grass"] = Surface("terrain", _grass(20, (86, 112, 54), 8.0), (6.4, 6.4))
    made["meadow"] = Surface("terrain", _grass(21, (124, 124, 70), 14.0), (10.24, 10.24))
    made["median"] = Surface("terrain", _grass(22, (98, 118, 62), 9.0), (5.12, 5.12))
    made["gravel"] = Surface("terrain", _stones(30, (146, 138, 124)), (4.0, 4.0))
    made["soil"] = Surface("terrain", _soil(31, (122, 102, 78)), (6.0, 6.0))
    return made


def _asphalt(seed: int, colour, rows: int = 512, columns: int = 256) -> np.ndarray:
    """Grain, stains drawn out along the road, a few cracks and a fixed patch."""
    rng = np.random.default_rng(seed)
    grain = 6 * noise(rng, rows, columns, 0.5) + 3 * noise(rng, rows, columns, 1.6)
    stains = 4 * noise(rng, rows, columns, (60.0, 9.0)) + 3 * noise(rng, rows, columns, 30.0)
    patch = np.zeros((rows, columns))
    y, x = 60 + 90 * seed, 30 + 60 * seed
    patch[y : y + 120, x : x + 56] = -9
    shade = grain + stains + patch - 34 * cracks(rng, rows, columns, 3 + 2 * seed)
    return painted(colour, shade)


def _marking(seed: int, colour, strength: float, paint: np.ndarray, dash: float, rows: int = 512) -> np.ndarray:
    """Worn paint on asphalt, along the rows, on the middle ``dash`` of them."""
    rng = np.random.default_rng(100 + seed)
    asphalt = painted(colour, 6 * noise(rng, rows, 16, 0.5) + 4 * noise(rng, rows, 16, 20.0)).astype(float)
    worn = np.clip(strength + 0.09 * noise(rng, rows, 16, 1.0) + 0.05 * noise(rng, rows, 16, 12.0), 0, 1)
    worn[np.abs(np.arange(rows) + 0.5 - rows / 2) > dash * rows / 2] = 0
    mixed = asphalt + worn[..., None] * (paint + 5 * noise(rng, rows, 16, 2.0)[..., None] - asphalt)
    return painted(mixed, np.zeros((rows, 16)))


def _slabs(seed: int, colour, rows: int, columns: int, vary: float, bond: bool = True, size: int = 256) -> np.ndarray:
    rng = np.random.default_rng(seed)
    shade, joint = courses(rng, size, size, rows, columns, 1.4, vary, bond)
    shade = shade + 5 * noise(rng, size, size, 0.7) + 4 * noise(rng, size, size, 20.0) - 46 * joint
    return painted(colour, shade)


def _grass(seed: int, colour, patches: float, size: int = 256) -> np.ndarray:
    """Blades and tufts, with dry patches."""
    rng = np.random.default_rng(seed)
    blades = 13 * noise(rng, size, size, (1.2, 0.5), 0.5) + 7 * noise(rng, size, size, 2.5)
    dry = patches * np.tanh(noise(rng, size, size, 18.0))[..., None] * [1.3, 0.55, 0.1]
    return painted(np.asarray(colour, float) + dry, blades)


def _stones(seed: int, colour, size: int = 256) -> np.ndarray:
    rng = np.random.default_rng(seed)
    pebbles = 16 * np.tanh(1.4 * noise(rng, size, size, 1.2)) + 9 * noise(rng, size, size, 0.5)
    return painted(colour, pebbles + 5 * noise(rng, size, size, 20.0))


def _soil(seed: int, colour, size: int = 256) -> np.ndarray:
    """Trodden earth with stones and some weeds."""
    rng = np.random.default_rng(seed)
    weeds = np.clip(noise(rng, size, size, 7.0) - 0.9, 0, 1)[..., None] * [-16.0, 4.0, -12.0]
    earth = 7 * noise(rng, size, size, 0.7) + 6 * noise(rng, size, size, 3.0) + 5 * noise(rng, size, size, 25.0)
    return painted(np.asarray(colour, float) + weeds, earth + 40 * (noise(rng, size, size, 1.2) > 2.6))
