"""Pictures of walls with windows, one a building: rows of roof, of bare wall, and of storeys down to the ground.

``(h, WIDE, 3)`` uint8, h 512, or 256 of low houses; light, to be multiplied by the colour of a wall; they repeat from
left to right, every ``bays`` windows. ``ROOF``, ``BARE`` and ``WALL`` are where their parts begin and end in v.
"""

import cv2
import numpy as np

from ..textures import bricks, courses, noise, painted

WIDE = 256
ROOF, BARE, WALL = (0.01, 0.24), 0.28, (0.3125, 1.0)
_SIGNS = ((150, 50, 44), (52, 84, 120), (60, 96, 70), (196, 168, 90), (84, 78, 84))
_GLASS, _FRAME = np.array([46.0, 54.0, 62.0]), (240.0, 240.0, 236.0)


def facade(
    seed: int,
    storeys: int,
    bays: int,
    window: tuple[float, float] = (0.42, 0.56),
    wall: str = "plaster",
    roof: str = "tiles",
    ground: str = "door",
    shutters: tuple[int, int, int] | None = None,
) -> np.ndarray:
    """A repeating piece of front.

    Args:
        window: width and height as shares of a bay and of a storey.
        wall: ``plaster``, ``bricks``, ``boards`` or ``panels``.
        roof: ``tiles`` or ``felt``.
        ground: what the lowest storey has: ``door``, one among windows; ``shops``; or ``windows``.
        shutters: their colour on both sides of a window, as it appears on a white wall.
    """
    rng = np.random.default_rng(seed)
    tall = 512 if storeys > 2 else 256
    picture = np.empty((tall, WIDE, 3))
    split, top = int(0.25 * tall), int(WALL[0] * tall)
    picture[:split] = _roof(rng, roof, split)
    picture[split:top] = painted((228, 228, 228), 3 * noise(rng, top - split, WIDE, 2.0))
    picture[top:] = _wall(rng, wall, tall - top)
    high, wide = (tall - top) / storeys, WIDE / bays
    for storey in range(storeys):
        lowest = storey == storeys - 1
        for bay in range(bays):
            x, y = bay * wide, top + storey * high
            if lowest and ground == "shops":
                _shop(rng, picture, x, y, wide, high)
            elif lowest and ground == "door" and bay == bays // 2:
                _door(rng, picture, x, y, wide, high)
            else:
                _window(rng, picture, (x, y, wide, high), window, shutters)
        if storey:
            _fill(picture, 0, y - 2, WIDE, y + 1, 0.88 * picture[int(y), :, :].mean(0))
    return np.rint(np.clip(picture, 0, 255)).astype(np.uint8)


def _fill(picture, x0, y0, x1, y1, colour) -> None:
    picture[round(y0) : round(y1), round(x0) : round(x1)] = colour


