"""The network of a parameter guide: what each site's mixture depends on.

Sites come in the order of the program. Within a site, nodes come in the order of their derivation, parents before
children. A node's mixture depends on the scene's sites and the number of nodes of each kind, its kind, its place among
its siblings, its own earlier sites and the mean of its siblings', its parent and its sibling before with all that is
known of them, the siblings that are like it (``mates``), and, through a GRU, on all nodes before it. Axis letters: N
scenes, M nodes, S sites of nodes, G sites of scenes, H units.
"""

from collections.abc import Sequence
from typing import Any, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .graph import Graph
from .mates import LOGITS, Mates
from .mixture import LogisticMixture

COMPONENTS = 6
MOST = 40  # ranks and numbers of siblings from here on are one
SMALL = 0.3  # spread of the first components' locations, in logits: components that are equal stay equal


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
        self.of_rank, self.of_number = nn.Embedding(MOST + 1, hidden), nn.Embedding(MOST + 1, hidden)
        self.of_scene = nn.Linear(kinds + 3 * G, hidden)
        self.of_place = nn.Linear(6, hidden)
        self.of_values = nn.Linear(9 * max(S, 1), hidden)
        self.of_siblings = nn.Linear(3 * max(S, 1), hidden)
        self.mates = Mates(S, hidden)
        self.read = nn.Linear(hidden + 3 * S, hidden)
        self.cell = nn.GRU(hidden, hidden, batch_first=True)
        self.join = nn.Sequential(nn.Linear(2 * hidden, hidden), nn.SiLU(), nn.Linear(hidden, hidden), nn.SiLU())
        self.out = nn.ModuleList(nn.Linear(hidden, K) for _ in range(S))
        self.scene_join = nn.ModuleList(nn.Sequential(nn.Linear(hidden, hidden), nn.SiLU()) for _ in range(G))
        self.scene_out = nn.ModuleList(nn.Linear(hidden, K) for _ in range(G))
        for layer in (*self.out, *self.scene_out):
            weight, bias = cast(nn.Linear, layer).weight, cast(nn.Linear, layer).bias
            nn.init.zeros_(weight)
            nn.init.zeros_(bias)
            with torch.no_grad():
                bias[components : 2 * components] = SMALL * torch.linspace(-1, 1, components)

    def scene_mixture(self, graph: Graph, scene: Tensor, g: int) -> LogisticMixture:
        """Of the scenes' site number ``g``, ``(N, 1)``, given those before it.

        Args:
            scene: ``(N, G)`` u, NaN where they are not known.
        """
        known = scene.where(torch.arange(self.scene_sites) < g, torch.nan)
        return LogisticMixture.of(self.scene_out[g](self.scene_join[g](F.silu(self._scene(graph, known)))).unsqueeze(1))

    def node_mixture(self, graph: Graph, scene: Tensor, values: Tensor, s: int) -> LogisticMixture:
        """Of the nodes' site number ``s``, ``(N, M)``, given all before it.

        Args:
            scene: ``(N, G)`` u, NaN where they are not known.
            values: ``(N, M, S)`` u, NaN where there are none; those of later sites are not looked at.
        """
        known = values.where(torch.arange(self.node_sites) <= s, torch.nan)
        states, _ = self.cell(self._entering(graph, known, s))
        memory = F.pad(states, (0, 0, 1, 0))[:, :-1]
        own = known.where(torch.arange(self.node_sites) < s, torch.nan)
        around = [own, gathered(known, graph.parent), gathered(known, graph.before)]
        ties = self.mates.ties(graph.together, own)
        place = self._place(graph, scene, s) + self._siblings(graph, own)
        place = place + self.mates(ties.place, ties.last, known[..., s])
        return self._mixture(place, torch.cat([code(x) for x in around], -1), memory, s)

    def sample(self, graph: Graph, scene: Tensor, values: Tensor, s: int, v: Tensor, has: Tensor) -> Tensor:
        """u of the nodes' site number ``s``, ``(N, M)``, at the quantiles ``v (N, M)``, one node after the other.

        Args:
            scene, values: as of ``node_mixture``, without site ``s``.
            has: ``(N, M)`` bool, which nodes have the site; others keep ``v``.
        """
        N, M = v.shape
        earlier = torch.arange(self.node_sites) < s
        rows, columns = torch.arange(N), list(values.where(earlier, torch.nan).unbind(1))
        own = torch.stack(columns, 1)
        place, ties = self._place(graph, scene, s) + self._siblings(graph, own), self.mates.ties(graph.together, own)
        memory, found = v.new_zeros(N, self.cell.hidden_size), []
        w: Any = self.cell  # torch names its weights as it makes them
        for m in range(M):
            around = [columns[m]]
            table = torch.stack(columns[: m + 1], 1)  # parents and siblings before come earlier
            for index in (graph.parent[:, m], graph.before[:, m]):
                around.append(table[rows, index.clamp(0, m)].where((index >= 0)[:, None], torch.nan))
            known = torch.cat([code(x) for x in around], -1)
            here = place[:, m] + self.mates(ties.place[:, m : m + 1], ties.last[:, m : m + 1], table[..., s])[:, 0]
            u = self._mixture(here, known, memory, s).icdf(v[:, m]).where(has[:, m], v[:, m])
            found.append(u)
            at_s = torch.arange(self.node_sites) == s
            columns[m] = torch.where(at_s, u.where(has[:, m], torch.nan)[:, None], columns[m])
            x = self._entering_one(graph.kind[:, m], columns[m], s)
            memory = torch.gru_cell(x, memory, w.weight_ih_l0, w.weight_hh_l0, w.bias_ih_l0, w.bias_hh_l0)
        return torch.stack(found, 1)

    def moving(self, graph: Graph, scene: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
        """``scene (N, G)`` and ``values (N, M, S)`` of a sample, each with the gradient that it has as a quantile of
        the mixture that it was drawn from, what comes before it held [1].

        References:
            [1] Figurnov, Mohamed, Mnih, *Implicit reparameterization gradients*, NeurIPS 2018.
        """
        scenes = [
            self.scene_mixture(graph, scene, g).through(u[:, None].nan_to_num(0.5))[:, 0]
            for g, u in enumerate(scene.unbind(1))
        ]
        nodes = [
            self.node_mixture(graph, scene, values, s).through(u.nan_to_num(0.5))
            for s, u in enumerate(values.unbind(2))
        ]
        return (
            torch.stack(scenes, 1).where(~scene.isnan(), torch.nan) if scenes else scene,
            torch.stack(nodes, 2).where(~values.isnan(), torch.nan) if nodes else values,
        )

    def _mixture(self, place: Tensor, known: Tensor, memory: Tensor, s: int) -> LogisticMixture:
        x = torch.cat([place + self.of_values(known), memory], -1)
        return LogisticMixture.of(self.out[s](self.join(F.silu(x))))

    def _entering(self, graph: Graph, known: Tensor, s: int) -> Tensor:
        return self._entering_one(graph.kind, known, s)

    def _entering_one(self, kind: Tensor, known: Tensor, s: int) -> Tensor:
        x = torch.cat([self.of_kind(kind.remainder(self.kinds + 1)) + self.of_site.weight[s], code(known)], -1)
        return F.silu(self.read(x))

    def _place(self, graph: Graph, scene: Tensor, s: int) -> Tensor:
        """``(N, M, H)``, what does not change from node to node."""
        rank, number = (x.clamp(max=MOST) for x in (graph.rank, graph.number))
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

    def _siblings(self, graph: Graph, own: Tensor) -> Tensor:
        """``(N, M, H)``, the mean of what is known of a node's siblings and itself, of all sites before."""
        share = graph.together.to(own.dtype) / graph.number.clamp(min=1).unsqueeze(-1)
        return self.of_siblings(share @ code(own))

    def _scene(self, graph: Graph, scene: Tensor) -> Tensor:
        counts = F.one_hot(graph.kind.remainder(self.kinds + 1), self.kinds + 1).sum(1)[:, : self.kinds]
        return self.of_scene(torch.cat([counts.to(scene.dtype).log1p(), code(scene)], -1))


def code(u: Tensor) -> Tensor:
    """``(..., 3 S)`` of u ``(..., S)``, NaN where it is not known: whether it is, and it, on both scales."""
    there = ~u.isnan()
    u = u.nan_to_num(0.5)
    return torch.cat([there.to(u.dtype), 2 * u - 1, u.clamp(1e-4, 1 - 1e-4).logit() / LOGITS], -1)


def gathered(values: Tensor, index: Tensor) -> Tensor:
    """Entries ``(N, M, S)`` of ``values`` at nodes ``index (N, M)``; NaN for -1."""
    at = index.clamp(min=0).unsqueeze(-1).expand(-1, -1, values.shape[2])
    return values.gather(1, at).where((index >= 0).unsqueeze(-1), torch.nan)
