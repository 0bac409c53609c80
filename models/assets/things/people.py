"""Pedestrians, bicycles and cyclists: a body of joints, dressed. Jackets, skirts and frames are tinted.

Joints are in metres, of an adult of about 1.75 m; x forward, y to the left.
"""

import math
from typing import NamedTuple

import numpy as np

from probscene.mesh import Mesh

from ..solids import ROUND, Solid, ball, box, finish, hoop, join, loft, place, stretch, tube

CLOTH = (232, 230, 226)
SKINS, HAIRS = (
    ((222, 178, 148), (186, 138, 106), (122, 84, 62)),
    ((52, 40, 32), (96, 70, 46), (150, 122, 84), (30, 28, 28)),
)
TROUSERS = ((54, 60, 78), (44, 44, 46), (116, 104, 86), (76, 80, 84), (66, 84, 118))
SHOE, STEEL, RUBBER = (40, 36, 34), (150, 152, 156), (30, 30, 32)


_TORSO = ((0, 0.155, 0.115), (0.32, 0.155, 0.105), (0.72, 0.205, 0.13), (0.93, 0.185, 0.10), (1.03, 0.06, 0.06))


class Pose(NamedTuple):
    """Where the joints are; of limbs (elbow, hand) and (knee, foot), on the left and on the right."""

    hip: tuple[float, float, float]
    neck: tuple[float, float, float]
    head: tuple[float, float, float]
    arms: tuple
    legs: tuple


def _walk(stride: float, swing: float, stance: float = 0.0) -> Pose:
    """Standing where both are 0; in radians, the left leg and the right arm forward."""

    def leg(side, angle):
        knee = (0.44 * math.sin(angle), 0.10 * side, 0.90 - 0.44 * math.cos(angle))
        lower = angle if angle > 0 else angle * 1.7
        down = max(0.09, knee[2] - 0.40 * math.cos(lower))
        return knee, (knee[0] + 0.40 * math.sin(lower), (0.10 + stance) * side, down)

    def arm(side, angle):
        elbow = (0.29 * math.sin(angle), 0.27 * side, 1.42 - 0.29 * math.cos(angle))
        return elbow, (elbow[0] + 0.27 * math.sin(angle + 0.3), 0.25 * side, elbow[2] - 0.27 * math.cos(angle + 0.3))

    legs, arms = (leg(1, stride), leg(-1, -stride)), (arm(1, -swing), arm(-1, swing))
    return Pose((0, 0, 0.92), (0.03, 0, 1.49), (0.05, 0, 1.63), arms, legs)


RIDING = Pose(
    (-0.20, 0, 0.98), (0.20, 0, 1.42), (0.30, 0, 1.57),
    (((0.30, 0.26, 1.16), (0.50, 0.22, 1.04)), ((0.30, -0.26, 1.16), (0.50, -0.22, 1.04))),
    (((0.20, 0.12, 0.86), (0.08, 0.12, 0.48)), ((0.16, -0.12, 0.62), (-0.02, -0.12, 0.22))),
)  # fmt: skip


def pedestrians() -> tuple[Mesh, ...]:
    """Men and women who stand or walk, one with a bag, one who runs, and a child."""
    bag = box((0.26, 0.10, 0.30), (0.0, -0.34, 0.62), (120, 44, 40))
    pack = place(stretch(ball((0.13, 0.17, 0.24), rows=4, sides=6, colour=(70, 84, 70)), 1), (-0.20, 0, 1.26))
    child = stretch(_person(_walk(0.35, 0.3), 2, 0, 3), (0.68, 0.68, 0.66))
    return tuple(
        finish(*parts)
        for parts in (
            (_person(_walk(0.0, 0.05, 0.02), 0, 0, 0),),
            (_person(_walk(0.42, 0.40), 1, 1, 1),),
            (_person(_walk(0.32, 0.25), 0, 2, 2, skirt=0.42),),
            (_person(_walk(-0.38, -0.35), 0, 3, 4), pack),
            (_person(_walk(0.05, 0.05), 2, 3, 1, skirt=0.60), bag),
            (_person(_walk(-0.30, -0.30), 1, 1, 3), bag),
            (_person(_walk(0.75, 0.9), 0, 2, 1),),
            (child,),
        )
    )


def cyclists() -> tuple[Mesh, ...]:
    """Riders on their bicycles, one with a helmet, one in a skirt."""
    helmet = ball((0.14, 0.11, 0.09), (0.29, 0, 1.69), (228, 226, 220), rows=4, sides=7)
    return tuple(
        finish(*parts)
        for parts in (
            (bicycle(), _person(RIDING, 0, 0, 0)),
            (bicycle(), _person(RIDING, 1, 1, 1), helmet),
            (bicycle(basket=True), _person(RIDING, 0, 2, 4)),
        )
    )


