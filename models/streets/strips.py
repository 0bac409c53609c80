"""The strips of a driving scene: how wide every container is, where it lies and how far things stand along it.

From the middle of the road outward: lanes, gutter, sidewalk or shoulder, verge with trees, rows of buildings. A strip
is as wide as the widest thing in it. Axis letters: N scenes, M nodes.
"""

from types import MappingProxyType
from typing import NamedTuple

import torch
from torch import Tensor

from .layout import Street, street
from .nodes import Nodes

VIEW = 1.16  # metres along the road to where KITTI's camera begins to see what is a metre to the side
AHEAD, BESIDE = 7.0, 2.5  # metres: free before the camera in its own lane; of a car in another, out of sight beside it
HIDDEN = 3.0  # metres of a building that may be out of sight beside the camera
STOP = MappingProxyType({"lane": 75.0, "median": 65.0, "walk": 60.0, "city": 75.0, "suburban": 80.0, "rural": 95.0})
RAISED = MappingProxyType({"city": 0.14, "suburban": 0.12, "rural": 0.0})  # metres, height of kerbs
LINES = MappingProxyType({"city": 1, "suburban": 1, "rural": 2})  # of trees beside one another on a verge
SETBACK = MappingProxyType({"city": 0.5, "suburban": 3.0})  # metres by which fronts are out of line
CLEARANCE = 0.2  # metres between what stands on a median and the lanes
MARGIN = 0.4  # metres of a verge in which only a fence stands


class Strip(NamedTuple):
    """A container's ground, all ``(N, M)`` at the containers' nodes, metres.

    ``near`` is the y of the border from which things are placed, and ``side`` 1 if the strip goes on to the left of it,
    -1 if to the right; things stand between ``start`` and ``stop`` along the road, in ``lines`` beside one another, on
    ground of a ``height``.
    """

    near: Tensor
    width: Tensor
    start: Tensor
    stop: Tensor | float
    height: Tensor | float = 0.0
    side: Tensor | float = 1.0
    lines: Tensor | float = 1.0


def strips(nodes: Nodes, length: Tensor, breadth: Tensor) -> tuple[Street, Strip]:
    """The cross-section, and every container's strip.

    Args:
        length, breadth: ``(N, M)`` of every thing along the road, with what is free around it, and across, metres; 0
            at other nodes.
    """
    graph, widest = nodes.graph, nodes.largest_child(breadth)
    lanes, oncoming = (graph.mask(kind).sum(1, keepdim=True) for kind in ("lane", "oncoming"))
    own = torch.minimum((nodes.only("camera", "lane") * lanes).long(), lanes - 1)
    lane = (widest * nodes.among("lane", "oncoming")).amax(1, keepdim=True)
    lane = torch.maximum(nodes.only("street", "lane"), lane)
    width = {
        "median": torch.maximum(nodes.parameter("median", "width"), widest + 2 * CLEARANCE),
        nodes.walk: torch.maximum(nodes.parameter(nodes.walk, "width"), widest),
        "verge": nodes.parameter("verge", "more") + MARGIN + LINES[nodes.scenario] * widest,
    }
    median = nodes.single(graph.mask("median"), width["median"])
    walks, verges = (
        [nodes.single(graph.mask(kind) & nodes.below(side), width[kind]) for side in ("left", "right")]
        for kind in (nodes.walk, "verge")
    )
    road = street(lanes, oncoming, lane, median, walks, verges, own)
    found = [_lanes(nodes, road, lane, own), _median(nodes, road)]
    found += [strip for side in ("left", "right") for strip in _outer(nodes, road, side, width, widest, length)]
    fields = [torch.zeros(graph.kind.shape) for _ in Strip._fields]
    for mask, strip in found:
        fields = [torch.where(mask, torch.as_tensor(new), old) for new, old in zip(strip, fields, strict=True)]
    return road, Strip(*fields)


def _lanes(nodes: Nodes, road: Street, lane: Tensor, own: Tensor) -> tuple[Tensor, Strip]:
    """Lanes are derived from the left to the right."""
    graph = nodes.graph
    away, rank = graph.mask("lane"), graph.rank("lane")
    outer = torch.where(away, rank, graph.count("oncoming") - 1 - graph.rank("oncoming")) > 0
    near = torch.where(
        away,
        torch.where(outer, road.right("lane_outer"), road.right("lane_inner")),
        torch.where(outer, road.right("oncoming_outer"), road.right("oncoming_inner")),
    )
    start = torch.where(away & (rank == own), AHEAD, VIEW * (near + lane / 2).abs() - BESIDE)
    return graph.mask("lane", "oncoming"), Strip(near, lane, start, STOP["lane"])


def _median(nodes: Nodes, road: Street) -> tuple[Tensor, Strip]:
    right, left = road.right("median"), road.left("median")
    start = 1 + VIEW * torch.minimum(right.abs(), left.abs())
    strip = Strip(right + CLEARANCE, left - right - 2 * CLEARANCE, start, STOP["median"], RAISED[nodes.scenario])
    return nodes.graph.mask("median"), strip


def _outer(
    nodes: Nodes, road: Street, side: str, width: dict, widest: Tensor, length: Tensor
) -> list[tuple[Tensor, Strip]]:
    """Walk, verge and rows of one side; a second row goes on where the first ends."""
    graph, scenario, here = nodes.graph, nodes.scenario, nodes.below(side)
    sign, inner, outer = (1.0, road.right, road.left) if side == "left" else (-1.0, road.left, road.right)
    raised = RAISED[scenario]
    near = inner(f"walk_{side}")
    start = 1 + VIEW * near.abs()
    walk = Strip(near, width[nodes.walk], start, STOP["walk"], raised, sign)
    near = inner(f"verge_{side}") + sign * MARGIN
    height = raised if scenario == "city" else 0.0
    verge = Strip(near, width["verge"] - MARGIN, 1 + VIEW * near.abs(), STOP[scenario], height, sign, LINES[scenario])
    found = [(graph.mask(nodes.walk) & here, walk), (graph.mask("verge") & here, verge)]
    if nodes.has("row"):
        rows = graph.mask("row") & here
        before = nodes.together(rows, torch.zeros_like(length)).tril(-1).float()
        reach = torch.maximum(nodes.parameter("row", "length"), nodes.sum_of_children(length))
        near = outer(f"verge_{side}")
        start = VIEW * near.abs() - HIDDEN + (before @ (reach * rows).unsqueeze(-1)).squeeze(-1)
        found.append((rows, Strip(near, widest + SETBACK[scenario], start, start + reach, 0.0, sign)))
    return found
