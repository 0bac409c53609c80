"""Refinement of a parameter guide by an energy distance between what is read in its own renders and in the target.

Maximum likelihood takes a reader at its word. Where a reading is off by nature, as of an angle that is read as too
upright, so is what is learnt. Here one reader reads both sides, and its errors with them. The gradient of the energy
distance [1] by a reading goes on to the value that was drawn, as if what is read moved with it one to one, and from
there through the quantile of its mixture to the guide's weights (``ParameterNet.reparameterise``). Only the last layers
of the sites that are read with an error of some size are trained: what is read sharply, likelihood learns better.

Objects are compared kind by kind, each with its sibling before it, its place among its siblings and their number; so
are scenes.

What is read of a site with little skill hardly moves with the value, and a reader that has seen the guide's scenes
guesses what the guide expects. So such sites of scenes are learnt at the end from renders in which they have their
prior: these are weighted by the guide's density, until the weighted readings are distributed like those in the target.
Axis letters: N scenes, M nodes, G sites of scenes, L images, R rows, D entries.

Reference:
    [1] Székely, Rizzo, *Energy statistics: a class of statistics based on distances*, 2013.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple, cast

import torch
from torch import Tensor, nn

from ..training import AdamTraining
from .graph import SceneGraph
from .likelihood import Values
from .net import ParameterNet, gather_nodes, init_to_prior

MAX_ROWS = 400, 1600  # of the guide's and of the target's objects of a kind that are compared in a step, at most
RANK_UNIT, NUMBER_UNIT = 2.0, 4.0  # what one place among siblings and one object more count, in u


class GuideReadings(NamedTuple):
    """Scenes of a guide and what is read in their renders.

    Attributes:
        kind, parent: ``(N, M)`` int64 of the scenes' nodes that have a class, see ``graph.Seen``.
        nodes, scene: ``(N, M, S)`` and ``(N, G)`` u that was drawn; NaN where there is none.
        read: what is read, of objects in an order of their own.
        which: node of the scene that each object read is, as ``read.kind``; -1 for none.
    """

    kind: Tensor
    parent: Tensor
    nodes: Tensor
    scene: Tensor
    read: Values
    which: Tensor


class EnergyDistance(AdamTraining):
    """Resumable training of a ``ParameterNet``; its loss is the squared energy distance.

    Args:
        net: trained in place.
        values: what was read in the target.
        draw: so many scenes of the guide as it is, rendered and read.
        noisy: ``(S + G,)`` bool, the sites of nodes and then of scenes that are trained.
        steps: of Adam.
        scenes: a step.
        learning_rate: the largest.
        seed: of everything random.
    """

    subject = "the parameters"

    def __init__(
        self,
        net: ParameterNet,
        values: Values,
        draw: Callable[[int], GuideReadings],
        noisy: Tensor,
        steps: int = 40,
        scenes: int = 100,
        learning_rate: float = 2e-3,
        seed: int = 0,
    ):
        self.trained = noisy.tolist()
        chosen = zip((*net.out, *net.scene_out), self.trained, strict=True)
        heads = nn.ModuleList(head for head, is_trained in chosen if is_trained)
        super().__init__(heads, torch.optim.Adam(heads.parameters(), lr=learning_rate), steps, seed)
        self.net, self.values, self.draw, self.scenes = net, values, draw, scenes

    def loss(self) -> Tensor:
        """See ``AdamTraining``."""
        target = self.values.select(torch.randperm(len(self.values.kind))[: 4 * self.scenes])
        own = self.draw(self.scenes)
        with _only(self.net, self.module):
            found = energy_distance(reparameterised_readings(self.net, own, self.trained), target)
        return found + 0 * sum(weight.sum() for weight in self.module.parameters())  # where nothing can be compared


class WeightedEnergyDistance(AdamTraining):
    """Resumable training of the last layers of some sites of scenes, from the prior.

    Its loss is the squared energy distance of each site's weighted readings from what is read in the target, each
    paired with itself as well: few renders that weigh much are farther from any target than many, so that weights stay
    as even as they can.

    Args:
        net: trained in place.
        values: what was read in the target.
        own: scenes in which these sites have their prior, rendered and read.
        sites: which of the scenes' sites, of G.
        steps: of Adam.
        learning_rate: the largest.
        seed: of everything random.
    """

    subject = "the parameters"

    def __init__(
        self,
        net: ParameterNet,
        values: Values,
        own: GuideReadings,
        sites: list[int],
        steps: int = 300,
        learning_rate: float = 5e-3,
        seed: int = 0,
    ):
        trained = nn.ModuleList(net.scene_out[g] for g in sites)
        for layer in trained:
            init_to_prior(cast(nn.Linear, layer))
        super().__init__(trained, torch.optim.Adam(trained.parameters(), lr=learning_rate), steps, seed)
        self.net, self.own, self.graph = net, own, SceneGraph.from_nodes(own.kind, own.parent)
        self.sites = {g: WeightedRows.from_readings(own.read, values, g) for g in sites}

    def loss(self) -> Tensor:
        """See ``AdamTraining``."""
        with _only(self.net, self.module):
            return torch.stack([self._distance(g, rows) for g, rows in self.sites.items()]).sum()

    def _distance(self, g: int, rows: "WeightedRows") -> Tensor:
        u = self.own.scene[:, g : g + 1]
        log_q = self.net.scene_mixture(self.graph, self.own.scene, g).log_prob(u.nan_to_num(0.5))
        return rows.distance(log_q.where(~u.isnan(), 0.0)[:, 0].double().softmax(0))


class WeightedRows(NamedTuple):
    """Distances of a site's readings.

    Attributes:
        own: ``(N, N)`` of one render from another.
        across: ``(N,)`` of each render from the target's images, in the mean.
        target: of one of these images from another, in the mean.
    """

    own: Tensor
    across: Tensor
    target: float

    @staticmethod
    def from_readings(own: Values, target: Values, g: int) -> "WeightedRows":
        """Of a scene's site."""
        turns = own.turns[own.nodes.shape[2] :][g : g + 1]
        rows, others = (_placed(values.scene[:, g : g + 1].double(), turns) for values in (own, target))
        return WeightedRows(
            _distances(rows, rows), _distances(rows, others).mean(1), float(_distances(others, others).mean())
        )

    def distance(self, weight: Tensor) -> Tensor:
        """Squared energy distance of renders of weight ``(N,)``, 1 in all, from the target."""
        return 2 * weight @ self.across - weight @ self.own @ weight - self.target