def _person(pose: Pose, skin: int, hair: int, trousers: int, skirt: float = 0.0) -> Solid:
    """``skirt`` is its length below the hip, metres."""
    flesh, legs = SKINS[skin], TROUSERS[trousers]
    parts = [_trunk(pose), _head(pose, flesh, HAIRS[hair])]
    for side, (elbow, hand) in zip((1, -1), pose.arms, strict=True):
        shoulder = np.array(pose.neck) + [-0.01, 0.20 * side, -0.06]
        wrist = np.array(elbow) + 0.82 * (np.array(hand) - elbow)
        path = [shoulder, elbow, wrist, np.array(hand) + 0.25 * (np.array(hand) - wrist)]
        sleeves = ((CLOTH, CLOTH, flesh), (True, True, False))
        parts.append(tube(path, (0.062, 0.05, 0.042, 0.034), 4, *sleeves))
    for side, (knee, foot) in zip((1, -1), pose.legs, strict=True):
        hip = np.array(pose.hip) + [0, 0.09 * side, 0.02]
        parts.append(tube([hip, knee, foot], (0.095, 0.068, 0.052), 5, flesh if skirt > 0.5 else legs))
        parts.append(box((0.26, 0.095, 0.10), (foot[0] + 0.06, foot[1], foot[2] - 0.09), SHOE))
    if skirt:
        x, y, z = pose.hip
        unit = np.stack([np.cos(a := 2 * math.pi * np.arange(7) / 7), np.sin(a), 0 * a], 1)
        rings = [unit * (r, r * 1.05, 0) + (x, y, h) for r, h in ((0.25 + 0.1 * skirt, z - skirt), (0.15, z + 0.12))]
        parts.append(loft(rings, CLOTH, True, ROUND))
    return join(*parts)


def _trunk(pose: Pose) -> Solid:
    """From the hips to the neck; wide across y."""
    hip, neck = np.array(pose.hip) - [0, 0, 0.06], np.array(pose.neck)
    up = (neck - hip) / np.linalg.norm(neck - hip)
    ahead = np.cross([0, 1, 0], up)
    angle = 2 * math.pi * np.arange(8) / 8 + math.pi / 8
    rings = []
    for share, wide, deep in _TORSO:
        across = wide * np.cos(angle)[:, None] * np.array([0, 1.0, 0]) + deep * np.sin(angle)[:, None] * ahead
        rings.append(hip + share * (neck - hip) + across)
    return loft(rings, CLOTH, True, ROUND)


def _head(pose: Pose, flesh, hair) -> Solid:
    """Hair above and behind, and the neck."""
    made = ball((0.105, 0.085, 0.135), rows=5, sides=6, colour=flesh)
    middle = made.positions[made.triangles].mean(1)
    haired = (middle[:, 2] > 0.07) | ((middle[:, 0] < -0.02) & (middle[:, 2] > -0.06))
    made = made._replace(colour=np.where(haired[:, None], np.asarray(hair, float), made.colour))
    return join(place(made, pose.head), tube([pose.neck, np.array(pose.head) - [0, 0, 0.06]], 0.06, 4, flesh))


def bicycle(basket: bool = False) -> Solid:
    """1.75 m long; its frame is tinted."""
    rear, front, crank = (-0.53, 0, 0.34), (0.56, 0, 0.34), (-0.06, 0, 0.30)
    seat, head, bar = (-0.22, 0, 0.88), (0.38, 0, 0.86), (0.42, 0, 1.00)
    parts = [place(hoop(0.325, 0.022, 12, RUBBER), hub) for hub in (rear, front)]
    parts += [place(hoop(0.04, 0.03, 4, STEEL), hub) for hub in (rear, front)]
    for a, b in ((crank, seat), (crank, head), (seat, head), (rear, crank), (rear, seat)):
        parts.append(tube([a, b], 0.022, 3, CLOTH, True))
    parts += [tube([bar, front], 0.02, 3, STEEL), tube([(0.45, -0.28, 1.03), (0.45, 0.28, 1.03)], 0.018, 3, RUBBER)]
    parts.append(box((0.26, 0.14, 0.06), (-0.22, 0, 0.88), RUBBER))
    parts += [box((0.10, 0.10, 0.03), (x, y, z), RUBBER) for x, y, z in ((0.10, 0.12, 0.36), (-0.04, -0.12, 0.10))]
    if basket:
        parts.append(box((0.26, 0.34, 0.24), (0.64, 0, 0.82), (150, 116, 78)))
    return join(*parts)
