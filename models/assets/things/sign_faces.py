"""Pictures on traffic signs: ``(2 * SIDE, SIDE, 3)`` uint8, the face in the upper half, white below it."""

import cv2
import numpy as np

SIDE = 64
RED, BLUE, YELLOW, WHITE, BLACK = (188, 30, 36), (28, 78, 150), (236, 186, 40), (240, 240, 238), (30, 30, 30)
_FINE = 8
_MIDDLE = SIDE * _FINE // 2


def sign_face(name: str) -> np.ndarray:
    """``limit``, ``no_entry``, ``stop``, ``yield``, ``warning``, ``parking``, ``crossing``, ``priority``,
    ``no_parking`` or ``direction``."""
    side = SIDE * _FINE
    picture = np.full((side, side, 3), WHITE, np.uint8)
    _PAINTERS[name](picture)
    small = cv2.resize(picture, (SIDE, SIDE), interpolation=cv2.INTER_AREA)
    return np.concatenate([small, np.full_like(small, 255)])


def _disc(picture, share: float, colour) -> None:
    cv2.circle(picture, (_MIDDLE, _MIDDLE), round(_MIDDLE * share), colour, -1)


def _bar(picture, x, y, colour) -> None:
    """Between shares of the side."""
    a, b = ((round(s * 2 * _MIDDLE), round(t * 2 * _MIDDLE)) for s, t in zip(x, y, strict=True))
    cv2.rectangle(picture, a, b, colour, -1)


def _shape(picture, points, colour) -> None:
    cv2.fillPoly(picture, [np.rint(np.array(points) * 2 * _MIDDLE).astype(np.int32)], colour)


def _text(picture, text: str, size: float, colour, y: float = 0.5) -> None:
    (w, h), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_DUPLEX, size, 26)
    at = (_MIDDLE - w // 2, round(y * 2 * _MIDDLE) + h // 2)
    cv2.putText(picture, text, at, cv2.FONT_HERSHEY_DUPLEX, size, colour, 26, cv2.LINE_AA)


def _limit(picture):
    picture[:] = RED
    _disc(picture, 0.78, WHITE)
    _text(picture, "50", 8.0, BLACK)


def _no_entry(picture):
    picture[:] = RED
    _bar(picture, (0.18, 0.82), (0.42, 0.58), WHITE)


def _stop(picture):
    picture[:] = RED
    _text(picture, "STOP", 5.6, WHITE)


def _yield(picture):
    picture[:] = RED
    _shape(picture, [(0.19, 0.14), (0.81, 0.14), (0.5, 0.70)], WHITE)


def _warning(picture):
    picture[:] = RED
    _shape(picture, [(0.19, 0.86), (0.81, 0.86), (0.5, 0.30)], WHITE)
    _bar(picture, (0.46, 0.54), (0.48, 0.70), BLACK)
    _bar(picture, (0.46, 0.54), (0.75, 0.81), BLACK)


def _parking(picture):
    picture[:] = BLUE
    _text(picture, "P", 13.0, WHITE)


def _crossing(picture):
    picture[:] = BLUE
    _shape(picture, [(0.12, 0.86), (0.88, 0.86), (0.5, 0.16)], WHITE)
    _shape(picture, [(0.36, 0.80), (0.46, 0.56), (0.46, 0.44), (0.56, 0.44), (0.60, 0.60), (0.66, 0.80), (0.58, 0.80),
                     (0.52, 0.64), (0.44, 0.80)], BLACK)  # fmt: skip
    cv2.circle(picture, (_MIDDLE, round(0.38 * 2 * _MIDDLE)), 22, BLACK, -1)


def _priority(picture):
    _shape(picture, [(0.5, 0.14), (0.86, 0.5), (0.5, 0.86), (0.14, 0.5)], YELLOW)


def _no_parking(picture):
    picture[:] = RED
    _disc(picture, 0.80, BLUE)
    cv2.line(picture, (round(0.2 * 2 * _MIDDLE),) * 2, (round(0.8 * 2 * _MIDDLE),) * 2, RED, 56)


def _direction(picture):
    picture[:] = BLUE
    for y in (0.22, 0.48, 0.74):
        _bar(picture, (0.10, 0.62 + 0.12 * (y < 0.4)), (y, y + 0.10), WHITE)
        _shape(picture, [(0.80, y - 0.04), (0.94, y + 0.05), (0.80, y + 0.14)], WHITE)


_PAINTERS = {
    "limit": _limit, "no_entry": _no_entry, "stop": _stop, "yield": _yield, "warning": _warning, "parking": _parking,
    "crossing": _crossing, "priority": _priority, "no_parking": _no_parking, "direction": _direction,
}  # fmt: skip
