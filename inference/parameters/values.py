"""Scene graphs with the u of their sites, read or known, and their density under a guide.

Axis letters: L images, M nodes, S sites of nodes, G sites of scenes.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from .graph import SceneGraph
from .net import Conditioning, NodeSubset, ParameterNet

MAX_VALUES, MIN_IMAGES = 24_000, 16  # nodes times sites that a step looks at, at most; images, at least


class Values(NamedTuple):
    """Scene graphs and the u of their sites, read or known; NaN where there are none.

    Attributes:
        kind, parent: ``(L, M)`` int64, nodes in the order of a derivation; -1 pads.
        nodes, nodes_sd: ``(L, M, S)`` u and its standard deviation.
        scene, scene_sd: ``(L, G)``.
        turns: ``(S + G,)`` bool, those read on a circle.
        weight: ``(L, M)`` how much each node counts, or ``(L, M, S)`` in each site; all count 1 where None.
        outliers: ``(S + G,)`` the share of a site's readings that say nothing of u; none where None.
    """

    kind: Tensor
    parent: Tensor
    nodes: Tensor
    nodes_sd: Tensor
    scene: Tensor
    scene_sd: Tensor
    turns: Tensor
    weight: Tensor | None = None
    outliers: Tensor | None = None

    def select(self, rows: Tensor) -> "Values":
        """Some images', without nodes that only pad."""
        kind = self.kind[rows]
        M = max(1, int((kind >= 0).sum(1).max()) if len(kind) else 1)
        return Values(
            kind[:, :M],
            self.parent[rows, :M],
            self.nodes[rows, :M],
            self.nodes_sd[rows, :M],
            self.scene[rows],
            self.scene_sd[rows],
            self.turns,
            None if self.weight is None else self.weight[rows, :M],
            self.outliers,
        )


def log_density(net: ParameterNet, values: Values) -> Tensor:
    """``(L, S + G)`` nats of the u of each site, summed over the nodes that have it, as much as each counts."""
    graph, parts = SceneGraph.from_nodes(values.kind, values.parent), []
    sites = SiteConditioning(net, graph)
    for s in range(net.node_sites):
        given = sites.given(values.scene, values.nodes, s)
        at = given.subset.gather(values.nodes[..., s : s + 1]).squeeze(-1).nan_to_num(0.5)
        found = net.subset_mixture(given, values.nodes, s).log_prob(at)
        found = given.subset.scatter(found.unsqueeze(-1)).squeeze(-1)
        if values.weight is not None:
            found = found * (values.weight if values.weight.ndim == 2 else values.weight[..., s])
        parts.append(found.sum(1))
    for g in range(net.scene_sites):
        u = values.scene[:, g]
        found = net.scene_mixture(graph, values.scene, g).log_prob(u.nan_to_num(0.5)[:, None]).squeeze(1)
        parts.append(found.where(~u.isnan(), 0.0))
    return torch.stack(parts, 1)


def images_per_step(net: ParameterNet, values: Values, most: int) -> int:
    """Fewer where each image has many values."""
    each = max(1, net.node_sites) * values.kind.shape[1]
    return max(MIN_IMAGES, min(most, MAX_VALUES // each))


class SiteConditioning:
    """The sites of nodes in their order; who is alike whom in a site is found once for sites of the same nodes."""

    def __init__(self, net: ParameterNet, graph: SceneGraph):
        self.net, self.graph = net, graph
        self.some: NodeSubset | None = None

    def given(self, scene: Tensor, nodes: Tensor, s: int) -> Conditioning:
        """What the mixtures of site ``s`` depend on."""
        some = NodeSubset.from_mask(~nodes[..., s].isnan())
        if self.some is None or not torch.equal(self.some.has, some.has):
            self.some, self.siblings, self.links, self.next = some, some.siblings(self.graph), None, 0
        own = some.gather(nodes.where(torch.arange(nodes.shape[2]) < s, torch.nan))
        self.links = self.net.mates.links(self.siblings, own, self.links, self.next)
        self.next = s
        return self.net.given(self.graph, scene, nodes, s, some, self.links)
