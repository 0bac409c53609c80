"""The network of a parameter guide: what each site's mixture depends on.

Sites come in the order of the program. Within a site, the nodes that have it come in the order of their derivation,
parents before children. A node's mixture depends on the scene's sites and the number of nodes of each kind, its kind,
its place among its siblings, its own earlier sites and the mean of its siblings', its parent and its sibling before
with all that is known of them, the siblings that have the site and are like it (``mates``), and, through a GRU, on the
nodes before it that have the site. Axis letters: N scenes, M nodes, R nodes that have a site, S sites of nodes, G sites
of scenes, H units.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .graph import SceneGraph
from .mixture import LogisticMixture
from .sibling_encoder import LOGITS, SiblingEncoder, SiblingLinks

COMPONENTS = 6
MAX_SIBLINGS = 40  # ranks and numbers of siblings from here on are one
LOCATION_SPREAD = 0.3  # spread of the first components' locations, in logits: components that are equal stay equal


class ParameterNet(nn.Module):
    """Mixtures for the sites of nodes and of scenes.

    Args:
        kinds: how many the grammar has.
        node_sites, scene_sites: S and G, those that are learnt.
        hidden: H.
        before: how many of the scenes' sites come before each of the nodes' sites; all where None.
        components: of each mixture.
    """

    def __init__(
        self,
        kinds: int,
        node_sites: int,
        scene_sites: int,
        hidden: int = 64,
        before: Sequence[int] | None = None,
        components: int = COMPONENTS,
    ):
        super().__init__()
        self.before = tuple(before) if before is not None else (scene_sites,) * node_sites
        self.kinds, self.node_sites, self.scene_sites = kinds, node_sites, scene_sites
        S, G, K = node_sites, scene_sites, 3 * components
        self.of_kind = nn.Embedding(kinds + 1, hidden)
        self.of_site = nn.Embedding(max(S, 1), hidden)
        self.of_rank, self.of_number = nn.Embedding(MAX_SIBLINGS + 1, hidden), nn.Embedding(MAX_SIBLINGS + 1, hidden)
        self.of_scene = nn.Linear(kinds + 3 * G, hidden)
        self.of_place = nn.Linear(6, hidden)
        self.of_values = nn.Linear(9 * max(S, 1), hidden)
        self.of_siblings = nn.Linear(3 * max(S, 1), hidden)
        self.mates = SiblingEncoder(S, hidden)
        self.read = nn.Linear(hidden + 3 * S, hidden)
        self.cell = nn.GRU(hidden, hidden, batch_first=True)
        self.join = nn.Sequential(nn.Linear(2 * hidden, hidden), nn.SiLU(), nn.Linear(hidden, hidden), nn.SiLU())
        self.out = nn.ModuleList(nn.Linear(hidden, K) for _ in range(S))
        self.scene_join = nn.ModuleList(nn.Sequential(nn.Linear(hidden, hidden), nn.SiLU()) for _ in range(G))
        self.scene_out = nn.ModuleList(nn.Linear(hidden, K) for _ in range(G))
        for layer in (*self.out, *self.scene_out):
            init_to_prior(cast(nn.Linear, layer))

    def scene_mixture(self, graph: SceneGraph, scene: Tensor, g: int) -> LogisticMixture:
        """Of the scenes' site number ``g``, ``(N, 1)``, given those before it.

        Args:
            scene: ``(N, G)`` u, NaN where they are not known.
        """
        known = scene.where(torch.arange(self.scene_sites) < g, torch.nan)
        return LogisticMixture.from_raw(
            self.scene_out[g](self.scene_join[g](F.silu(self._scene(graph, known)))).unsqueeze(1)
        )

    def node_mixture(self, graph: SceneGraph, scene: Tensor, values: Tensor, s: int) -> LogisticMixture:
        """Of the nodes' site number ``s``, ``(N, M)``, given all before it; the uniform one where a node's is NaN.

        Args:
            scene: ``(N, G)`` u, NaN where they are not known.
            values: ``(N, M, S)`` u, NaN where there are none; those of later sites are not looked at.
        """
        given = self.given(graph, scene, values, s, NodeSubset.from_mask(~values[..., s].isnan()))
        return LogisticMixture.from_raw(given.subset.scatter(self._raw_of(given, values, s)))

    def subset_mixture(self, given: "Conditioning", values: Tensor, s: int) -> LogisticMixture:
        """``node_mixture`` of the chosen nodes alone, ``(N, R)``."""
        return LogisticMixture.from_raw(self._raw_of(given, values, s))

    def _raw_of(self, given: "Conditioning", values: Tensor, s: int) -> Tensor:
        """``(N, R, 3 K)``, from what is given and the values of site ``s`` of the nodes before each."""
        u = given.subset.gather(values[..., s : s + 1]).where(given.subset.there.unsqueeze(-1), torch.nan)
        place = given.place + self.mates(given.links.place, given.links.last, u[..., 0])
        for number, index in enumerate((given.parent, given.before)):
            place = place + self._of_one(self.of_values, number + 1, gather_nodes(u, index), s)
        states, _ = self.cell(F.silu(given.gru_input + self._of_one(self.read, 0, u, s)))
        return self._raw(place, F.pad(states, (0, 0, 1, 0))[:, :-1], s)

    def sample(self, graph: SceneGraph, scene: Tensor, values: Tensor, s: int, v: Tensor, has: Tensor) -> Tensor:
        """u of the nodes' site number ``s``, ``(N, M)``, at the quantiles ``v (N, M)``, one node after the other.

        Args:
            scene, values: as of ``node_mixture``, without site ``s``.
            has: ``(N, M)`` bool, which nodes have the site; others keep ``v``.
        """
        some = NodeSubset.from_mask(has)
        nodes, at = NodeSequence(self, self.given(graph, scene, values, s, some), s), v.gather(1, some.index)
        for r in range(some.index.shape[1]):
            nodes.append(nodes.mixture().icdf(at[:, r]))
        return some.scatter(nodes.u)[..., 0].where(has, v)

    def given(
        self,
        graph: SceneGraph,
        scene: Tensor,
        values: Tensor,
        s: int,
        some: "NodeSubset",
        links: SiblingLinks | None = None,
    ) -> "Conditioning":
        """What some nodes' mixtures depend on, without the values of site ``s`` itself.

        Args:
            graph, scene, values: as of ``node_mixture``.
            s: number of the site.
            some: the nodes.
            links: see ``SiblingEncoder``; found here where None.
        """
        known = values.where(torch.arange(self.node_sites) < s, torch.nan)
        own, kind = some.gather(known), graph.kind.gather(1, some.index)
        nodes = (graph.parent.gather(1, some.index), graph.before.gather(1, some.index))
        around = torch.cat([encode_u(part) for part in (own, *(gather_nodes(known, node) for node in nodes))], -1)
        share = some.gather(graph.siblings) / graph.number.gather(1, some.index).clamp(min=1).unsqueeze(-1)
        place = self.of_values(around) + self.of_siblings(share.to(own.dtype) @ encode_u(known))
        start = self.of_kind(kind.remainder(self.kinds + 1)) + self.of_site.weight[s]
        return Conditioning(
            some,
            some.gather(self._place(graph, scene, s)) + place,
            self.read(torch.cat([start, encode_u(own)], -1)),
            some.position(nodes[0]),
            some.position(nodes[1]),
            self.mates.links(some.siblings(graph), own) if links is None else links,
        )

    def _of_one(self, layer: nn.Linear, part: int, u: Tensor, s: int) -> Tensor:
        """What a layer adds for the values ``u (N, R, 1)`` of site ``s`` in one part of its ``encode_u``."""
        S = max(1, self.node_sites)
        first = layer.in_features - 9 * S if layer is self.of_values else layer.in_features - 3 * S
        columns = [first + 3 * S * part + s + S * i for i in range(3)]
        return F.linear(encode_u(u), layer.weight[:, columns])

    def _raw(self, place: Tensor, memory: Tensor, s: int) -> Tensor:
        return self.out[s](self.join(F.silu(torch.cat([place, memory], -1))))

    def _place(self, graph: SceneGraph, scene: Tensor, s: int) -> Tensor:
        """``(N, M, H)``, what does not change from node to node."""
        rank, number = (x.clamp(max=MAX_SIBLINGS) for x in (graph.rank, graph.number))
        scene = scene.where(torch.arange(self.scene_sites) < self.before[s], torch.nan)
        ranks = [graph.rank, graph.same_rank]
        numbers = [graph.number.clamp(min=1), graph.same_number.clamp(min=1)]
        part = [(r + 0.5) / n for r, n in zip(ranks, numbers, strict=True)] + [1 / n for n in numbers]
        part += [1.0 * (graph.rank == 0), 1.0 * (graph.rank == graph.number - 1)]
        return (
            self.of_kind(graph.kind.remainder(self.kinds + 1))
            + self.of_site.weight[s]
            + self.of_rank(rank)
            + self.of_number(number)
            + self.of_place(torch.stack(part, -1).to(scene.dtype))
            + self._scene(graph, scene).unsqueeze(1)
        )

    def _scene(self, graph: SceneGraph, scene: Tensor) -> Tensor:
        counts = F.one_hot(graph.kind.remainder(self.kinds + 1), self.kinds + 1).sum(1)[:, : self.kinds]
        return self.of_scene(torch.cat([counts.to(scene.dtype).log1p(), encode_u(scene)], -1))


class NodeSubset(NamedTuple):
    """Some of a scene's nodes, in their order: R at most, those of a scene first.

    Attributes:
        index: ``(N, R)`` int64 which nodes.
        there: ``(N, R)`` bool, False where a scene has fewer.
        has: ``(N, M)`` bool, which are chosen.
    """

    index: Tensor
    there: Tensor
    has: Tensor

    @staticmethod
    def from_mask(has: Tensor) -> "NodeSubset":
        """Those that have something, ``(N, M)`` bool; at least one is looked at in each scene."""
        R = max(1, int(has.sum(1).max()) if len(has) else 1)
        index = (~has).long().argsort(dim=1, stable=True)[:, :R]
        return NodeSubset(index, has.gather(1, index), has)

    def gather(self, part: Tensor) -> Tensor:
        """``(N, R, ...)`` of ``(N, M, ...)``."""
        return part.gather(1, self.index.unsqueeze(-1).expand(-1, -1, part.shape[2]))

    def position(self, node: Tensor) -> Tensor:
        """``(N, R)`` where among those chosen each of the nodes ``(N, R)`` is; -1 where it is none of them."""
        place = (self.has.cumsum(1) - 1).where(self.has, -1).gather(1, node.clamp(min=0))
        return place.where((node >= 0) & self.there, -1)

    def siblings(self, graph: SceneGraph) -> Tensor:
        """``(N, R, R)`` bool, who is whose sibling among them, itself included."""
        together = self.gather(graph.siblings).gather(2, self.index.unsqueeze(1).expand(-1, self.index.shape[1], -1))
        return together & (self.there.unsqueeze(1) & self.there.unsqueeze(2))

    def scatter(self, part: Tensor) -> Tensor:
        """``(N, M, D)`` of ``(N, R, D)``; 0 for the others."""
        place = (self.has.cumsum(1) - 1).clamp(min=0).unsqueeze(-1).expand(-1, -1, part.shape[2])
        return part.gather(1, place).where(self.has.unsqueeze(-1), 0.0)


class Conditioning(NamedTuple):
    """Of the nodes that have a site.

    Attributes:
        subset: which nodes they are.
        place: ``(N, R, H)`` of the mixture.
        gru_input: ``(N, R, H)`` of the GRU.
        parent, before: ``(N, R)`` int64 which of them; -1 for none.
        links: see ``SiblingEncoder``.
    """

    subset: "NodeSubset"
    place: Tensor
    gru_input: Tensor
    parent: Tensor
    before: Tensor
    links: SiblingLinks

    def select(self, rows: Tensor) -> "Conditioning":
        """Of some of the scenes."""
        return Conditioning(
            NodeSubset(*(part[rows] for part in self.subset)),
            self.place[rows],
            self.gru_input[rows],
            self.parent[rows],
            self.before[rows],
            SiblingLinks(*(part[rows] for part in self.links)),
        )


class NodeSequence:
    """The nodes of scenes that have a site, one after the other: each one's mixture, given the u of those before.

    Args:
        net: the network.
        given: what the mixtures depend on beside that.
        s: number of the site.

    Attributes:
        u: ``(N, R, 1)`` of the nodes so far; NaN for the others.
    """

    def __init__(self, net: ParameterNet, given: Conditioning, s: int):
        self.net, self.given, self.s, self.done = net, given, s, 0
        self.u = given.place.new_full((*given.subset.index.shape, 1), torch.nan)  # what nodes depend on comes earlier
        self.memory = given.place.new_zeros(len(self.u), net.cell.hidden_size)

    def mixture(self) -> LogisticMixture:
        """Of the next node of each scene, ``(N,)``."""
        net, given, here = self.net, self.given, slice(self.done, self.done + 1)
        place = given.place[:, here] + net.mates(given.links.place[:, here], given.links.last[:, here], self.u[..., 0])
        for number, index in enumerate((given.parent, given.before)):
            place = place + net._of_one(net.of_values, number + 1, gather_nodes(self.u, index[:, here]), self.s)
        return LogisticMixture.from_raw(net._raw(place[:, 0], self.memory, self.s))

    def append(self, u: Tensor) -> None:
        """Go on, with the next node's u ``(N,)``."""
        net, r, w = self.net, self.done, cast(Any, self.net.cell)  # torch names its weights as it makes them
        found = u.where(self.given.subset.there[:, r], torch.nan)[:, None, None]
        self.u = torch.cat([self.u[:, :r], found, self.u[:, r + 1 :]], 1)
        x = F.silu(self.given.gru_input[:, r] + net._of_one(net.read, 0, found, self.s)[:, 0])
        self.memory = torch.gru_cell(x, self.memory, w.weight_ih_l0, w.weight_hh_l0, w.bias_ih_l0, w.bias_hh_l0)
        self.done += 1

    def select(self, rows: Tensor) -> None:
        """Go on with some of the scenes, ``(N',)``; one may come several times."""
        self.given, self.u, self.memory = self.given.select(rows), self.u[rows], self.memory[rows]


@torch.no_grad()
def init_to_prior(layer: nn.Linear) -> None:
    """The last layer of a mixture from its beginning, the prior."""
    nn.init.zeros_(layer.weight)
    nn.init.zeros_(layer.bias)
    _, location, _ = layer.bias.chunk(3)
    location.copy_(LOCATION_SPREAD * torch.linspace(-1, 1, len(location)))


def encode_u(u: Tensor) -> Tensor:
    """``(..., 3 S)`` of u ``(..., S)``, NaN where it is not known: whether it is, and it, on both scales."""
    there = ~u.isnan()
    u = u.nan_to_num(0.5)
    return torch.cat([there.to(u.dtype), 2 * u - 1, u.clamp(1e-4, 1 - 1e-4).logit() / LOGITS], -1)


def gather_nodes(values: Tensor, index: Tensor) -> Tensor:
    """Entries ``(N, M, S)`` of ``values`` at nodes ``index (N, M)``; NaN for -1."""
    at = index.clamp(min=0).unsqueeze(-1).expand(-1, -1, values.shape[2])
    return values.gather(1, at).where((index >= 0).unsqueeze(-1), torch.nan)
