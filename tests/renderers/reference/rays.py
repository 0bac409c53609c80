"""What the mesh renderer's twin computes with: rotations, rays that meet triangles, textures, noise. Plain numpy.

Axis letter: P rays.
"""

import numpy as np


def turn(axis: int, angle: float) -> np.ndarray:
    """A rotation about an axis, from the next one towards the one after that."""
    turn, (i, j) = np.eye(3), ((axis + 1) % 3, (axis + 2) % 3)
    turn[i, i] = turn[j, j] = np.cos(angle)
    turn[j, i], turn[i, j] = np.sin(angle), -np.sin(angle)
    return turn


def meet(start, ray, corners) -> tuple[np.ndarray, np.ndarray]:
    """How many lengths of each ray away the plane of a triangle is, and there the shares of its corners ``(P, 3)``."""
    a, b, c = corners
    normal = np.cross(b - a, c - a)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (a - start) @ normal / (ray @ normal)
        points = start + ray * t[:, None] - a
        beta, gamma = np.cross(points, c - a) @ normal, np.cross(b - a, points) @ normal
        beta, gamma = beta / (normal @ normal), gamma / (normal @ normal)
    return t, np.stack([1 - beta - gamma, beta, gamma], 1)


def sample(texture, uv, step) -> np.ndarray:
    """Bilinear, repeating, of the texture averaged over cells whose number is a power of two less in each axis."""
    size = np.array(texture.shape[1::-1])
    level = np.clip(np.floor(np.log2(np.maximum(step * size, 1e-30) * np.sqrt(2))), 0, np.floor(np.log2(size)))
    colours = np.zeros((len(uv), 3))
    for pair in np.unique(level, axis=0).astype(int):
        mine = (level == pair).all(1)
        across, down = (_averages(n, max(1, n >> k)) for n, k in zip(size, pair, strict=True))
        small = np.rint(np.einsum("ij,jkc,lk->ilc", down, texture.astype(float), across))
        place = uv[mine] % 1 * [len(across), len(down)] - 0.5
        low = np.floor(place).astype(int)
        (x, y), (fx, fy) = low.T, (place - low).T[..., None]
        get = lambda i, j, small=small: small[j % small.shape[0], i % small.shape[1]]  # noqa: E731
        upper, lower = get(x, y) * (1 - fx) + get(x + 1, y) * fx, get(x, y + 1) * (1 - fx) + get(x + 1, y + 1) * fx
        colours[mine] = (upper * (1 - fy) + lower * fy) / 255
    return colours


def _averages(size: int, cells: int) -> np.ndarray:
    """``(cells, size)`` weights of means over cells of equal width."""
    edges, texel = np.arange(cells + 1) * size / cells, np.arange(size)
    overlap = np.minimum(edges[1:, None], texel + 1) - np.maximum(edges[:-1, None], texel)
    return np.clip(overlap, 0, None) * cells / size


def noise(seed: int, pixels: int) -> np.ndarray:
    """The noise of an image ``(pixels, 3)``: a hash of seed and pixel, whose bits are added up by threes of seven."""
    word = (1 << 64) - 1
    noise = np.zeros((pixels, 3))
    for pixel in range(pixels):
        x = (seed * 0x1E3779B97F4A7C15 + pixel * 0x3C6EF372FE94F82B) & word
        x = ((x ^ x >> 30) * 0x3F58476D1CE4E5B9) & word
        x = ((x ^ x >> 27) * 0x14D049BB133111EB) & word
        x ^= x >> 31
        sums = [sum(x >> (21 * channel + 7 * i) & 127 for i in range(3)) for channel in range(3)]
        noise[pixel] = [(total - 190.5) / 64 for total in sums]
    return noise
