"""``ParameterTransform``: draws of the prior, moved by a graph network. It is no distribution with a density.

The model's program draws a value of each site from its prior. What is used instead is ``alpha' = F^-1(u')``, with F the
CDF of the site's prior and u' what the network makes of the u of all that was drawn so far. Since u is uniform under
the prior whatever came before, the network's input does not depend on what it did to earlier sites. The random numbers
that are drawn are those of the prior. Sites that are not learnt keep theirs to the bit. Axis letters: N scenes, M
nodes, S sites of nodes, G sites of scenes.
"""

from dataclasses import replace
from typing import Any

import pyro
import torch
from pyro.poutine.messenger import Messenger
from torch import Tensor

from probscene.model import SceneModel
from probscene.policy import Policy
from probscene.request import Renderable

from ...guides.base import GuideModule
from ..graph import ClassNodes, SceneGraph
from ..sites import U_EPS, Site, of_scenes
from .network import GraphNetwork


class ParameterTransform(GuideModule):
    """Parameters of a model's sites, moved; also a Pyro program, ``transform(num_scenes)``, over structure and
    parameters.

    The log-probability of a moved site is the prior's at where it was moved to: the transform need not be invertible.

    Args:
        model: the scene model.
        sites: those that are moved, in the order of the program.
        structure: the policy of the structures; the model's prior where None.
        hidden, rounds: see ``GraphNetwork``.
    """

    def __init__(
        self,
        model: SceneModel,
        sites: tuple[Site, ...],
        structure: Policy | None = None,
        hidden: int = 64,
        rounds: int = 3,
    ):
        super().__init__()
        self.model, self.sites = model, sites
        self.structure = model.prior if structure is None else structure
        self.node_sites = tuple(site for site in sites if not site.of_scene)
        self.scene_sites = tuple(site for site in sites if site.of_scene)
        self.net = GraphNetwork(len(model.grammar.kinds), tuple(site.of_scene for site in sites), hidden, rounds)

    def forward(self, num_scenes: int) -> Renderable:
        """The Pyro program: the sites ``rule_t`` and the model's own."""
        pyro.module("parameters", self.net)
        return self.program(num_scenes, self.structure)

    def with_parameters(self, model: SceneModel) -> SceneModel:
        """The model with moved parameters."""
        return replace(model, program=self.program)

    def program(self, num_scenes: int, structure: Policy) -> Renderable:
        """The model's program with moved parameters, as ``SceneModel.program`` is called."""
        with Moved(self):
            return self.model.program(num_scenes, structure)


class Moved(Messenger):
    """Inside it a program's learnt sites have moved values.

    Args:
        transform: what moves them.

    Attributes:
        scene, nodes: u of the scene's and of the class nodes' sites so far, before they are moved, ``(N, G)`` and ``(N,
            M', S)``; NaN where there are none.
    """

    def __init__(self, transform: ParameterTransform):
        super().__init__()
        self.transform = transform
        self.class_nodes: ClassNodes | None = None
        self.graph = SceneGraph.from_nodes(*torch.full((2, 0, 1), -1))
        self.scene, self.nodes = torch.zeros(0), torch.zeros(0)

    def _pyro_post_derive(self, msg: Any) -> None:
        model = self.transform.model
        self.class_nodes = ClassNodes.from_derivation(model.grammar, model.classes, msg["value"])
        self.graph = SceneGraph.from_nodes(self.class_nodes.kind, self.class_nodes.parent)
        N, M = self.class_nodes.kind.shape
        self.scene = torch.full((N, len(self.transform.scene_sites)), torch.nan)
        self.nodes = torch.full((N, M, len(self.transform.node_sites)), torch.nan)

    def _pyro_sample(self, msg: Any) -> None:
        transform, class_nodes = self.transform, self.class_nodes
        number = next((i for i, site in enumerate(transform.sites) if site.name == msg["name"]), None)
        if class_nodes is None or number is None or msg["value"] is not None:
            return
        site, fn = transform.sites[number], msg["fn"]
        drawn = fn.sample()
        has = torch.as_tensor(True if msg["mask"] is None else msg["mask"]).expand(drawn.shape)
        u = fn.cdf(drawn).clamp(U_EPS, 1 - U_EPS)
        if site.of_scene:
            column = transform.scene_sites.index(site)
            self.scene = _put(self.scene, column, of_scenes(u.where(has, torch.nan)).squeeze(1))
        else:
            column = transform.node_sites.index(site)
            self.nodes = _put(
                self.nodes, column, class_nodes.gather(u.where(has, torch.nan)).where(class_nodes.kind >= 0, torch.nan)
            )
        moved = transform.net.site(self.graph, self.scene, self.nodes, number).sigmoid().clamp(U_EPS, 1 - U_EPS)
        moved = moved.unsqueeze(1) if site.of_scene else class_nodes.scatter(moved, torch.full_like(u, torch.nan))
        msg["value"] = torch.where(has & ~moved.isnan(), fn.icdf(moved.nan_to_num(0.5)), drawn)


def _put(values: Tensor, index: int, column: Tensor) -> Tensor:
    """``values (..., S)`` with another column."""
    return torch.where(torch.arange(values.shape[-1]) == index, column.unsqueeze(-1), values)
