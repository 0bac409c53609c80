"""Where everything stands in its strip, and which way it faces. Axis letters: N scenes, M nodes."""

import math
from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from probscene.mesh import Mesh

from .layout import Street, extent, in_line, in_width
from .nodes import VEHICLES, Nodes
from .parameters import TINTS, gap
from .strips import strips

OVERHEAD = 2.0  # metres
PLANTED = 3.6  # metres across, of what stands on a median, at most
NEAR = 1.5  # places of all but plants and buildings are powers of uniform numbers: more stands near than far


class Things(NamedTuple):
    """What is where, all ``(N, M)`` at the nodes of ``nodes.things``, metres and radians; ``scale`` and ``tint`` are
    ``(N, M, 3)``; ``mesh`` is the index into the meshes of the node's kind."""

    mesh: Tensor
    x: Tensor
    y: Tensor
    z: Tensor
    yaw: Tensor
    scale: Tensor
    tint: Tensor


def things(nodes: Nodes, meshes: Mapping[str, tuple[Mesh, ...]]) -> tuple[Street, Things]:
    """The street and what stands on it."""
    graph = nodes.graph
    standing = graph.mask(*nodes.things)
    mesh = torch.zeros_like(graph.kind)
    size, base, tint = torch.zeros(*mesh.shape, 2), torch.zeros(*mesh.shape, 2), torch.ones(*mesh.shape, 3)
    for kind in nodes.things:
        mine = graph.mask(kind)
        by_size = torch.tensor([float(each.size.prod()) for each in meshes[kind]]).argsort(stable=True)
        index = by_size[choice(nodes.parameter(kind, "make"), len(meshes[kind]))[0]]
        sizes, bases = map(torch.tensor, zip(*(footprint(each, kind) for each in meshes[kind]), strict=True))
        mesh, mine = torch.where(mine, index, mesh), mine.unsqueeze(-1)
        size, base = torch.where(mine, sizes[index], size), torch.where(mine, bases[index], base)
        index, rest = choice(nodes.parameter(kind, "colour"), len(TINTS[kind]))
        tint = torch.where(mine, TINTS[kind][index] * (0.85 + 0.15 * rest.unsqueeze(-1)), tint)
    room = torch.where(nodes.below("median"), PLANTED, torch.inf)
    scale = nodes.thing_parameter("scale").minimum(room / size.amax(-1).clamp(min=1e-3)).unsqueeze(-1).repeat(1, 1, 3)
    yaw = facing(nodes) + nodes.thing_parameter("turn").where(standing, 0.0)
    length, breadth = (each * standing for each in extent(size * scale[..., :2], yaw))
    free = [gap(nodes.scenario, kind) * graph.mask(kind) for kind in nodes.things]
    length = length + sum(free, torch.zeros(()))
    road, strip = strips(nodes, length, breadth)
    near, width, start, stop, height, side, lines = (graph.of_parent(value) for value in strip)
    lines, place = lines.clamp(min=1), nodes.thing_parameter("place")
    place = torch.where(nodes.among("tree", "bush", "building"), place, place**NEAR)
    line, share = choice(nodes.thing_parameter("across"), lines)
    x = in_line(nodes.together(standing, line), place, length, start, stop)
    y = near + side * in_width(line, share, lines, width, breadth)
    ahead, aside = (base * scale[..., :2]).unbind(-1)
    x = x - (yaw.cos() * ahead - yaw.sin() * aside)
    y = y - (yaw.sin() * ahead + yaw.cos() * aside)
    return road, Things(mesh, x, y, height, yaw, scale, tint)


def footprint(mesh: Mesh, kind: str) -> tuple[list[float], list[float]]:
    """Length and width of what keeps others away, and the x and y of its middle, metres: of the mesh, but what poles
    and signs have above ``OVERHEAD`` reaches over the road and the walk."""
    low = mesh.positions[mesh.positions[:, 2] < OVERHEAD] if kind in ("pole", "sign") else mesh.positions
    first, last = low[:, :2].min(0), low[:, :2].max(0)
    return (last - first).tolist(), ((first + last) / 2).tolist()


def facing(nodes: Nodes) -> Tensor:
    """``(N, M)`` radians: vehicles along their lane, signs toward who drives by, poles and buildings toward the road,
    cyclists either way."""
    graph = nodes.graph
    on_left = graph.of_parent(nodes.below("left").float()) > 0
    two_way = graph.mask("oncoming").any(1, keepdim=True)
    toward_us = torch.where(
        nodes.among(*VEHICLES),
        nodes.below("oncoming"),
        torch.where(
            graph.mask("sign"), ~(on_left & two_way), graph.mask("cyclist") & (nodes.parameter("cyclist", "way") < 0.5)
        ),
    )
    yaw = torch.where(toward_us, math.pi, 0.0)
    toward_road = torch.where(on_left, -math.pi / 2, math.pi / 2)
    return torch.where(nodes.among("pole", "building"), toward_road, yaw)


def choice(share: Tensor, number: Tensor | int) -> tuple[Tensor, Tensor]:
    """Which of ``number`` equal parts of 0..1 holds a share, and where in it, 0..1."""
    number = torch.as_tensor(number)
    part = (share * number).floor().clamp(min=0).minimum(number - 1)
    return part.long(), share * number - part
