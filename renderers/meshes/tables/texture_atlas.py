"""Textures as the kernels read them: repeating, filtered for width and height apart, one word a texel.

A texture that is seen at a slant is small along one axis only, so it is kept at every pair of levels, each half as
wide or half as high as the one before. A level has a frame of one texel, copied from its other side.
"""

import hashlib

import numpy as np

from probscene.errors import ModelError

LEVELS = 12
# Columns of the table, one row a texture: its size, and where the texels of level (x, y) begin: at AT + y * LEVELS + x;
# beyond the last level those of the last.
WIDTH, HEIGHT, AT = range(3)
COLUMNS = AT + LEVELS * LEVELS

_MOST = (1 << 31) - 1  # the kernel's indices are 32-bit
_BITS = np.array([0, 8, 16], np.uint64)


class TextureAtlas:
    """Textures in the order in which they are added, after a white one, the first; those that are equal once.

    Attributes:
        texels: uint64, red, green and blue in bytes from the lowest on, and 32 bits up those of the one to the right.
        table: int32, ``COLUMNS`` for each texture.
    """

    def __init__(self):
        self.texels, self.table = np.zeros(0, np.uint64), np.zeros(0, np.int32)
        self._known: dict[tuple[tuple[int, ...], bytes], int] = {}  # by shape and digest
        self.add([np.full((1, 1, 3), 255, np.uint8)])

    def add(self, textures: list[np.ndarray]) -> list[int]:
        """The numbers of textures, ``(h, w, 3)`` uint8 each.

        Raises:
            ModelError: more texels than 31 bits can count.
        """
        words, rows, used = [self.texels], [self.table], self.texels.size
        keys = [(texture.shape, hashlib.sha256(texture.tobytes()).digest()) for texture in textures]
        new = {key: texture for key, texture in zip(keys, textures, strict=True) if key not in self._known}
        for texture in new.values():
            row = np.zeros(COLUMNS, np.int64)
            across = _halvings(texture.astype(np.float64), 1)
            row[[WIDTH, HEIGHT]] = texture.shape[1], texture.shape[0]
            begins = row[AT:].reshape(LEVELS, LEVELS)
            for x, narrow in enumerate(across):
                both = _halvings(narrow, 0)
                for y, level in enumerate(both):
                    begins[y:, x:] = used
                    framed = np.pad(np.rint(level).astype(np.uint64), ((1, 1), (1, 1), (0, 0)), mode="wrap")
                    word = (framed << _BITS).sum(-1, dtype=np.uint64)
                    words.append((word | np.roll(word, -1, 1) << np.uint64(32)).ravel())
                    used += words[-1].size
            if used > _MOST:
                raise ModelError(f"expected textures of at most {_MOST} texels in all, got more; make them smaller.")
            rows.append(row.astype(np.int32))
        if new:
            self.texels, self.table = np.concatenate(words), np.concatenate(rows)
            self._known |= {key: len(self._known) + i for i, key in enumerate(new)}
        return [self._known[key] for key in keys]


def _halvings(texture: np.ndarray, axis: int) -> list[np.ndarray]:
    """The texture, and what is left of it each time that ``axis`` is halved, down to one texel."""
    levels = [texture]
    while levels[-1].shape[axis] > 1 and len(levels) < LEVELS:
        levels.append(_halved(levels[-1], axis))
    return levels


def _halved(texture: np.ndarray, axis: int) -> np.ndarray:
    """Means over as many cells of equal width as there are pairs of texels; an odd texel is shared among the cells."""
    texels = np.moveaxis(texture, axis, 0)
    size = len(texels)
    if size % 2 == 0:
        halved = (texels[0::2] + texels[1::2]) / 2
    else:
        cells = size // 2
        edge = np.arange(cells + 1) * (size / cells)
        first, last = edge[:-1, None], edge[1:, None]
        texel = np.arange(size)
        weight = np.clip(np.minimum(last, texel + 1) - np.maximum(first, texel), 0, None) * (cells / size)
        halved = np.tensordot(weight, texels, 1)
    return np.moveaxis(halved, 0, axis)
