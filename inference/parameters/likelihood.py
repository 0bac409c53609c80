"""Maximum likelihood of a parameter guide on values that were read.

What is read of u has an error, which the reader tells: a normal distribution that is proportional to the likelihood of
u, since u is uniform under the prior. Each step draws u anew from it. A guide of such draws would have the readings'
errors in its own spread. So after the first steps each value is one of several draws, taken in proportion to the
guide's density. That is a draw from the posterior of u under the guide, and each step is one of stochastic EM for the
marginal likelihood of what was read [1].

Axis letters: L images, M nodes, S sites of nodes, G sites of scenes.

References:
    [1] Celeux and Diebolt, *The SEM algorithm*, Computational Statistics Quarterly 1985.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ..training import AdamTraining
from .graph import SceneGraph
from .net import Conditioning, NodeSubset, ParameterNet
from .reader import truncated_quantile
from .sites import U_EPS

UNWEIGHTED_SHARE = 0.4  # of the steps, the first ones, take what was read as it is
MAX_VALUES, MIN_IMAGES = 24_000, 16  # nodes times sites that a step looks at, at most; images, at least
NUM_CANDIDATES = 8  # draws of which one is taken


class Values(NamedTuple):
    """Scene graphs and the u of their sites, read or known; NaN where there are none.

    Attributes:
        kind, parent: ``(L, M)`` int64, nodes in the order of a derivation; -1 pads.
        nodes, nodes_sd: ``(L, M, S)`` u and its standard deviation.
        scene, scene_sd: ``(L, G)``.
        turns: ``(S + G,)`` bool, those read on a circle.
        weight: ``(L, M)`` how much each node counts; all count 1 where None.
    """

    kind: Tensor
    parent: Tensor
    nodes: Tensor
    nodes_sd: Tensor
    scene: Tensor
    scene_sd: Tensor
    turns: Tensor
    weight: Tensor | None = None

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
        )

    def site(self, number: int) -> "Values":
        """Of one site alone, of those of nodes and then of scenes."""
        node = slice(number, number + 1)
        first = max(0, number - self.nodes.shape[2])
        scene = slice(first, first + (number >= self.nodes.shape[2]))
        return Values(
            self.kind,
            self.parent,
            self.nodes[..., node],
            self.nodes_sd[..., node],
            self.scene[:, scene],
            self.scene_sd[:, scene],
            self.turns[node],
            self.weight,
        )

    def sample(self) -> "Values":
        """u drawn from what was read."""
        return self._replace(
            nodes=_drawn(self.nodes, self.nodes_sd, self.turns[: self.nodes.shape[2]]),
            scene=_drawn(self.scene, self.scene_sd, self.turns[self.nodes.shape[2] :]),
        )


def _drawn(mean: Tensor, sd: Tensor, turns: Tensor) -> Tensor:
    v = torch.rand_like(mean)
    line = truncated_quantile(mean, sd, v)
    if not turns.any():
        return line.clamp(U_EPS, 1 - U_EPS)
    circle = (mean + sd * math.sqrt(2) * torch.erfinv(2 * v - 1)).remainder(1.0)
    return torch.where(turns, circle, line).clamp(U_EPS, 1 - U_EPS)


def log_density(net: ParameterNet, values: Values) -> Tensor:
    """``(L, S + G)`` nats of the u of each site, summed over the nodes that have it, as much as each counts."""
    return draws_and_density(net, values, [])[1]


def draws_and_density(net: ParameterNet, values: Values, others: Sequence[Values]) -> tuple[Values, Tensor]:
    """u drawn from what was read and from the guide together, site by site, and its ``log_density (L, S + G)``.

    Args:
        values: u drawn from what was read alone; they are the draws where there are no others.
        others: more such draws, of which each u is one, in proportion to the guide's density given the sites before.
    """
    graph, scene, nodes = SceneGraph.from_nodes(values.kind, values.parent), values.scene.clone(), values.nodes.clone()
    for g in range(net.scene_sites if others else 0):
        some = torch.stack([other.scene[:, g] for other in others], -1)
        with torch.no_grad():
            mixture = net.scene_mixture(graph, scene, g)
            density = mixture.log_prob(some.nan_to_num(0.5).T.unsqueeze(-1)).squeeze(-1).T
        scene[:, g] = _one_of(some, density)
    weight, parts, sites = values.weight, [], _Sites(net, graph)
    for s in range(net.node_sites):
        given = sites.given(scene, nodes, s)
        if others:
            some = torch.stack([other.nodes[..., s] for other in others], -1)
            at = given.subset.gather(some).nan_to_num(0.5).movedim(-1, 0)
            with torch.no_grad():
                density = net.subset_mixture(given, nodes, s).log_prob(at).movedim(0, -1)
            nodes[..., s] = _one_of(some, given.subset.scatter(density))
        at = given.subset.gather(nodes[..., s : s + 1]).squeeze(-1).nan_to_num(0.5)
        found = given.subset.scatter(net.subset_mixture(given, nodes, s).log_prob(at).unsqueeze(-1)).squeeze(-1)
        parts.append((found if weight is None else weight * found).sum(1))
    for g in range(net.scene_sites):
        u = scene[:, g]
        found = net.scene_mixture(graph, scene, g).log_prob(u.nan_to_num(0.5)[:, None]).squeeze(1)
        parts.append(found.where(~u.isnan(), 0.0))
    return values._replace(scene=scene, nodes=nodes), torch.stack(parts, 1)


def _one_of(candidates: Tensor, log_weight: Tensor) -> Tensor:
    """One of the last axis's, by weight."""
    which = torch.distributions.Categorical(logits=log_weight).sample()
    return candidates.gather(-1, which.unsqueeze(-1)).squeeze(-1)


class _Sites:
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


class MaximumLikelihood(AdamTraining):
    """Resumable training of a ``ParameterNet``; its loss is in nats an image.

    Args:
        net: trained in place.
        values: what was read.
        steps: of Adam.
        images: a step, at most.
        learning_rate: the largest.
        seed: of everything random.
    """

    subject = "the parameters"

    def __init__(
        self,
        net: ParameterNet,
        values: Values,
        steps: int = 700,
        images: int = 200,
        learning_rate: float = 5e-3,
        seed: int = 0,
    ):
        super().__init__(net, torch.optim.Adam(net.parameters(), lr=learning_rate), steps, seed, max_grad_norm=10.0)
        self.net, self.values, self.images = net, values, images

    def loss(self) -> Tensor:
        """See ``AdamTraining``."""
        some = self.values.select(torch.randperm(len(self.values.kind))[: self._number()])
        drawn, candidates = some.sample(), 0 if self.done < UNWEIGHTED_SHARE * self.total else NUM_CANDIDATES
        others = [some.sample() for _ in range(candidates)]
        return -draws_and_density(self.net, drawn, others)[1].sum(1).mean()

    def _number(self) -> int:
        """Images a step: fewer where each has many values."""
        each = max(1, self.net.node_sites) * self.values.kind.shape[1]
        return max(MIN_IMAGES, min(self.images, MAX_VALUES // each))
