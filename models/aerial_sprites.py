"""What an aerial view is drawn with: sprites of the project's own, or a folder of pictures.

Cars, houses and trees are seen from above with the sun in the upper left, at one pixel of the canvas a sprite pixel;
cars face to the right.
"""

import math
from functools import cache
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from probscene.decoding import quiet, read, stored
from probscene.drawing import Atlas
from probscene.errors import DataError
from probscene.image_bytes import Fault

CAR = 18.0  # pixels, the length of a car
ROAD = 44  # pixels across
GROUND = 384  # pixels, a side of the ground: it covers a canvas of 256 wherever it is put within 64 pixels
_FINE = 8  # sprites are drawn this much larger and averaged down
_SIZES = {"car": CAR, "tree": 22.0, "house": 40.0}  # pixels on the canvas, the longer side of a picture from a folder


class Scenery(NamedTuple):
    """Atlases of one kind of thing each; ``cars``, ``trees`` and ``houses`` are multiplied by a tint."""

    grounds: Atlas
    roads: Atlas
    cars: Atlas
    trees: Atlas
    houses: Atlas
    tinted: bool


@cache
def drawn() -> Scenery:
    """The project's own sprites."""
    rng = np.random.default_rng(0)
    return Scenery(
        Atlas(tuple(_ground(rng, colour) for colour in ((96, 118, 66), (122, 124, 76), (84, 108, 72), (134, 122, 92)))),
        Atlas(tuple(_road(rng, grey) for grey in (92, 104, 80))),
        Atlas(tuple(_car(shape) for shape in ("saloon", "estate", "van"))),
        Atlas(tuple(_tree(rng, size) for size in (16, 20, 24, 28))),
        Atlas(tuple(_house(*size) for size in ((36, 26), (42, 28), (30, 30)))),
        tinted=True,
    )


@cache
def folder(path: str) -> Scenery:
    """RGBA pictures in the subfolders ``car``, ``tree`` and ``house`` of a folder, facing to the right.

    Raises:
        DataError: a subfolder without PNG files, or a file that is no picture with an alpha channel.
    """
    own = drawn()
    cars, trees, houses = (Atlas(_pictures(Path(path) / name, _SIZES[name])) for name in ("car", "tree", "house"))
    return Scenery(own.grounds, own.roads, cars, trees, houses, tinted=False)


def _pictures(path: Path, size: float) -> tuple[np.ndarray, ...]:
    files = sorted(p for p in path.glob("*") if p.suffix.lower() == ".png" and not p.name.startswith("."))
    if not files:
        raise DataError(f"expected PNG files in {path}, got none; make the folders car, tree and house there.")
    found = []
    for file in files:
        picture = _rgba(file)
        scale = size / max(picture.shape[:2])
        down, across = (scale if round(side * scale) else 1 / side for side in picture.shape[:2])  # at least one pixel
        picture = picture.astype(np.float64)
        alpha = picture[..., 3:] / 255.0
        premultiplied = np.concatenate([picture[..., :3] * alpha, picture[..., 3:]], 2)
        small = cv2.resize(premultiplied, None, fx=across, fy=down, interpolation=cv2.INTER_AREA)
        found.append(_straight(small))
    return tuple(found)


def _rgba(file: Path) -> np.ndarray:
    """``(h, w, 4)`` uint8."""
    try:
        with quiet():
            picture, _ = stored(read(file), opacity=True)
        if picture.shape[2:] != (4,):
            raise Fault("has no alpha channel")
    except Fault as fault:
        raise DataError(
            f"expected an RGBA picture, got {file}, which {fault}; fix it, or save it as PNG with an alpha channel."
        ) from None
    return picture if picture.dtype == np.uint8 else (picture >> 8).astype(np.uint8)


def _straight(premultiplied: np.ndarray) -> np.ndarray:
    alpha = premultiplied[..., 3:]
    colour = premultiplied[..., :3] * (255 / np.maximum(alpha, 1))
    return np.rint(np.clip(np.concatenate([colour, alpha], 2), 0, 255)).astype(np.uint8)


def _noise(rng: np.random.Generator, height: int, width: int, *sizes: float) -> np.ndarray:
    """Smooth noise of several wavelengths in pixels, each of standard deviation 1, ``(height, width)``."""
    total = np.zeros((height, width))
    for size in sizes:
        layer = cv2.GaussianBlur(rng.normal(size=(height, width)), (0, 0), size)
        total += layer / layer.std()
    return total


def _opaque(colour: np.ndarray) -> np.ndarray:
    pixels = np.rint(np.clip(colour, 0, 255)).astype(np.uint8)
    return np.concatenate([pixels, np.full((*pixels.shape[:2], 1), 255, np.uint8)], 2)


def _ground(rng: np.random.Generator, colour: tuple[int, int, int]) -> np.ndarray:
    """Meadow: large patches, tufts and grain."""
    large, small, grain = (_noise(rng, GROUND, GROUND, size) for size in (28, 2.5, 0.7))
    dry = np.array([18.0, 8.0, -6.0]) * large[..., None]
    return _opaque(np.array(colour, float) + 0.6 * dry + (4 * small + 5 * grain)[..., None])


def _road(rng: np.random.Generator, grey: int) -> np.ndarray:
    """A strip as wide as the ground: kerbs, worn asphalt, two lanes and a dashed line between them."""
    across = np.arange(ROAD)[:, None] + 0.5
    worn = 3 * np.cos((across - ROAD / 2) * 2 * math.pi / (ROAD / 4))
    shade = grey + worn + 2.5 * _noise(rng, ROAD, GROUND, 12.0) + 4 * _noise(rng, ROAD, GROUND, 0.6)
    colour = shade[..., None] * np.array([1.0, 1.0, 1.03])
    middle = ROAD // 2
    colour[middle - 1 : middle + 1, np.arange(GROUND) % 24 < 12] = 205
    colour[[2, -3]] = 188
    colour[[0, -1]] = 150
    return _opaque(colour)


