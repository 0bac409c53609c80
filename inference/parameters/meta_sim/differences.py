"""The derivative of a cost of scenes by the values of their sites, through a renderer that has none.

Each value of each node is moved a little to both sides, all else stays as it is, and the scene is rendered again. The
central difference of the image's features is multiplied by the cost's derivative by them [1]:

    d cost / d u = d cost / d f . (f(u + h) - f(u - h)) / 2 h.

A scene costs ``1 + 2 x nodes x sites`` renders: one of five nodes with four sites is rendered and looked at 41 times.
Of a batch some values can be chosen at random instead, whose derivatives are scaled up: unbiased, and more scenes can
take part in the cost for the same number of renders.

Axis letters: N scenes, M nodes, S sites of nodes, G sites of scenes, D features, R values that are moved.

References:
    [1] Kar et al., *Meta-Sim: Learning to Generate Synthetic Datasets*, ICCV 2019.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from pyro.poutine.messenger import Messenger
from torch import Tensor

from probscene.derivation import Derivation
from probscene.derive import derive_complete
from probscene.model import SceneModel
from probscene.policy import Policy
from probscene.sampling import Scenes, run_program

from ..graph import ClassNodes, SceneGraph
from ..sites import U_EPS, Site, of_scenes, quantiles_of, with_handlers

AT_ONCE = 256  # scenes that a program is run on

Embed = Callable[[Scenes], Tensor]
"""Renders scenes and gives their features ``(N, D)``."""


class SampledScenes(NamedTuple):
    """Scenes with the prior's parameters, and the u of their sites.

    Attributes:
        derivation: N of them.
        parameters: values of all sites.
        class_nodes, graph: of the nodes that have a class.
        of_scene, of_nodes: ``(N, G)`` and ``(N, M, S)`` u; NaN where there are none.
    """

    derivation: Derivation
    parameters: dict[str, Tensor]
    class_nodes: ClassNodes
    graph: SceneGraph
    of_scene: Tensor
    of_nodes: Tensor

    @staticmethod
    def sample(model: SceneModel, structure: Policy, sites: tuple[Site, ...], num: int) -> "SampledScenes":
        """``num`` scenes of a policy."""
        derivation = derive_complete(model.grammar, structure, num, model.max_steps)[0]
        scenes = run_program(model, derivation)
        found = quantiles_of(model, scenes)
        class_nodes = ClassNodes.from_derivation(model.grammar, model.classes, derivation)
        there = (class_nodes.kind >= 0).unsqueeze(-1)
        nodes = [class_nodes.gather(found[site.name]) for site in sites if not site.of_scene]
        scene = [of_scenes(found[site.name]) for site in sites if site.of_scene]
        return SampledScenes(
            derivation,
            scenes.parameters,
            class_nodes,
            SceneGraph.from_nodes(class_nodes.kind, class_nodes.parent),
            torch.cat(scene, 1) if scene else torch.zeros(num, 0),
            torch.stack(nodes, -1).where(there, torch.nan) if nodes else torch.zeros(*class_nodes.kind.shape, 0),
        )


def with_values(
    model: SceneModel,
    sites: tuple[Site, ...],
    drawn: SampledScenes,
    scene: Tensor,
    nodes: Tensor,
    rows: Tensor | slice = slice(None),
) -> Scenes:
    """Scenes of ``drawn`` with other values at their sites.

    Args:
        model: with the prior's parameters.
        sites: those with other values, in the order of the program.
        scene, nodes: their u, ``(R, G)`` and ``(R, M, S)``; not looked at where there are none.
        rows: which scenes of ``drawn``, ``(R,)``; all where left out.
    """
    class_nodes = ClassNodes(*(part[rows] for part in drawn.class_nodes))
    scene = scene.where(~drawn.of_scene[rows].isnan(), torch.nan)
    nodes = nodes.where(~drawn.of_nodes[rows].isnan(), torch.nan)
    u, none = {}, torch.full(class_nodes.place.shape, torch.nan)
    for site in sites:
        column = sum(other.of_scene == site.of_scene for other in sites[: sites.index(site)])
        u[site.name] = scene[:, column : column + 1] if site.of_scene else class_nodes.scatter(nodes[..., column], none)
    values = {name: value[rows] for name, value in drawn.parameters.items()}
    return run_program(with_handlers(model, At(u, values)), drawn.derivation[rows])


class Differences:
    """Features of scenes with other values at their sites, and derivatives.

    Args:
        model: with the prior's parameters.
        sites: those with other values, in the order of the program.
        embed: renders scenes and gives their features.
        difference: h, in u.
        most: values of a batch that are moved; all where None.
    """

    def __init__(
        self, model: SceneModel, sites: tuple[Site, ...], embed: Embed, difference: float, most: int | None = None
    ):
        self.model, self.sites, self.embed, self.difference, self.most = model, sites, embed, difference, most

    @torch.no_grad()
    def features(self, drawn: SampledScenes, scene: Tensor, nodes: Tensor) -> Tensor:
        """``(N, D)`` of all scenes of ``drawn`` with other values, see ``with_values``."""
        return self.embed(with_values(self.model, self.sites, drawn, scene, nodes))

    @torch.no_grad()
    def gradient(self, drawn: SampledScenes, scene: Tensor, nodes: Tensor, slope: Tensor) -> tuple[Tensor, Tensor]:
        """The cost's derivative by u, ``(N, G)`` and ``(N, M, S)``; 0 where there are none.

        Args:
            scene, nodes: where, see ``with_values``.
            slope: ``(N, D)`` the cost's derivative by the features there.
        """
        (N, G), (_, M, S) = scene.shape, nodes.shape
        u = torch.cat([scene, nodes.flatten(1)], 1).clamp(U_EPS, 1 - U_EPS)  # (N, G + M S)
        there = ~torch.cat([drawn.of_scene, drawn.of_nodes.flatten(1)], 1).isnan()
        found, chosen = torch.zeros_like(u), there.nonzero()
        share = 1.0
        if self.most is not None and len(chosen) > self.most:
            share = self.most / len(chosen)
            chosen = chosen[torch.randperm(len(chosen))[: self.most]]
        for entries in chosen.split(AT_ONCE // 2):
            rows, columns = entries.unbind(1)
            index = torch.arange(len(rows))
            sides = u[rows].expand(2, -1, -1).clone()  # (2, R, G + M S)
            for side, sign in zip(sides, (1, -1), strict=True):
                side[index, columns] = (side[index, columns] + sign * self.difference).clamp(U_EPS, 1 - U_EPS)
            both = sides.flatten(0, 1)
            values = both[:, :G], both[:, G:].view(len(both), M, S)
            up, down = self.embed(with_values(self.model, self.sites, drawn, *values, rows.repeat(2))).chunk(2)
            apart = sides[0, index, columns] - sides[1, index, columns]
            found[rows, columns] = ((up - down) * slope[rows]).sum(1) / (apart * share)
        return found[:, :G], found[:, G:].view(N, M, S)


class At(Messenger):
    """Inside it a program's sites have given values.

    Args:
        u: by site, ``(N, M)`` or ``(N, 1)`` values in the CDF of what the program samples from; NaN where there are
            none.
        values: by site, as they are, for all that has no u.
    """

    def __init__(self, u: dict[str, Tensor], values: dict[str, Tensor]):
        super().__init__()
        self.u, self.values = u, values

    def _pyro_sample(self, msg: Any) -> None:
        name, fn = msg["name"], msg["fn"]
        if name not in self.values:
            return
        width = fn.batch_shape[-1]  # fewer scenes can have fewer nodes
        value = self.values[name][:, :width]
        if name in self.u:
            u = self.u[name][:, :width]
            value = value.where(u.isnan(), fn.icdf(u.nan_to_num(0.5).clamp(U_EPS, 1 - U_EPS)))
        msg["value"] = value
