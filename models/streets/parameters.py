"""What a driving scene draws at random on which node: a uniform number each, in metres and radians unless said.

Shares (0 to 1) choose: ``make`` a mesh, from the smallest to the largest, ``colour`` a tint, from the darkest to the
brightest, so that neighbouring shares look alike; ``place`` where along its strip a thing stands and ``across`` where
across it, ``lane`` which of its lanes the camera takes. ``turn`` is beside the way a thing faces.
"""

import math
from collections.abc import Mapping
from types import MappingProxyType

import torch

SHARE = (0.0, 1.0)
_DEGREE = math.radians(1)
_ANY = (-math.pi, math.pi)
_MIDDLE, _KERB = (0.25, 0.75), (0.0, 0.1)


def _thing(turn: float, scale: tuple[float, float] = (0.92, 1.08), across: tuple[float, float] = SHARE) -> dict:
    ranges = {"place": SHARE, "across": across, "turn": (-turn, turn), "scale": scale}
    return {**ranges, "make": SHARE, "colour": SHARE}


_COMMON = {
    "camera": {
        "lane": SHARE, "offset": (-0.3, 0.3), "height": (1.55, 1.75),
        "yaw": (-1.5 * _DEGREE, 1.5 * _DEGREE), "pitch": (-0.8 * _DEGREE, 1.2 * _DEGREE),
        "roll": (-0.5 * _DEGREE, 0.5 * _DEGREE),
        "exposure": (0.8, 1.2), "contrast": (0.95, 1.3), "saturation": (0.6, 1.1), "noise": (0.0, 4.0),
        "grain": SHARE,
    },
    "sun": {"azimuth": _ANY, "elevation": (18 * _DEGREE, 60 * _DEGREE)},
    "weather": {"cloud": SHARE, "haze": (0.0005, 0.004)},
    "street": {"lane": (3.0, 3.6), "asphalt": SHARE, "marks": SHARE, "shift": (0.0, 9.0),
        "view": (150.0, 220.0), "end": SHARE,
    },
    "median": {"width": (1.2, 3.0), "look": SHARE},
    "car": _thing(1.5 * _DEGREE, (0.96, 1.04), _MIDDLE),
    "van": _thing(1.5 * _DEGREE, (0.96, 1.04), _MIDDLE),
    "truck": _thing(1.0 * _DEGREE, (0.96, 1.04), _MIDDLE),
    "pole": _thing(3 * _DEGREE, across=_KERB),
    "sign": _thing(10 * _DEGREE, across=_KERB),
    "pedestrian": _thing(math.pi, (0.9, 1.06)),
    "object": _thing(math.pi, (0.9, 1.1)),
    "cyclist": {**_thing(12 * _DEGREE, (0.94, 1.04)), "way": SHARE},
    "bush": _thing(math.pi, (0.8, 1.2)),
    }  # fmt: skip
_OWN = {
    "city": {
        "sidewalk": {"width": (1.8, 3.6), "look": SHARE},
        "verge": {"more": (0.0, 1.0), "look": SHARE},
        "tree": _thing(math.pi, (0.55, 0.85)),
        "row": {"length": (25.0, 50.0)},
        "building": _thing(0.5 * _DEGREE, (0.95, 1.1), (0.0, 0.3)),
    },
    "suburban": {
        "sidewalk": {"width": (1.5, 2.6), "look": SHARE},
        "verge": {"more": (0.5, 4.0), "look": SHARE, "fence": SHARE},
        "tree": _thing(math.pi, (0.5, 0.95)),
        "row": {"length": (60.0, 90.0)},
        "building": _thing(3 * _DEGREE, (0.9, 1.1)),
    },
    "rural": {
        "shoulder": {"width": (0.8, 2.0), "look": SHARE},
        "verge": {"more": (0.0, 6.0), "look": SHARE, "fence": SHARE},
        "tree": _thing(math.pi, (0.8, 1.3)),
    },
}  # fmt: skip
PARAMETERS = MappingProxyType({name: {**_COMMON, **own} for name, own in _OWN.items()})

# How things stand in their strips: metres that are free around each along the road, by scenario where it differs.
GAPS = MappingProxyType({
    "car": 1.6, "van": 1.6, "truck": 2.0, "tree": 0.3, "bush": 0.2, "building": {"city": 0.05, "suburban": 3.0},
})  # fmt: skip
GAP = 0.4

_GREENS = [[1.0, 1.0, 1.0], [0.86, 0.95, 0.85], [1.0, 0.97, 0.8], [0.75, 0.86, 0.75], [0.95, 0.82, 0.62]]
_PAINT = [[0.90, 0.91, 0.91], [0.72, 0.74, 0.76], [0.45, 0.47, 0.49], [0.22, 0.23, 0.25], [0.08, 0.08, 0.09]] + [
    [0.10, 0.17, 0.36], [0.46, 0.09, 0.09], [0.22, 0.34, 0.52], [0.60, 0.57, 0.47], [0.13, 0.26, 0.20],
]  # fmt: skip
_CLOTHES = [[0.15, 0.17, 0.24], [0.75, 0.73, 0.70], [0.30, 0.33, 0.38], [0.55, 0.18, 0.17], [0.24, 0.36, 0.28]] + [
    [0.10, 0.10, 0.11], [0.62, 0.55, 0.42], [0.25, 0.35, 0.55],
]  # fmt: skip
_WALLS = [[1.0, 1.0, 1.0], [0.94, 0.90, 0.82], [0.82, 0.84, 0.88], [0.92, 0.80, 0.72], [0.78, 0.76, 0.72]]
_PLAIN = [[1.0, 1.0, 1.0], [0.85, 0.85, 0.85], [0.7, 0.7, 0.7]]
TINTS = MappingProxyType({
    kind: torch.tensor(sorted(table, key=sum))
    for kinds, table in (
        (("car", "van", "truck"), _PAINT), (("pedestrian", "cyclist"), _CLOTHES), (("building",), _WALLS),
        (("tree", "bush"), _GREENS), (("pole", "sign", "object"), _PLAIN),
    )
    for kind in kinds
})  # fmt: skip


def gap(scenario: str, kind: str) -> float:
    """Metres along the road that are free around a thing."""
    free = GAPS.get(kind, GAP)
    return free.get(scenario, GAP) if isinstance(free, Mapping) else free
