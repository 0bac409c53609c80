"""The graph network that moves the values of a scene's sites.

Its graph is the scene graph: a root for the scene, which has the scene's sites, and below it the nodes that have a
class. Messages go along its edges, from parents to children and back, and from each sibling to the one before and the
one after. Values are u, see ``sites``. For each site the network gives a scale and a shift,

    logit u' = (1 + scale) logit u + shift,

which are 0 for all weights 0. So it begins as the identity, to which [1] first trains its network as an autoencoder;
that training has nothing left to do here and is left out. Unlike in [1], a node knows its place among its siblings, and
a site sees those before it in the program alone: the prior of a site may depend on them.

Axis letters: N scenes, M nodes, S sites of nodes, G sites of scenes, H units.

References:
    [1] Kar et al., *Meta-Sim: Learning to Generate Synthetic Datasets*, ICCV 2019.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..graph import SceneGraph
from ..net import MAX_SIBLINGS, encode_u
from ..sites import U_EPS

SCALE, SHIFT = 3.0, 6.0  # largest change of the scale, and of the logit


class GraphNetwork(nn.Module):
    """Moves u of nodes and of scenes.

    Args:
        kinds: how many the grammar has.
        order: of each learnt site, in the order of the program, whether it is a site of the scene.
        hidden: H.
        rounds: of message passing.
    """

    def __init__(self, kinds: int, order: tuple[bool, ...], hidden: int = 64, rounds: int = 3):
        super().__init__()
        self.kinds, self.order = kinds, order
        self.scene_sites, self.node_sites = sum(order), len(order) - sum(order)
        self.of_kind = nn.Embedding(kinds + 1, hidden)
        self.of_site = nn.Embedding(max(len(order), 1), hidden)
        self.of_place = nn.Linear(5, hidden)
        self.of_values = nn.Linear(3 * max(self.node_sites, 1), hidden)
        self.of_scene = nn.Linear(3 * max(self.scene_sites, 1) + kinds, hidden)
        self.messages = nn.ModuleList(
            nn.Sequential(nn.Linear(5 * hidden, hidden), nn.SiLU(), nn.Linear(hidden, hidden)) for _ in range(rounds)
        )
        self.out = nn.ModuleList(nn.Linear(hidden, 2) for _ in order)
        for layer in self.out:
            nn.init.zeros_(layer.get_parameter("weight"))
            nn.init.zeros_(layer.get_parameter("bias"))

    def forward(self, graph: SceneGraph, scene: Tensor, nodes: Tensor) -> tuple[Tensor, Tensor]:
        """Logits of all moved u, ``(N, G)`` and ``(N, M, S)``; finite, and of no meaning where there are none.

        Args:
            scene, nodes: u before, ``(N, G)`` and ``(N, M, S)``; NaN where there are none.
        """
        moved: tuple[list[Tensor], list[Tensor]] = [], []
        for site, of_scene in enumerate(self.order):
            moved[of_scene].append(self.site(graph, scene, nodes, site))
        N, M = graph.kind.shape
        return (
            torch.stack(moved[1], -1) if moved[1] else scene.new_zeros(N, 0),
            torch.stack(moved[0], -1) if moved[0] else nodes.new_zeros(N, M, 0),
        )

    def site(self, graph: SceneGraph, scene: Tensor, nodes: Tensor, site: int) -> Tensor:
        """Logits of the moved u of site number ``site`` of the program, ``(N,)`` or ``(N, M)``.

        Args:
            scene, nodes: as of ``forward``; those of later sites are not looked at.
        """
        column = sum(of_scene == self.order[site] for of_scene in self.order[:site])
        known = [sum(of_scene == which for of_scene in self.order[: site + 1]) for which in (False, True)]
        own = scene[:, column] if self.order[site] else nodes[..., column]
        nodes = nodes.where(torch.arange(self.node_sites) < known[0], torch.nan)
        scene = scene.where(torch.arange(self.scene_sites) < known[1], torch.nan)
        state = self._entering(graph, scene, nodes) + self.of_site.weight[site]
        for message in self.messages:
            state = state + message(F.silu(torch.cat([state, *_neighbours(graph, state)], -1)))
        scale, shift = self.out[site](F.silu(state[:, 0] if self.order[site] else state[:, 1:])).unbind(-1)
        logit = own.nan_to_num(0.5).clamp(U_EPS, 1 - U_EPS).logit()  # a gradient of 0 times NaN would be NaN
        return (1 + SCALE * torch.tanh(scale / SCALE)) * logit + SHIFT * torch.tanh(shift / SHIFT)

    def _entering(self, graph: SceneGraph, scene: Tensor, nodes: Tensor) -> Tensor:
        """``(N, 1 + M, H)``: the root, then the nodes."""
        kind = graph.kind.remainder(self.kinds + 1)
        counts = F.one_hot(kind, self.kinds + 1).sum(1)[:, : self.kinds].to(nodes.dtype).log1p()
        number = graph.number.clamp(min=1)
        place = [(graph.rank + 0.5) / number, 1 / number, graph.number.clamp(max=MAX_SIBLINGS) / MAX_SIBLINGS]
        place += [1.0 * (graph.rank == 0), 1.0 * (graph.rank == graph.number - 1)]
        of_nodes = self.of_kind(kind) + self.of_place(torch.stack(place, -1).to(nodes.dtype))
        of_nodes = of_nodes + self.of_values(encode_u(_at_least_one(nodes)))
        root = self.of_scene(torch.cat([encode_u(_at_least_one(scene)), counts], -1))
        return torch.cat([root.unsqueeze(1), of_nodes * (graph.kind >= 0).unsqueeze(-1)], 1)


def _neighbours(graph: SceneGraph, state: Tensor) -> list[Tensor]:
    """Of the root and each node, ``(N, 1 + M, H)``: its parent, the mean of its children, and the siblings before and
    after it; 0 where there are none."""
    there = (graph.kind >= 0).unsqueeze(-1).to(state.dtype)
    state = torch.cat([state[:, :1], state[:, 1:] * there], 1)
    N, M = graph.kind.shape
    above = (graph.parent + 1).where(graph.kind >= 0, 0)
    edges = F.one_hot(above, M + 1).to(state.dtype) * there  # (N, M, 1 + M)
    children = edges.transpose(1, 2) @ state[:, 1:] / edges.sum(1).clamp(min=1).unsqueeze(-1)
    parent = F.pad(edges @ state, (0, 0, 1, 0))
    follows = F.one_hot((graph.before + 1).where(graph.kind >= 0, 0), M + 1)[..., 1:].to(state.dtype)
    before, after = follows @ state[:, 1:], follows.transpose(1, 2) @ state[:, 1:]
    return [parent, children, F.pad(before, (0, 0, 1, 0)), F.pad(after, (0, 0, 1, 0))]


def _at_least_one(u: Tensor) -> Tensor:
    """u ``(..., S)``, with a site that is not known where S is 0."""
    return u if u.shape[-1] else u.new_full((*u.shape[:-1], 1), torch.nan)
