"""``ParameterGuide``: a Pyro guide whose sites are the program's own.

It runs the model's program with other distributions at the sites that are learnt. A value of such a site is
``alpha = F^-1(u)``, with F the CDF of its prior given everything before it, and u from a mixture on 0..1 that depends
on the structure and on the values before (``net``). So

    log q(T, alpha) = log q(T) + sum over sites and nodes of log q(u | before) + log p(alpha | before),

exactly, and with all of the net's weights 0 it is the prior. A site's distribution covers all nodes at once, one after
the other, so that ``poutine``, ``SVI`` and ``Predictive`` take it like any site. Sites that are not learnt are not
touched: they draw the same random numbers as under the prior. Axis letters: N scenes, M nodes.
"""

from dataclasses import replace
from typing import Any, cast

import pyro
import torch
from pyro.distributions import TorchDistribution
from pyro.poutine.messenger import Messenger
from torch import Tensor, nn

from probscene.model import SceneModel
from probscene.policy import Policy
from probscene.request import Renderable

from ..guides.base import GuideModule
from .graph import ClassNodes, SceneGraph
from .net import ParameterNet
from .sites import U_EPS, Site, site_name


class ParameterGuide(GuideModule):
    """Parameters of a model's sites, learnt; also a Pyro program, ``guide(num_scenes)``, over structure and parameters.

    Args:
        model: the scene model.
        sites: those that are learnt, in the order of the program.
        structure: the policy of the structures; the model's prior where None.
        hidden: units of the network.

    Attributes:
        prior_sites: names of sites that draw from their prior all the same; the others' distributions depend on them.
    """

    def __init__(self, model: SceneModel, sites: tuple[Site, ...], structure: Policy | None = None, hidden: int = 64):
        super().__init__()
        self.prior_sites: frozenset[str] = frozenset()
        self.model, self.sites = model, sites
        self.structure = model.prior if structure is None else structure
        self.node_sites = tuple(site for site in sites if not site.of_scene)
        self.scene_sites = tuple(site for site in sites if site.of_scene)
        before = [sum(other.of_scene for other in sites[:i]) for i, site in enumerate(sites) if not site.of_scene]
        kinds = len(model.grammar.kinds)
        self.net = ParameterNet(kinds, len(self.node_sites), len(self.scene_sites), hidden, before)

    def forward(self, num_scenes: int) -> Renderable:
        """The Pyro program: the sites ``rule_t`` and the model's own."""
        pyro.module("parameters", self.net)
        if isinstance(self.structure, nn.Module):
            pyro.module("guide", self.structure)
        return self.program(num_scenes, self.structure)

    def with_parameters(self, model: SceneModel) -> SceneModel:
        """The model with learnt parameters."""
        return replace(model, program=self.program)

    def program(self, num_scenes: int, structure: Policy) -> Renderable:
        """The model's program with learnt parameters, as ``SceneModel.program`` is called."""
        with Learnt(self):
            return self.model.program(num_scenes, structure)


class Learnt(Messenger):
    """Inside it a program's learnt sites have the guide's distributions.

    Args:
        guide: the guide.
        prior_probability: with which a value is a draw of the prior instead, each for itself: values that nothing else
            in the scene tells of, for a network to be trained on. The guide's other draws do not go by them.

    Attributes:
        class_nodes, graph: of what the program has derived; of all scenarios where it is of several.
        scene, values: u of the scene's and of the class nodes' learnt sites so far, ``(N, G)`` and ``(N, M', S)``; NaN
            where there are none. Of the guide's own draws, where the prior's take their place.
        scene_from_prior, from_prior: bool of the same shapes, which values are the prior's.
    """

    def __init__(self, guide: ParameterGuide, prior_probability: float = 0.0):
        super().__init__()
        self.guide, self.prior_probability = guide, prior_probability
        self.class_nodes: ClassNodes | None = None
        self.graph = SceneGraph.from_nodes(*torch.full((2, 0, 1), -1))
        self.scene, self.values = torch.zeros(0), torch.zeros(0)
        self.scene_from_prior, self.from_prior = torch.zeros(0), torch.zeros(0)

    def _pyro_post_derive(self, msg: Any) -> None:
        model = self.guide.model
        if msg["args"][0].rules != model.grammar.rules:
            return  # a scenario's own part of what was derived
        self.class_nodes = ClassNodes.from_derivation(model.grammar, model.classes, msg["value"])
        self.graph = SceneGraph.from_nodes(self.class_nodes.kind, self.class_nodes.parent)
        N, M = self.class_nodes.kind.shape
        self.scene = torch.full((N, len(self.guide.scene_sites)), torch.nan)
        self.values = torch.full((N, M, len(self.guide.node_sites)), torch.nan)
        self.scene_from_prior = torch.zeros_like(self.scene, dtype=torch.bool)
        self.from_prior = torch.zeros_like(self.values, dtype=torch.bool)

    def _pyro_sample(self, msg: Any) -> None:
        if self._own(msg) in self.guide.prior_sites:
            return
        learnt = self._learnt(msg)
        if learnt is not None:
            msg["fn"] = learnt

    def _pyro_post_sample(self, msg: Any) -> None:
        learnt = msg["fn"] if isinstance(msg["fn"], _OfSites) else self._learnt(msg)
        if learnt is not None:
            learnt.keep(learnt.own_u(msg["value"]))

    def _learnt(self, msg: Any) -> "_OfSites | None":
        """The distribution that the guide has for a site; None where it is not of the guide."""
        if self.class_nodes is None:
            return None
        for sites, made in ((self.guide.scene_sites, OfScenes), (self.guide.node_sites, OfNodes)):
            names = [site.name for site in sites]
            if self._own(msg) in names:
                mask = True if msg["mask"] is None else msg["mask"]
                has = torch.as_tensor(mask).expand(msg["fn"].batch_shape)
                return made(msg["fn"], self, names.index(self._own(msg)), has)
        return None

    def _own(self, msg: Any) -> str:
        return site_name(self.guide.model.grammar, msg["name"])