def _car(shape: str) -> np.ndarray:
    """White, so that the tint is its colour; a soft shadow below and to the right that is no part of its mask."""
    roof = {"saloon": (0.32, 0.66), "estate": (0.34, 0.86), "van": (0.20, 0.92)}[shape]
    length, width = (18, 8) if shape != "van" else (18, 9)
    margin = 3
    h, w = (2 * margin + 10) * _FINE, (2 * margin + 18) * _FINE
    left, top = (w - length * _FINE) // 2, (h - width * _FINE) // 2
    right, bottom = left + length * _FINE, top + width * _FINE

    def rounded(x0, y0, x1, y1, radius):
        mask = np.zeros((h, w), np.uint8)
        cv2.rectangle(mask, (x0 + radius, y0), (x1 - radius, y1), 255, -1)
        cv2.rectangle(mask, (x0, y0 + radius), (x1, y1 - radius), 255, -1)
        for x in (x0 + radius, x1 - radius):
            for y in (y0 + radius, y1 - radius):
                cv2.circle(mask, (x, y), radius, 255, -1)
        return mask / 255.0

    def at(fraction):  # from the tail to the nose
        return round(left + fraction * (right - left))

    body = rounded(left, top, right, bottom, 2 * _FINE)
    glass = rounded(at(roof[0] - 0.10), top + _FINE, at(roof[1] + 0.10 * (roof[1] < 0.8)), bottom - _FINE, _FINE)
    top_side = rounded(at(roof[0]), top + 3 * _FINE // 2, at(roof[1] - 0.06), bottom - 3 * _FINE // 2, _FINE)
    down = np.arange(h)[:, None] / h
    paint = 235 - 50 * np.abs(down - 0.45) * body
    paint = paint * (1 - glass) + 42 * glass
    paint = paint * (1 - top_side) + (250 - 40 * np.abs(down - 0.4)) * top_side
    for y in (top + _FINE, bottom - _FINE):  # head lamps
        cv2.circle(paint, (right - _FINE, y), _FINE // 2 + 1, 255.0, -1)
    shadow = cv2.GaussianBlur(np.roll(body, (_FINE, _FINE), (0, 1)), (0, 0), _FINE * 0.8) * 0.40
    alpha = np.maximum(body, shadow)
    colour = np.where(body[..., None] > 0, paint[..., None], 0.0).repeat(3, 2)
    return _down(colour, alpha)


def _tree(rng: np.random.Generator, size: int) -> np.ndarray:
    """A crown of clumps, light where the sun is, its shadow below and to the right."""
    side = size + 8
    fine = side * _FINE
    crown, light = np.zeros((fine, fine)), np.zeros((fine, fine))
    y, x = np.mgrid[:fine, :fine] / _FINE
    for _ in range(26):
        angle, away = rng.uniform(0, 2 * math.pi), size * 0.34 * math.sqrt(rng.random())
        radius = size * rng.uniform(0.12, 0.2)
        cx, cy = side / 2 - 2 + away * math.cos(angle), side / 2 - 2 + away * math.sin(angle)
        inside = np.hypot(x - cx, y - cy) < radius
        crown[inside] = 1
        light[inside] = rng.uniform(0.75, 1.0) - 0.25 * (((x - cx) + (y - cy)) / radius)[inside] * 0.5
    shadow = cv2.GaussianBlur(np.roll(crown, (3 * _FINE, 3 * _FINE), (0, 1)), (0, 0), _FINE * 0.9) * 0.45
    shade = (light * (1 - 0.25 * (x + y - side) / side))[..., None]
    return _down(np.where(crown[..., None] > 0, shade * np.array([150.0, 190.0, 110.0]), 0), np.maximum(crown, shadow))


def _house(length: int, width: int) -> np.ndarray:
    """A ridge roof of tiles, one side in the sun, its shadow below and to the right."""
    margin = 5
    h, w = (width + 2 * margin) * _FINE, (length + 2 * margin) * _FINE
    y, x = np.mgrid[:h, :w] / _FINE - margin
    inside = (0 <= x) & (x < length) & (0 <= y) & (y < width)
    shade = np.where(y < width / 2, 235.0, 170.0) - 14 * (np.floor(y / 2) % 2) - 6 * (np.floor(x / 3) % 2)
    shade[np.abs(y - width / 2) < 0.7] = 250
    cv2.rectangle(shade, (w // 3, h // 3), (w // 3 + 4 * _FINE, h // 3 + 4 * _FINE), 120.0, -1)  # a chimney
    body = inside.astype(float)
    shadow = cv2.GaussianBlur(np.roll(body, (4 * _FINE, 4 * _FINE), (0, 1)), (0, 0), _FINE * 0.6) * 0.45
    return _down(np.where(body[..., None] > 0, shade[..., None], 0.0).repeat(3, 2), np.maximum(body, shadow))


def _down(colour: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """``(h, w, 4)`` from one drawn ``_FINE`` times larger."""
    whole = np.concatenate([colour * alpha[..., None], 255 * alpha[..., None]], 2)
    h, w = whole.shape[0] // _FINE, whole.shape[1] // _FINE
    return _straight(whole.reshape(h, _FINE, w, _FINE, 4).mean((1, 3)))
