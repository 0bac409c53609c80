"""Street lamps, masts, traffic lights and signs: lamps reach out over +x, signs face it."""

import math

import numpy as np

from probscene.mesh import Mesh

from ..solids import Solid, box, circle, finish, join, lathe, place, prism, tube
from .sign_faces import SIDE, sign_face

STEEL, DARK, WOOD, GLOW = (150, 154, 156), (58, 62, 62), (130, 104, 78), (238, 236, 222)
_PLAIN = (0.5, 0.75)  # uv of the white half of a sign's texture


def poles() -> tuple[Mesh, ...]:
    """Street lamps with one arm, a straight one, with two arms, an old one; a mast of wood; traffic lights."""
    mast = lathe([(0.11, 0), (0.10, 1.2), (0.055, 7.4)], 7, colour=STEEL)
    arm = tube([(0, 0, 7.3), (0.3, 0, 7.8), (1.5, 0, 8.0)], (0.05, 0.045, 0.04), 5, STEEL)
    arm = join(arm, box((0.75, 0.24, 0.11), (1.75, 0, 7.95), DARK), box((0.60, 0.18, 0.04), (1.75, 0, 7.91), GLOW))
    straight = lathe([(0.07, 0), (0.05, 4.3)], 6, colour=DARK)
    lantern = lathe([(0.10, 4.2), (0.20, 4.5), (0.24, 4.6), (0.0, 4.75)], 7, colour=(GLOW, DARK, DARK))
    old = [(0.16, 0), (0.13, 0.7), (0.06, 0.8), (0.045, 3.3), (0.14, 3.35), (0.22, 3.85), (0.24, 3.9), (0.0, 4.2)]
    light = lathe([(0.08, 0), (0.06, 3.3)], 6, colour=DARK)
    hung = tube([(0, 0, 0), (0, 0, 5.2), (0.4, 0, 5.7), (3.4, 0, 5.8)], (0.10, 0.08, 0.07, 0.05), 6, STEEL)
    return (
        finish(mast, arm),
        finish(straight, lantern),
        finish(mast, arm, place(arm, yaw=math.pi)),
        finish(lathe(old, 6, colour=(*[DARK] * 4, GLOW, DARK, DARK))),
        _wooden(),
        finish(light, place(_lights(), (0.16, 0, 2.3))),
        finish(hung, place(_lights(), (3.3, 0, 4.75)), place(_lights(), (0.2, 0, 2.2))),
    )


def _wooden() -> Mesh:
    """For wires, with insulators on two beams."""
    levels = (7.1, 7.7)
    beams = [box((0.10, 1.9, 0.12), (0, 0, z), WOOD) for z in levels]
    places = [(0, y, z) for z in levels for y in (-0.85, -0.45, 0.45, 0.85)]
    cups = [lathe([(0.05, 0.12), (0.05, 0.3)], 5, at, DARK) for at in places]
    return finish(lathe([(0.16, 0), (0.11, 8.3)], 7, colour=(112, 92, 74)), *beams, *cups)


def _lights() -> Solid:
    """Red, amber and green, of which green is lit."""
    lamps = [
        place(prism(circle(0.10, 8), 0.05, colour=colour), (0.12, 0, z), pitch=math.pi / 2)
        for z, colour in ((0.80, (120, 24, 20)), (0.48, (110, 84, 20)), (0.16, (60, 230, 140)))
    ]
    return join(box((0.22, 0.32, 0.98), colour=(36, 38, 36)), *lamps)


def signs() -> tuple[Mesh, ...]:
    """Speed limit, no entry, stop, give way, warning, parking, pedestrian crossing, priority, no parking, direction."""
    turned = math.pi / 2
    disc, square = circle(0.34, 14), np.array([(-0.33, -0.33), (0.33, -0.33), (0.33, 0.33), (-0.33, 0.33)])
    eight, up, down = circle(0.38, 8, 0.5), _triangle(1), _triangle(-1)
    made = []
    for name, outline, height in (
        ("limit", disc, 2.3), ("no_entry", disc, 2.2), ("stop", eight, 2.2), ("yield", down, 2.2), ("warning", up, 2.4),
        ("parking", square, 2.2), ("crossing", square, 2.3), ("priority", circle(0.42, 4), 2.3),
        ("no_parking", disc, 2.1), ("direction", square * [3.2, 4.2], 2.6),
    ):  # fmt: skip
        plate = place(prism(outline * [-1, 1], 0.03, colour=(236, 236, 234)), (0.05, 0, height), pitch=turned)
        posts = [0.0] if np.ptp(outline[:, 1]) < 1.5 else [-0.9, 0.9]
        tops = height + outline[:, 0].max() * 0.8
        post = join(*(lathe([(0.04, 0), (0.04, tops)], 6, (0, y, 0), STEEL) for y in posts))
        made.append(finish(_faced(plate, outline, height), _plain(post), texture=sign_face(name)))
    return tuple(made)


def _triangle(up: int) -> np.ndarray:
    """(up, across) of corners, those a little cut."""
    r, cut = 0.46, 0.06
    corners = [(up * r * math.cos(a), r * math.sin(a)) for a in (0, 2 * math.pi / 3, 4 * math.pi / 3)]
    points = []
    for k in range(3):
        here, before, after = (np.array(corners[(k + s) % 3]) for s in (0, -1, 1))
        points += [here + cut * (before - here), here + cut * (after - here)]
    return np.array(points)


def _plain(part: Solid) -> Solid:
    return part._replace(uv=np.broadcast_to(_PLAIN, part.uv.shape))


def _faced(plate: Solid, outline: np.ndarray, height: float) -> Solid:
    """With the picture on its front, grey behind."""
    corners, front = plate.positions[plate.triangles], plate.normals[..., 0].min(1) > 0.9
    low, high = outline.min(0), outline.max(0)
    wide = max(high - low) if np.ptp(outline[:, 1]) < 1.5 else None
    size = np.array([wide, wide]) if wide else high - low
    middle = (low + high) / 2
    u = 0.5 + (corners[..., 1] - middle[1]) / size[1]
    v = 0.5 - (corners[..., 2] - height - middle[0]) / size[0]
    inset = 0.5 / SIDE
    uv = np.stack([np.clip(u, inset, 1 - inset), np.clip(v, inset, 1 - inset) / 2], 2)
    colour = np.where(front[:, None], 255.0, np.asarray(STEEL, float))
    return plate._replace(uv=np.where(front[:, None, None], uv, _PLAIN), colour=colour)