def _wall(rng, kind: str, height: int) -> np.ndarray:
    stains = 5 * noise(rng, height, WIDE, (30.0, 4.0)) + 2.5 * noise(rng, height, WIDE, 0.8)
    if kind == "bricks":
        tile = cv2.resize(bricks(int(rng.integers(99))), (64, height // 3), interpolation=cv2.INTER_AREA)
        return np.tile(tile, (4, 4, 1))[:height] + 0.6 * stains[..., None]
    if kind == "boards":
        return painted((224, 224, 222), stains - 30 * (np.arange(height) % 9 < 1.5)[:, None])
    if kind == "panels":
        shade, joint = courses(rng, height, WIDE, 8, 8, 1.4, 4.0, bond=False)
        return painted((222, 222, 222), shade + stains - 40 * joint)
    return painted((228, 228, 226), stains)


def _roof(rng, kind: str, height: int) -> np.ndarray:
    if kind == "felt":
        return painted((214, 214, 214), 6 * noise(rng, height, WIDE, 1.0) + 6 * noise(rng, height, WIDE, 12.0))
    shade, _ = courses(rng, height, WIDE, 16, 32, 1.0, 9.0)
    bow = (np.arange(height) * 16 / height % 1)[:, None]
    return painted((196, 196, 196), shade + 46 * (bow - 0.4) + 5 * noise(rng, height, WIDE, 1.0))


def _window(rng, picture, bay, share, shutters) -> None:
    """A window in the middle of a ``bay`` (x, y, width, height), of such a share of its width and height."""
    x, y, wide, high = bay
    w, h = wide * share[0] / 2, high * share[1] / 2
    cx, cy = x + wide / 2, y + high * 0.50
    if shutters is not None:
        for side in (-1, 1):
            edge = cx + side * w * 1.62
            _fill(picture, min(edge, cx), cy - h, max(edge, cx), cy + h, np.array(shutters, float))
    _fill(picture, cx - w - 2, cy - h - 3, cx + w + 2, cy + h + 3, _FRAME)
    _panes(rng, picture, cx - w, cy - h, cx + w, cy + h)
    _fill(picture, int(cx), cy - h, int(cx) + 1, cy + h, _FRAME)
    _fill(picture, cx - w - 3, cy + h + 2, cx + w + 3, cy + h + 6, (176, 176, 174))


def _panes(rng, picture, x0, y0, x1, y1) -> None:
    """Glass that mirrors a little of the sky; a curtain or blind in some."""
    rows, columns = round(y1) - round(y0), round(x1) - round(x0)
    light = np.linspace(1.5, 0.8, rows)[:, None] * np.linspace(1.05, 0.9, columns)[None]
    glass = _GLASS * light[..., None] * rng.uniform(0.8, 1.3)
    drawn = rng.random()
    if drawn < 0.3:
        glass[: round(rows * rng.uniform(0.3, 0.9))] = (150, 148, 142)
    elif drawn < 0.5:
        edge = max(1, columns // 5)
        glass[:, :edge] = glass[:, -edge:] = (160, 156, 148)
    picture[round(y0) : round(y1), round(x0) : round(x1)] = glass


def _door(rng, picture, x, y, wide, high) -> None:
    w = min(wide * 0.2, high * 0.11)
    cx, bottom, top = x + wide / 2, y + high, y + high * 0.24
    colour = np.array([(92, 60, 44), (58, 76, 66), (70, 74, 88), (120, 44, 40)][int(rng.integers(4))], float)
    _fill(picture, cx - w - 2, top - 4, cx + w + 2, bottom, _FRAME)
    _fill(picture, cx - w, top, cx + w, bottom, colour)
    _panes(rng, picture, cx - w * 0.6, top + 4, cx + w * 0.6, top + high * 0.2)
    _fill(picture, cx - w - 4, bottom - 4, cx + w + 4, bottom, (150, 150, 148))


def _shop(rng, picture, x, y, wide, high) -> None:
    """A window down to the knee, a sign over it, an awning over some."""
    sign = np.array(_SIGNS[int(rng.integers(len(_SIGNS)))], float)
    _fill(picture, x + 0.05 * wide, y + 0.30 * high, x + 0.95 * wide, y + 0.92 * high, (70, 70, 72))
    _panes(rng, picture, x + 0.08 * wide, y + 0.34 * high, x + 0.66 * wide, y + 0.90 * high)
    _panes(rng, picture, x + 0.70 * wide, y + 0.34 * high, x + 0.92 * wide, y + 0.98 * high)
    _fill(picture, x + 0.03 * wide, y + 0.10 * high, x + 0.97 * wide, y + 0.28 * high, sign)
    letters = np.arange(0.2, 0.8, 0.075)
    for at in letters[rng.random(len(letters)) < 0.85]:
        _fill(picture, x + at * wide, y + 0.15 * high, x + (at + 0.05) * wide, y + 0.24 * high, (232, 230, 220))
    if rng.random() < 0.4:
        stripes = (np.arange(round(0.94 * wide)) // max(3, round(wide / 16)) % 2)[None, :, None]
        y0, x0 = round(y + 0.26 * high), round(x + 0.03 * wide)
        rows = round(0.16 * high)
        picture[y0 : y0 + rows, x0 : x0 + stripes.shape[1]] = np.where(stripes, sign, (226, 222, 214))