@contextmanager
def _only(net: nn.Module, part: nn.Module) -> Iterator[None]:
    """Inside it, what is computed has gradients by a part of a network alone, and takes no memory for the others."""
    before = [(weight, weight.requires_grad) for weight in net.parameters()]
    net.requires_grad_(False)
    part.requires_grad_(True)
    try:
        yield
    finally:
        for weight, had in before:
            weight.requires_grad_(had)


def reparameterised_readings(net: ParameterNet, own: GuideReadings, trained: Sequence[bool]) -> Values:
    """What is read, moving with what was drawn of the sites that are trained, see ``ParameterNet.reparameterise``."""
    scene, nodes = net.reparameterise(SceneGraph.from_nodes(own.kind, own.parent), own.scene, own.nodes, trained)
    moved = (nodes - own.nodes).nan_to_num(0.0)
    moved = gather_nodes(moved, own.which).nan_to_num(0.0)
    of_scene = (scene - own.scene).nan_to_num(0.0)
    return own.read._replace(nodes=own.read.nodes + moved, scene=own.read.scene + of_scene)


def energy_distance(one: Values, other: Values) -> Tensor:
    """Squared energy distance of readings, a mean over the kinds of objects and the scenes by how often the other side
    has them."""
    total, weight = one.scene.new_zeros(()), 0.0
    rows, others = _rows(one), _rows(other)
    read, also = ~one.nodes.isnan().all(2), ~other.nodes.isnan().all(2)
    for kind in other.kind[also].unique().tolist():
        mine, theirs = read & (one.kind == kind), also & (other.kind == kind)
        here, there = rows[mine][: MAX_ROWS[0]], others[theirs][: MAX_ROWS[1]]
        if len(here) > 1 and len(there) > 1:
            number = float(theirs.sum()) * other.nodes.shape[2]
            total, weight = total + number * _energy(here, there), weight + number
    if one.scene.shape[1]:
        turns = one.turns[one.nodes.shape[2] :]
        number = float(other.scene.numel())
        distance = _energy(_placed(one.scene, turns), _placed(other.scene, turns))
        total, weight = total + number * distance, weight + number
    return total / max(weight, 1.0)


def site_rows(values: Values) -> tuple[Tensor, Tensor]:
    """``(R, D)`` what was read of the only site there is, with that of the sibling before where it is of nodes; and the
    image of each ``(R,)``."""
    if values.scene.shape[1]:
        return _placed(values.scene, values.turns), torch.arange(len(values.scene))
    image, node = (~values.nodes[..., 0].isnan()).nonzero(as_tuple=True)
    return _rows(values)[image, node, :-2], image


def _rows(values: Values) -> Tensor:
    """``(N, M, D)`` each object with its sibling before it, its place and their number."""
    graph = SceneGraph.from_nodes(values.kind, values.parent)
    own = _placed(values.nodes, values.turns[: values.nodes.shape[2]])
    before = gather_nodes(own, graph.before).nan_to_num(0.0)
    place = torch.stack([RANK_UNIT * graph.rank, NUMBER_UNIT * graph.number], -1).to(own.dtype)
    return torch.cat([own, before, place], -1)


def _placed(u: Tensor, turns: Tensor) -> Tensor:
    """u as a place in a plane: on a line, or, where it turns, on a circle that is as long; 0 where there is none."""
    there, angle, radius = ~u.isnan(), 2 * math.pi * u.nan_to_num(0.0), 1 / (2 * math.pi)
    x, y = torch.where(turns, radius * angle.cos(), u.nan_to_num(0.0)), torch.where(turns, radius * angle.sin(), 0.0)
    return torch.cat([x.where(there, 0.0), y.where(there, 0.0)], -1)


def _energy(one: Tensor, other: Tensor) -> Tensor:
    """Of rows ``(R, D)``; no row is paired with itself."""
    return 2 * _distances(one, other).mean() - _within(one) - _within(other)


def _within(rows: Tensor) -> Tensor:
    """Mean distance of one row ``(R, D)`` from another; 0 where there is one alone."""
    return _distances(rows, rows).sum() / max(1, len(rows) * (len(rows) - 1))


def _distances(one: Tensor, other: Tensor) -> Tensor:
    return torch.cdist(one, other, compute_mode="donot_use_mm_for_euclid_dist")
