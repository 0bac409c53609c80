"""Cameras, light and ground of a world as the mesh kernels' scene table; the shadow maps are fitted here.

Everything is float64 arithmetic on the numbers of one scene alone, element by element, so that a row does not depend
on its batch.
"""

from typing import NamedTuple

import numpy as np

from probscene.errors import ModelError
from probscene.world import World

from .tables import layout
from .tables.atlas import MeshAtlas

MAX_POSITION = 1e6  # metres
SHADOW_RANGE, SHADOW_HEIGHTS = 60.0, 36.0  # shadows fall as far as this, metres, and as many heights of the camera


class Sight(NamedTuple):
    """Cameras and sun. Axis letter: N scenes.

    ``eye (N, 3)``; ``axes (N, 3, 3)`` the camera's x, y and z in the world; ``image (N, 3, 3)`` from the world, seen
    from the eye, to pixels times depth; ``ray (N, 3, 3)`` the world's axes along the ray of a pixel: a constant, what a
    column adds, what a row adds; ``sun (N, 3, 3)`` two axes across the light and the direction to the sun.
    """

    eye: np.ndarray
    axes: np.ndarray
    image: np.ndarray
    ray: np.ndarray
    sun: np.ndarray


def numbers(part: object, *names: str) -> list[np.ndarray]:
    """Fields of a part of a world, float64."""
    return [getattr(part, name).detach().cpu().numpy().astype(np.float64) for name in names]


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Of matrices or a matrix and a vector, ``(..., i, 3)`` by ``(..., 3, j)``, added up in one order always."""
    one, two, three = (a[..., :, k, None] * b[..., k, None, :] for k in range(3))
    return 0 + one + two + three  # from 0, so that no zero is negative


def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Along the last axis of three, added up in one order always."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def view(world: World) -> Sight:
    """Where the cameras stand and look, and where the sun is.

    Raises:
        ModelError: a camera that is not finite, more than 1e6 m away, or of a focal length that is not positive.
    """
    focal, u, v, x, y, z = numbers(world.camera, "focal", "centre_x", "centre_y", "x", "y", "z")
    yaw, pitch, roll = numbers(world.camera, "yaw", "pitch", "roll")
    eye = np.stack([x, y, z], 1)
    if not (np.isfinite([*eye.T, yaw, pitch, roll, u, v, focal]).all() and (np.abs(eye) <= MAX_POSITION).all()):
        raise ModelError(f"expected finite cameras within {MAX_POSITION:g} m, got others; check its units.")
    if not (focal > 0).all():
        raise ModelError(f"expected a positive focal length in pixels, got {focal.min():g}.")
    zero = np.zeros_like(yaw)
    level = np.stack([np.cos(yaw), np.sin(yaw), zero], 1)
    right = np.stack([np.sin(yaw), -np.cos(yaw), zero], 1)
    below = np.array([0.0, 0.0, -1.0])
    cos, sin = np.cos(pitch)[:, None], np.sin(pitch)[:, None]
    forward, down = cos * level + sin * below, cos * below - sin * level
    cos, sin = np.cos(roll)[:, None], np.sin(roll)[:, None]
    right, down = cos * right + sin * down, cos * down - sin * right
    scaled = focal[:, None]
    image = np.stack([scaled * right + u[:, None] * forward, scaled * down + v[:, None] * forward, forward], 1)
    per_u, per_v = right / scaled, down / scaled
    ray = np.stack([forward - u[:, None] * per_u - v[:, None] * per_v, per_u, per_v], 2)
    return Sight(eye, np.stack([right, down, forward], 1), image, ray, _sun(world, forward))


def _sun(world: World, forward: np.ndarray) -> np.ndarray:
    azimuth, elevation = numbers(world.light, "azimuth", "elevation")
    to_sun = np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], 1)
    ahead = forward * [1.0, 1.0, 0.0]
    along = ahead - dot(ahead, to_sun)[:, None] * to_sun  # the map's rows run with the view
    length = np.sqrt(dot(along, along))[:, None]
    side = np.stack([-np.sin(azimuth), np.cos(azimuth), 0 * azimuth], 1)
    along = np.where(length > 1e-3, along / np.maximum(length, 1e-3), side)
    return np.stack([np.cross(along, to_sun), along, to_sun], 1)


def fit(sight: Sight, canvas: tuple[int, int], size: int, low, high, cast_low, cast_high) -> tuple[np.ndarray, ...]:
    """Where the shadow maps lie: what the cameras see between the heights ``low`` and ``high`` that may be in a shadow.

    Args:
        sight: cameras and sun.
        canvas: height and width, pixels.
        size: of the maps, texels.
        low, high: ``(N,)`` of the lowest and highest point of a scene, metres.
        cast_low, cast_high: ``(N, 2)`` extent of what casts shadows, across the light and relative to the eye.

    Returns:
        Whether there is anything to map ``(N,)``; the first texel's centre ``(N, 2)``; texels a metre ``(N, 2)``.
    """
    height, width = canvas
    corner = np.array([[-0.5, -0.5], [width - 0.5, -0.5], [-0.5, height - 0.5], [width - 0.5, height - 0.5]])
    reach = np.maximum(SHADOW_RANGE, SHADOW_HEIGHTS * sight.eye[:, 2])
    ray = sight.ray[:, None]
    far = (ray[..., 0] + ray[..., 1] * corner[:, :1] + ray[..., 2] * corner[:, 1:]) * reach[:, None, None]
    start = np.concatenate([np.zeros_like(far), far], 1)  # edges of the pyramid that is seen, relative to the eye
    end = np.concatenate([far, far[:, [1, 3, 0, 2]]], 1)
    points, valid = [], []
    low, high = np.minimum(low, 0) - sight.eye[:, 2], high - sight.eye[:, 2]
    for limit in (low[:, None], high[:, None]):
        rise = end[..., 2] - start[..., 2]
        at = (limit - start[..., 2]) / np.where(rise == 0, 1, rise)
        points.append(start + at[..., None] * (end - start))
        valid.append((rise != 0) & (at >= 0) & (at <= 1))
    points.append(start)
    valid.append((start[..., 2] >= low[:, None]) & (start[..., 2] <= high[:, None]))
    points, valid = np.concatenate(points, 1), np.concatenate(valid, 1)[..., None]
    across = product(sight.sun[:, None, :2], points[..., None])[..., 0]
    first = np.maximum(np.where(valid, across, np.inf).min(1), cast_low)
    last = np.minimum(np.where(valid, across, -np.inf).max(1), cast_high)
    mapped = (first < last).all(1)
    span = np.where(mapped[:, None], last - first, 1.0)
    per_metre = (size - 3) / np.maximum(span, 1e-2)
    return mapped, np.where(mapped[:, None], first, 0.0) - 1 / per_metre, per_metre


def scene_table(world: World, sight: Sight, shadow: tuple[np.ndarray, ...]) -> np.ndarray:
    """``(N, SCENE)`` float64, at least one row; ``shadow`` is what ``fit`` returned."""
    table = np.zeros((max(1, len(world)), layout.SCENE))
    rows, light = table[: len(world)], world.light
    rows[:, layout.RAY : layout.RAY + 9] = sight.ray.reshape(-1, 9)
    rows[:, layout.EYE : layout.EYE + 3] = sight.eye
    if world.ground is not None:
        rows[:, layout.GROUNDED] = sight.eye[:, 2] > 0
        (rows[:, layout.OFFSET],) = numbers(world.ground, "offset")
    lights = rows[:, layout.LIGHT :]
    focal, lights[:, layout.LENS + 1], lights[:, layout.LENS + 2] = numbers(
        world.camera, "focal", "centre_x", "centre_y"
    )
    lights[:, layout.LENS] = 1 / focal
    (exposure,) = numbers(world.photo, "exposure")
    sun, ambient, haze, zenith, horizon = numbers(light, "sun", "ambient", "haze", "zenith", "horizon")
    rows[:, layout.SUN_UP] = sight.sun[:, 2, 2]
    lights[:, layout.SUN] = np.where(sight.sun[:, 2, 2] > 0, sun, 0) * exposure
    lights[:, layout.AMBIENT], lights[:, layout.HAZE] = ambient * exposure, haze
    lights[:, layout.HORIZON : layout.HORIZON + 3] = horizon * exposure[:, None]
    lights[:, layout.MORE : layout.MORE + 3] = (zenith - horizon) * exposure[:, None]
    lights[:, layout.CLIMB : layout.CLIMB + 3] = sight.ray[:, 2]
    mapped, first, per_metre = shadow
    rows[:, layout.TEXEL] = np.sqrt(1 / per_metre[:, 0] ** 2 + 1 / per_metre[:, 1] ** 2)
    lights[:, layout.SHADOWED] = mapped & (lights[:, layout.SUN] > 0)
    on_map = lights[:, layout.ON_MAP : layout.ON_MAP + 12].reshape(-1, 3, 4)
    on_map[:, :, 1:] = product(sight.sun, sight.ray)
    on_map[:, :2, 1:] *= per_metre[..., None]
    on_map[:, :2, 0] = -first * per_metre
    lights[:, layout.ON_MAP : layout.ON_MAP + 12] = on_map.reshape(-1, 12)
    return table


def ground_tables(world: World, atlas: MeshAtlas, semantic: dict[str, int]) -> tuple[np.ndarray, ...]:
    """Strips of every scene, flat: y of their borders, texture and class of each, length of its tile in x and in y."""
    if world.ground is None or len(world) == 0:
        return np.zeros(1), np.zeros(2, np.int32), np.ones(2)
    ground, chosen = world.ground, world.ground.surface.cpu().numpy()
    edges = ground.edges.detach().cpu().numpy().astype(np.float64)
    strips = np.array([[atlas.surface(s), semantic[s.name]] for s in ground.surfaces], np.int32)[chosen]
    tiles = np.array([surface.tile for surface in ground.surfaces], np.float64)[chosen]
    return np.append(edges.ravel(), 0.0), strips.ravel(), tiles.ravel()
