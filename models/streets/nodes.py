"""The nodes of driving scenes with their parameters, and questions that a layout asks of them.

Axis letters: N scenes, M nodes.
"""

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from probscene.scene import SceneGraph

from .parameters import PARAMETERS

VEHICLES, WALKS = ("car", "van", "truck"), ("sidewalk", "shoulder")
THINGS = (*VEHICLES, "pole", "sign", "pedestrian", "object", "cyclist", "bush", "tree", "building")


class Nodes:
    """Draws every parameter of the scenario. Make it inside ``pyro.plate("scenes", N, dim=-2)``.

    Args:
        graph: the scene graph.
        scenario: ``"city"``, ``"suburban"`` or ``"rural"``.

    Attributes:
        things: the kinds that stand on the street.
        walk: how the scenario calls what is beside the road.
    """

    def __init__(self, graph: SceneGraph, scenario: str):
        self.graph, self.scenario = graph, scenario
        self.things = tuple(kind for kind in THINGS if self.has(kind))
        self.walk = next(kind for kind in WALKS if self.has(kind))
        self.parameters = {}
        for kind, ranges in PARAMETERS[scenario].items():
            if self.has(kind):
                with graph.nodes(kind):
                    for name, limits in ranges.items():
                        self.parameters[kind, name] = pyro.sample(f"{kind}.{name}", dist.Uniform(*limits))

    def has(self, kind: str) -> bool:
        """Whether the grammar has such objects."""
        return kind in self.graph.grammar.kinds

    def parameter(self, kind: str, name: str) -> Tensor:
        """``(N, M)``, a parameter of the nodes of a kind."""
        return self.parameters[kind, name]

    def only(self, kind: str, name: str) -> Tensor:
        """``(N, 1)``, a parameter of the one node of a kind; 0 in a scene without it."""
        return self.single(self.graph.mask(kind), self.parameter(kind, name))

    def single(self, mask: Tensor, value: Tensor) -> Tensor:
        """``(N, 1)``, the value of the one node in the mask; 0 in a scene without it."""
        return (value * mask).sum(1, keepdim=True)

    def thing_parameter(self, name: str) -> Tensor:
        """``(N, M)``, every thing's own parameter; 1 elsewhere."""
        value = torch.ones(self.graph.kind.shape)
        for kind in self.things:
            value = torch.where(self.graph.mask(kind), self.parameter(kind, name), value)
        return value

    def among(self, *kinds: str) -> Tensor:
        """``(N, M)`` bool, the nodes of those of the kinds that the grammar has."""
        return self.graph.mask(*(kind for kind in kinds if self.has(kind)))

    def below(self, kind: str) -> Tensor:
        """``(N, M)`` bool, the children of nodes of a kind."""
        return self.graph.of_parent(self.graph.mask(kind).float()) > 0

    def largest_child(self, value: Tensor) -> Tensor:
        """``(N, M)``, the largest of the children's non-negative values, 0 where there are none."""
        return self._of_children(value, "amax")

    def sum_of_children(self, value: Tensor) -> Tensor:
        """``(N, M)``, 0 where there are none."""
        return self._of_children(value, "sum")

    def _of_children(self, value: Tensor, how: str) -> Tensor:
        N, M = value.shape
        above = self.graph.parent.where(self.graph.parent >= 0, M)
        return torch.zeros(N, M + 1).scatter_reduce(1, above, value, how)[:, :M]

    def together(self, mask: Tensor, line: Tensor) -> Tensor:
        """``(N, M, M)`` bool, which nodes in the mask have the same parent and the same line."""
        parent = self.graph.parent
        same = (parent[:, :, None] == parent[:, None, :]) & (line[:, :, None] == line[:, None, :])
        return same & mask[:, :, None] & mask[:, None, :]
