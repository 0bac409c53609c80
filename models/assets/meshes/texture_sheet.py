"""Several textures side by side in one, because a mesh has one; parts without get a white place on it."""

import cv2
import numpy as np

MAX_TEXTURE_SIZE = 1024  # texels, a side of each
_PAD = 4  # texels about each, so that neighbours do not shine through
_REPEATS = 4  # of a texture within one face, at most; beyond, its mean colour is used


def sheet(parts) -> tuple[np.ndarray | None, np.ndarray | None, np.ndarray]:
    """One texture for all parts.

    Args:
        parts: ``(uv (F, 3, 2) or None, texture (h, w, 3) or None, F)`` of each.

    Returns:
        ``uv (F, 3, 2)`` of all faces and ``texture``, or None and None where no part has one; and what the colour of
        the faces is to be multiplied by, ``(F, 3)``.
    """
    parts = [_prepared(*part) for part in parts]
    flat = np.concatenate([np.broadcast_to(mean, (number, 3)) for _, _, number, mean in parts])
    distinct: dict[bytes, np.ndarray] = {}
    for _, texture, _, _ in parts:
        if texture is not None:
            distinct.setdefault(_key(texture), texture)
    if not distinct:
        return None, None, flat
    if len(distinct) == 1 and all(texture is not None for _, texture, _, _ in parts):
        return np.concatenate([uv for uv, _, _, _ in parts if uv is not None]), next(iter(distinct.values())), flat
    repeats: dict[bytes, tuple[int, int]] = dict.fromkeys(distinct, (1, 1))
    moved = []
    for uv, texture, number, _ in parts:
        if uv is None or texture is None:
            moved.append((None, b"", number))
            continue
        uv = uv - np.floor(uv.min(1, keepdims=True) + 1e-6)
        across, down = (int(np.ceil(uv[..., k].max() - 1e-3)) for k in (0, 1))
        key = _key(texture)
        repeats[key] = (max(repeats[key][0], across), max(repeats[key][1], down))
        moved.append((uv, key, number))
    cells = {key: np.tile(distinct[key], (n[1], n[0], 1)) for key, n in repeats.items()}
    cells[b""] = np.full((8, 8, 3), 255, np.uint8)
    width = sum(cell.shape[1] + 2 * _PAD for cell in cells.values())
    height = max(cell.shape[0] for cell in cells.values()) + 2 * _PAD
    whole, where, x = np.full((height, width, 3), 255, np.uint8), {}, 0
    for key, cell in cells.items():
        h, w = cell.shape[:2]
        whole[: h + 2 * _PAD, x : x + w + 2 * _PAD] = np.pad(cell, ((_PAD, _PAD), (_PAD, _PAD), (0, 0)), mode="edge")
        where[key] = (x + _PAD, w, h)
        x += w + 2 * _PAD
    uvs = []
    for uv, key, number in moved:
        x, w, h = where[key]
        across, down = repeats.get(key, (1, 1))
        inside = np.full((number, 3, 2), 0.5) if uv is None else uv / (across, down)
        uvs.append((inside * (w, h) + (x, _PAD)) / (width, height))
    return np.concatenate(uvs), whole, flat


def _key(texture: np.ndarray) -> bytes:
    return repr(texture.shape).encode() + texture.tobytes()


def _prepared(uv, texture, number):
    """(uv, texture, number of faces, factor of the colour): small enough, and none where a face repeats it often."""
    white = np.ones(3)
    if texture is None:
        return None, None, number, white
    by = MAX_TEXTURE_SIZE / max(texture.shape[:2])
    if by < 1:
        size = [max(1, round(side * by)) for side in texture.shape[1::-1]]
        texture = cv2.resize(texture, size, interpolation=cv2.INTER_AREA)
    if (uv.max(1) - np.floor(uv.min(1) + 1e-6)).max() > _REPEATS:
        return None, None, number, texture.reshape(-1, 3).mean(0) / 255
    return uv, texture, number, white
