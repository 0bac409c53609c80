"""Sprites as the kernel reads them: premultiplied, box-filtered, framed, one word a texel."""

from typing import Generic, NamedTuple, TypeVar
from weakref import WeakKeyDictionary

import numpy as np

from probscene.drawing import Atlas
from probscene.errors import ModelError

LEVELS = 32
_LIMIT = 1 << 25  # texels kept between calls, 256 MiB
_MOST = (1 << 31) - 1  # the kernel's indices are 32-bit
_FAINT, _SOLID = 126, 129  # texels up to the one, and from the other on, have samples of less or more than one half
_LANES = np.array([0, 16, 32, 48], np.uint64)


Whole = TypeVar("Whole", int, np.ndarray)


class Variant(NamedTuple, Generic[Whole]):
    """A sprite at a level for x and y, or an array of each field."""

    offset: Whole  # of the frame's first texel
    width: Whole  # without the frame
    height: Whole
    left: Whole  # texels trimmed from the level
    top: Whole
    inset: Whole  # margin within which every texel is opaque
    even: Whole  # 1 if these are all of one colour
    solid: Whole  # margin within which every sample's alpha is at least one half
    faint: Whole  # 1 if no sample's is
    touches: Whole  # 1 if an outermost texel of the level is not clear


class Sheet:
    """Variants of sprites, made when first drawn and kept for the next call: ``texels`` has their four channels, one in
    each 16-bit lane, ``colours`` at the same places the first three as bytes.

    A variant is framed by clear texels, so that it fades over one. What touches the edge of its sprite is framed
    by copies of its edge when magnified, for the kernel to cut by coverage. What does not touch the edge is trimmed.
    """

    def __init__(self):
        self._clear()

    def _clear(self) -> None:
        self._rows: WeakKeyDictionary[Atlas, dict[int, int]] = WeakKeyDictionary()
        self._sizes: WeakKeyDictionary[Atlas, np.ndarray] = WeakKeyDictionary()
        self._variants: list[Variant[int]] = []
        self._used = 0
        self.texels = np.zeros(1 << 16, np.uint64)
        self.colours = np.zeros(1 << 16, np.uint32)

    def trim(self) -> None:
        """Forget everything once it has grown large; to be called between drawings."""
        if self._used > _LIMIT:
            self._clear()

    def sizes(self, atlas: Atlas) -> np.ndarray:
        """Width and height of every sprite, ``(len(atlas), 2)`` int64 texels."""
        if atlas not in self._sizes:
            self._sizes[atlas] = np.array([sprite.shape[1::-1] for sprite in atlas.sprites], np.int64)
        return self._sizes[atlas]

    def find(self, atlas: Atlas, sprite: np.ndarray, level: np.ndarray, magnified: np.ndarray) -> np.ndarray:
        """Variants of sprites ``(I,)`` at levels ``(I, 2)`` for x and y: ``(I, 10)`` int64, ``Variant``'s fields."""
        keys = ((sprite * LEVELS + level[:, 0]) * LEVELS + level[:, 1]) * 2 + magnified
        unique, inverse = np.unique(keys, return_inverse=True)
        rows = self._rows.setdefault(atlas, {})
        found = [self._variants[self._row(atlas, rows, key)] for key in unique.tolist()]
        return np.array(found, np.int64).reshape(-1, len(Variant._fields))[inverse]

    def _row(self, atlas: Atlas, rows: dict[int, int], key: int) -> int:
        if key not in rows:
            rest, magnified = divmod(key, 2)
            rest, level_y = divmod(rest, LEVELS)
            index, level_x = divmod(rest, LEVELS)
            if magnified and not self._variants[self._row(atlas, rows, key - 1)].touches:
                rows[key] = rows[key - 1]
            else:
                rows[key] = len(self._variants)
                self._variants.append(self._make(atlas.sprites[index], level_x, level_y, bool(magnified)))
        return rows[key]

    def _make(self, sprite: np.ndarray, level_x: int, level_y: int, hard: bool) -> Variant[int]:
        texels = shrink(sprite, level_x, level_y)
        alpha = texels[..., 3]
        touches, left, top = any(side.any() for side in (alpha[0], alpha[-1], alpha[:, 0], alpha[:, -1])), 0, 0
        if not touches:
            rows, columns = np.flatnonzero(alpha.any(1)), np.flatnonzero(alpha.any(0))
            left, top = (int(columns[0]), int(rows[0])) if len(rows) else (0, 0)
            texels = texels[top : rows[-1] + 1, left : columns[-1] + 1] if len(rows) else texels[:0, :0]
        height, width = texels.shape[:2]
        inset = _inset(texels[..., 3])
        inside = texels[inset : height - inset, inset : width - inset].reshape(-1, 4)
        framed = np.pad(texels, ((1, 1), (1, 1), (0, 0)), mode="edge" if hard else "constant")
        offset = self._store((framed.astype(np.uint64) << _LANES).sum(-1, dtype=np.uint64).ravel())
        even = len(inside) > 0 and bool((inside == inside[0]).all())
        solid, faint = _inset(texels[..., 3], _SOLID), texels[..., 3].max(initial=0) <= _FAINT
        return Variant(offset, width, height, left, top, inset, int(even), solid, int(faint), int(touches))

    def _store(self, words: np.ndarray) -> int:
        offset, self._used = self._used, self._used + words.size
        if self._used > _MOST:
            raise ModelError(f"expected at most {_MOST} texels in one drawing, got more; draw fewer.")
        if self._used > self.texels.size:
            size = min(max(2 * self.texels.size, self._used), _MOST)
            self.texels, self.colours = (np.resize(kept, size) for kept in (self.texels, self.colours))
        self.texels[offset : self._used] = words
        red, green, blue = (words >> np.uint64(16 * lane) & np.uint64(255) for lane in range(3))
        self.colours[offset : self._used] = red | green << np.uint64(8) | blue << np.uint64(16)
        return offset


def shrink(sprite: np.ndarray, level_x: int, level_y: int) -> np.ndarray:
    """A sprite ``(h, w, 4)`` premultiplied and averaged over cells of ``2**level_y`` by ``2**level_x`` texels, uint8.

    A cell is clear where it reaches beyond the sprite, so that a sprite smaller than a cell fades.
    """
    colour = sprite.astype(np.float64)
    colour[..., :3] = np.rint(colour[..., :3] * colour[..., 3:] / 255)
    for axis, level in ((0, level_y), (1, level_x)):
        starts = np.arange(0, colour.shape[axis], 1 << level)
        colour = np.add.reduceat(colour, starts, axis=axis) / (1 << level)
    return np.rint(colour).astype(np.uint8)


def _inset(alpha: np.ndarray, least: int = 255) -> int:
    rows, columns = np.nonzero(alpha < least)
    if not len(rows):
        return 0
    height, width = alpha.shape
    return int(np.minimum.reduce([rows, columns, height - 1 - rows, width - 1 - columns]).max()) + 1