class _OfSites(TorchDistribution):
    """A learnt site's distribution over all scenes and nodes, ``(N, M)`` or ``(N, 1)``.

    Args:
        base: the prior's.
        learnt: of the program that runs.
        index: of the site.
        has: which nodes have it.
    """

    arg_constraints: Any = {}  # pyright: ignore[reportAssignmentType]
    has_rsample = True

    def __init__(self, base: Any, learnt: Learnt, index: int, has: Tensor):
        self.base, self.learnt, self.index, self.has = base, learnt, index, has
        self.net, self.graph, self.class_nodes = learnt.guide.net, learnt.graph, cast(ClassNodes, learnt.class_nodes)
        self.scene, self.values = learnt.scene, learnt.values
        self.drawn_u: Tensor | None = None  # of the guide, where the prior's draws may take its place
        super().__init__(base.batch_shape, validate_args=False)

    @property
    def support(self) -> Any:
        """The prior's."""
        return self.base.support

    def rsample(self, sample_shape: torch.Size = torch.Size()) -> Tensor:  # noqa: B008
        """Values; their gradient by the net's parameters goes through u."""
        if sample_shape:
            raise NotImplementedError("expected samples one batch at a time; put the number of scenes in the plate.")
        drawn = self.base.sample()
        u = self.quantile(self._u(drawn))
        value = torch.where(self.has, self.base.icdf(u), drawn)
        if not self.learnt.prior_probability:
            return value
        self.drawn_u = u
        from_prior = torch.rand(value.shape) < self.learnt.prior_probability
        self.note_prior(from_prior & self.has)
        return torch.where(from_prior, self.base.sample(), value)

    def log_prob(self, value: Tensor) -> Tensor:
        """Of each node, given the nodes and sites before; 0 where a node has none."""
        u = self.base.cdf(value).clamp(U_EPS, 1 - U_EPS)
        return (self.density(u) + self.base.log_prob(value)).where(self.has, 0.0)

    def quantile(self, v: Tensor) -> Tensor:
        """u at quantiles v."""
        raise NotImplementedError

    def density(self, u: Tensor) -> Tensor:
        """``log q(u | before)``."""
        raise NotImplementedError

    def keep(self, u: Tensor) -> None:
        """Note u, for what comes after it."""
        raise NotImplementedError

    def note_prior(self, from_prior: Tensor) -> None:
        """Note which values are the prior's."""
        raise NotImplementedError

    def own_u(self, value: Tensor) -> Tensor:
        """u of the guide's own draw, or of a value."""
        return self._u(value) if self.drawn_u is None else self.drawn_u

    def _u(self, value: Tensor) -> Tensor:
        return self.base.cdf(value).clamp(U_EPS, 1 - U_EPS)


class OfNodes(_OfSites):
    """Of a site of nodes."""

    def quantile(self, v: Tensor) -> Tensor:
        taken, has = self.class_nodes.gather(v), self.class_nodes.gather(self.has)
        return self.class_nodes.scatter(self.net.sample(self.graph, self.scene, self.values, self.index, taken, has), v)

    def density(self, u: Tensor) -> Tensor:
        values = self._with(self.values, u)
        found = self.net.node_mixture(self.graph, self.scene, values, self.index).log_prob(self.class_nodes.gather(u))
        return self.class_nodes.scatter(found, torch.zeros_like(u))

    def keep(self, u: Tensor) -> None:
        self.learnt.values = self._with(self.learnt.values, u)

    def note_prior(self, from_prior: Tensor) -> None:
        self.learnt.from_prior = self._with(self.learnt.from_prior, from_prior)

    def _with(self, values: Tensor, u: Tensor) -> Tensor:
        """The values, with u at the nodes that have it: a scenario's program leaves other scenes as they are."""
        return _put(values, self.index, self.class_nodes.gather(u), self.class_nodes.gather(self.has))


class OfScenes(_OfSites):
    """Of a site of the scene: of each, or of the one node that has it."""

    def quantile(self, v: Tensor) -> Tensor:
        return self.net.scene_mixture(self.graph, self.scene, self.index).icdf(self._one(v)).expand_as(v)

    def density(self, u: Tensor) -> Tensor:
        return self.net.scene_mixture(self.graph, self.scene, self.index).log_prob(self._one(u)).expand_as(u)

    def keep(self, u: Tensor) -> None:
        self.learnt.scene = self._with(self.learnt.scene, self._one(u))

    def note_prior(self, from_prior: Tensor) -> None:
        self.learnt.scene_from_prior = self._with(self.learnt.scene_from_prior, from_prior.any(1, keepdim=True))

    def _with(self, scene: Tensor, u: Tensor) -> Tensor:
        return _put(scene.unsqueeze(1), self.index, u, self.has.any(1, keepdim=True)).squeeze(1)

    def _one(self, values: Tensor) -> Tensor:
        """``(N, 1)``."""
        return values.where(self.has, 0.0).sum(1, keepdim=True)


def _put(values: Tensor, index: int, column: Tensor, has: Tensor) -> Tensor:
    """``values (..., S)`` with another column where ``has (...)``."""
    here = has.unsqueeze(-1) & (torch.arange(values.shape[-1]) == index)
    return torch.where(here, column.unsqueeze(-1), values)
