"""The ground of a driving scene: asphalt with its markings, raised sidewalks and medians with kerbs, fences.

Axis letters: N scenes, S strips of ground.
"""

from collections.abc import Mapping

import torch
from torch import Tensor

from probscene.mesh import Mesh, Surface
from probscene.world import Ground, Meshes

from .layout import STRIPS, Street
from .nodes import Nodes
from .placement import choice
from .strips import MARGIN, RAISED

ASPHALTS = ("asphalt", "dark", "worn")
LOOKS = {
    "city": {"walk": ("paving", "bricks"), "verge": ("paving", "bricks"), "terrain": ("paving", "gravel")},
    "suburban": {"walk": ("paving", "bricks"), "verge": ("grass", "meadow"), "terrain": ("grass", "meadow")},
    "rural": {
        "walk": ("gravel", "grass", "soil"),
        "verge": ("meadow", "grass", "soil"),
        "terrain": ("meadow", "grass", "soil"),
    },
}
MEDIANS = ("median", "median", "paving")
LAWNS = 0.5  # share of medians, and of verges in a city, that are green
BEHIND = 10.0  # metres by which slabs begin behind the camera
FENCES = {"city": (), "suburban": (0, 1, 2), "rural": (3,)}  # which of the meshes
FENCED, PANELS = {"suburban": 0.6, "rural": 0.25}, 13
MARKED = {"city": 0.85, "suburban": 0.6, "rural": 0.9}  # share of streets with lines between the lanes
EDGED = {"city": 0.35, "suburban": 0.2, "rural": 0.9}  # and with lines at their edges


def ground(nodes: Nodes, road: Street, surfaces: Mapping[str, Surface]) -> Ground:
    """The plane in strips."""
    names, looks = list(surfaces), LOOKS[nodes.scenario]

    def one_of(options: tuple[str, ...], share: Tensor) -> Tensor:
        """``(N, 1)`` index into the surfaces."""
        return torch.tensor([names.index(name) for name in options])[choice(share, len(options))[0]]

    asphalt, marks = nodes.only("street", "asphalt"), nodes.only("street", "marks")
    plain = one_of(ASPHALTS, asphalt)

    def line(kind: str, there) -> Tensor:
        return torch.where(there, one_of(tuple(f"{name}_{kind}" for name in ASPHALTS), asphalt), plain)

    marked, edged = marks < MARKED[nodes.scenario], marks < EDGED[nodes.scenario]
    wide = nodes.graph.mask("lane", "oncoming").sum(1, keepdim=True) > 2
    parted = nodes.graph.mask("median").any(1, keepdim=True)
    middle = torch.where(wide | parted, line("solid", marked), line("dashed", marked))
    cover = {"line_right": middle, "line_left": line("solid", marked)}
    cover["median"] = one_of(MEDIANS, nodes.only("median", "look"))
    for side in ("left", "right"):
        cover[f"edge_{side}"], cover[f"dash_{side}"] = line("edge", edged), line("dashed", marked)
        for strip, kind in (("walk", nodes.walk), ("verge", "verge"), ("terrain", "verge")):
            here = nodes.graph.mask(kind) & nodes.below(side)
            share = nodes.single(here, nodes.parameter(kind, "look"))
            cover[f"{strip}_{side}"] = one_of(looks[strip], share)
    surface = torch.cat([cover.get(name, plain) for name in STRIPS], 1)
    return Ground(tuple(surfaces.values()), road.edges, surface, nodes.only("street", "shift"))


def slabs(nodes: Nodes, road: Street, meshes: Mapping[str, tuple[Mesh, ...]]) -> Meshes | None:
    """Sidewalks, the median and their kerbs; None where nothing is raised."""
    scenario, graph = nodes.scenario, nodes.graph
    if not RAISED[scenario]:
        return None
    tops = {kind: max(meshes[kind], key=lambda mesh: mesh.size[0]) for kind in ("kerb", "slab", "lawn")}
    kerb, paved, green = (torch.tensor([[i]]) for i in range(3))
    stone, always = float(tops["kerb"].size[1]), torch.ones(len(graph.kind), 1, dtype=torch.bool)
    pieces = []  # mesh, the two borders, whether it is there
    for side, inner, outer, inward in (
        ("left", road.right, road.left, stone),
        ("right", road.left, road.right, -stone),
    ):
        near, far = inner(f"walk_{side}"), outer(f"walk_{side}")
        pieces += [(kerb, near, near + inward, always), (paved, near + inward, far, always)]
        if scenario == "city":
            share = nodes.single(graph.mask("verge") & nodes.below(side), nodes.parameter("verge", "look"))
            pieces.append((torch.where(share < LAWNS, green, paved), far, outer(f"verge_{side}"), always))
    right, left = road.right("median"), road.left("median")
    median = graph.mask("median").any(1, keepdim=True)
    lawn = torch.where(nodes.only("median", "look") < LAWNS, green, paved)
    pieces += [(kerb, right, right + stone, median), (kerb, left - stone, left, median)]
    pieces.append((lawn, right + stone, left - stone, median))
    mesh, first, second, there = (torch.cat([each[i].expand_as(always) for each in pieces], 1) for i in range(4))
    width = (second - first).abs()
    size = torch.tensor([mesh.size.tolist() for mesh in tops.values()])[mesh]
    scale = torch.stack([torch.ones_like(width), width / size[..., 1], RAISED[scenario] / size[..., 2]], -1)
    there = there & (width > 0.01)
    x = size[..., 0] / 2 - BEHIND
    return Meshes((), tuple(tops.values()), mesh, x, (first + second) / 2, scale=scale.clamp(min=1e-3), present=there)


def fences(nodes: Nodes, road: Street, meshes: Mapping[str, tuple[Mesh, ...]]) -> Meshes | None:
    """What parts gardens from the sidewalk, and guard rails; None in cities."""
    styles = FENCES[nodes.scenario]
    if not styles:
        return None
    style, y, there = [], [], []
    for side, inner in (("left", road.right), ("right", road.left)):
        share = nodes.single(nodes.graph.mask("verge") & nodes.below(side), nodes.parameter("verge", "fence"))
        which, _ = choice(share / FENCED[nodes.scenario], len(styles))
        style.append(torch.tensor(styles)[which])
        y.append(inner(f"verge_{side}") + (MARGIN if side == "left" else -MARGIN) / 2)
        there.append(share < FENCED[nodes.scenario])
    length = float(meshes["fence"][0].size[0])
    x = length * (0.5 + torch.arange(PANELS))
    each = [torch.cat([value.expand(-1, PANELS) for value in both], 1) for both in (style, y, there)]
    return Meshes((), meshes["fence"], each[0], x.repeat(2), each[1], present=each[2])
