"""Masks as polygons, without loss: along the edges of pixels, in one line through all parts and around all holes."""

import numpy as np

_RIGHT, _DOWN, _LEFT, _UP = range(4)
_STEPS = ((1, 0), (0, 1), (-1, 0), (0, -1))


def polygon(mask: np.ndarray) -> np.ndarray:
    """The corners ``(K, 2)`` int64, x and y, of a closed polygon that holds the pixels of ``mask (H, W)``, which has
    some, and no others, by the even-odd rule and by that of non-zero winding.

    Parts and holes are joined by lines that go to and fro between the nearest corners, along the edges of pixels, and
    hold nothing.
    """
    whole, *others = outlines(mask)
    for loop in others:
        squared = ((whole[:, None] - loop) ** 2).sum(-1)
        i, j = np.unravel_index(squared.argmin(), squared.shape)
        loop = np.roll(loop, -j, 0)
        elbow = [[loop[0, 0], whole[i, 1]]]
        whole = np.concatenate([whole[: i + 1], elbow, loop, loop[:1], elbow, whole[i:]])
    return whole[(whole != np.roll(whole, 1, 0)).any(1)]


def outlines(mask: np.ndarray) -> list[np.ndarray]:
    """The corners of each outline, clockwise on the screen around parts and anticlockwise around holes; pixels that
    touch by a corner are one part."""
    inside = np.pad(mask.astype(bool), 1)
    above, below, left, right = inside[:-1, 1:-1], inside[1:, 1:-1], inside[1:-1, :-1], inside[1:-1, 1:]
    starts = []
    for direction, edges, x, y in (
        (_RIGHT, below & ~above, 0, 0), (_DOWN, left & ~right, 0, 0),
        (_LEFT, above & ~below, 1, 0), (_UP, right & ~left, 0, 1),
    ):  # fmt: skip
        rows, columns = edges.nonzero()
        starts += zip((columns + x).tolist(), (rows + y).tolist(), [direction] * len(rows), strict=True)
    edges, todo, found = set(starts), set(starts), []
    for start in starts:
        if start not in todo:
            continue
        corners, edge = [], start
        while edge in todo:
            todo.remove(edge)
            x, y, direction = edge
            x, y = x + _STEPS[direction][0], y + _STEPS[direction][1]
            turns = ((x, y, (direction + turn) % 4) for turn in (-1, 0, 1))
            edge = next(turn for turn in turns if turn in edges)
            if edge[2] != direction:
                corners.append((x, y))
        found.append(np.array(corners))
    return found
