"""The geometry of a street: strips side by side, and in each strip things one after the other along the road.

The camera is at x = 0 in the middle of its lane, which is y = 0. Nothing stands inside anything else: the things of one
strip are spaced like uniform numbers that are sorted and pushed apart by the lengths of what stands between them, and
what does not fit within the strip's range stands farther on. Axis letters: N scenes, M nodes, S strips of ground.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from ..assets.surfaces import MARKING

GUTTER = 0.3  # metres between the line at the edge of the road and the kerb
# The strips of ground from the right to the left.
STRIPS = (
    ("terrain_right", "verge_right", "walk_right", "gutter_right", "edge_right", "lane_outer", "dash_right")
    + ("lane_inner", "line_right", "median", "line_left", "oncoming_inner", "dash_left", "oncoming_outer")
    + ("edge_left", "gutter_left", "walk_left", "verge_left", "terrain_left")
)


class Street(NamedTuple):
    """The cross-section: ``edges (N, S - 1)``, ascending y of the borders between strips."""

    edges: Tensor

    def right(self, name: str) -> Tensor:
        """``(N, 1)`` y of a strip's right border."""
        return self.edges[:, STRIPS.index(name) - 1].unsqueeze(1)

    def left(self, name: str) -> Tensor:
        """``(N, 1)`` y of a strip's left border."""
        return self.edges[:, STRIPS.index(name)].unsqueeze(1)


def street(lanes, oncoming, lane, median, walks, verges, own) -> Street:
    """The cross-section of every scene; all arguments ``(N, 1)``.

    Args:
        lanes, oncoming: how many lanes lead away from the camera, and how many toward it.
        lane: their width.
        median: its width, 0 where there is none.
        walks, verges: pairs of widths on the left and on the right.
        own: the camera's lane, 0 for the one next to the middle of the street.
    """
    line = torch.full_like(lane, MARKING)
    width = {
        "edge_right": line, "edge_left": line, "gutter_right": GUTTER, "gutter_left": GUTTER,
        "lane_inner": lane, "lane_outer": lane * (lanes > 1), "dash_right": line * (lanes > 1),
        "oncoming_inner": lane * (oncoming > 0), "oncoming_outer": lane * (oncoming > 1),
        "dash_left": line * (oncoming > 1), "line_right": line * ((oncoming > 0) | (median > 0)),
        "line_left": line * ((oncoming > 0) & (median > 0)), "median": median,
        "walk_left": walks[0], "walk_right": walks[1], "verge_left": verges[0], "verge_right": verges[1],
    }  # fmt: skip
    width = torch.cat([torch.as_tensor(width.get(name, 0.0)).expand_as(lane) for name in STRIPS], 1)
    ends = width.cumsum(1)
    own = torch.where(own > 0, STRIPS.index("lane_outer"), STRIPS.index("lane_inner"))
    return Street((ends - (ends - width / 2).gather(1, own))[:, :-1])


def in_line(together: Tensor, place: Tensor, length: Tensor, start: Tensor, stop: Tensor) -> Tensor:
    """``(N, M)`` x of the middles of things that stand one after the other.

    Args:
        together: ``(N, M, M)`` bool, whether two things stand in one line.
        place: in 0..1, decides the order and shares out what is free.
        length: of a thing along the road with what is to be free around it.
        start, stop: of its line; a line that is too full goes on beyond.
    """
    index = torch.arange(place.shape[1])
    before, here = place[:, None, :], place[:, :, None]
    before = (before < here) | ((before == here) & (index < index.unsqueeze(1)))
    taken, ahead = _sum(together, length), _sum(together & before, length)
    return start + ahead + length / 2 + place * (stop - start - taken).clamp(min=0)


def in_width(line: Tensor, share: Tensor, lines: Tensor, width: Tensor, breadth: Tensor) -> Tensor:
    """``(N, M)`` metres from a strip's border to the middles of things ``breadth`` wide.

    Args:
        line: of the ``lines`` that share the strip's width, from 0.
        share: in 0..1, where in its line.
    """
    own = width / lines
    return line * own + breadth / 2 + share * (own - breadth).clamp(min=0)


def extent(size: Tensor, yaw: Tensor) -> tuple[Tensor, Tensor]:
    """Along x and along y, of what is ``size (N, M, 2)`` and turned by ``yaw (N, M)``."""
    cos, sin = yaw.cos().abs(), yaw.sin().abs()
    return cos * size[..., 0] + sin * size[..., 1], sin * size[..., 0] + cos * size[..., 1]


def _sum(which: Tensor, value: Tensor) -> Tensor:
    return (which.float() @ value.unsqueeze(-1)).squeeze(-1)
