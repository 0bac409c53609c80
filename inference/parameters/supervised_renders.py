"""Renders with the values of their sites: what a reader is trained on and tried on. Axis letters: N scenes, M nodes."""

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn.functional import pad

from probscene.errors import ModelError
from probscene.model import SceneModel
from probscene.policy import Policy
from probscene.sampling import Scenes, sample

from ..features.base import Examples
from .graph import ClassNodes
from .guide import Learnt, ParameterGuide
from .layout_augmentation import LayoutAugmentation
from .reader_training import SupervisedBatch
from .sites import Site, of_scenes, quantiles_of, with_handlers

Label = Callable[[Scenes], Examples]
"""Renders scenes and labels them."""


class SupervisedRenders:
    """Renders of a model with the u of some sites.

    Args:
        model: with its prior's parameters.
        label: renders and labels its scenes.
        node_sites, scene_sites: whose values are wanted.
    """

    def __init__(self, model: SceneModel, label: Label, node_sites: tuple[Site, ...], scene_sites: tuple[Site, ...]):
        self.model, self.label, self.node_sites, self.scene_sites = model, label, node_sites, scene_sites

    @torch.no_grad()
    def draw(self, num: int, policy: Policy, drawn_by: SceneModel | None = None) -> SupervisedBatch:
        """``num`` scenes of a policy.

        Args:
            drawn_by: the same model with other parameters.
        """
        return self.label_scenes(sample(self.model if drawn_by is None else drawn_by, policy, num, density=False))

    @torch.no_grad()
    def draw_augmented(self, num: int, policy: Policy, share: float) -> SupervisedBatch:
        """``num`` scenes of a policy, in a share of which sites of nodes are arranged, see ``LayoutAugmentation``; only
        draws of the prior have a u."""
        augmentation = LayoutAugmentation(self.model.grammar, frozenset(site.name for site in self.node_sites), share)
        scenes = sample(with_handlers(self.model, augmentation), policy, num, density=False)
        return self.label_scenes(scenes, augmentation.from_prior)

    @torch.no_grad()
    def draw_mixed(self, num: int, guide: ParameterGuide, prior_probability: float) -> SupervisedBatch:
        """``num`` scenes of a guide, in which each value of its sites is a draw of the prior with some probability.
        Only these have a u. So what a reader learns of u by them is proportional to the likelihood, whatever the guide
        expects, in scenes like the guide's."""
        learnt = Learnt(guide, prior_probability)
        batch = self.label_scenes(sample(with_handlers(self.model, learnt), guide.structure, num, density=False))
        u, scene = batch.u.clone(), batch.scene_u.clone()
        for s, site in enumerate(guide.node_sites):
            column = self.node_sites.index(site)
            u[..., column] = u[..., column].where(learnt.from_prior[:, : u.shape[1], s], torch.nan)
        for g, site in enumerate(guide.scene_sites):
            column = self.scene_sites.index(site)
            scene[:, column] = scene[:, column].where(learnt.scene_from_prior[:, g], torch.nan)
        return batch._replace(u=u, scene_u=scene)

    def label_scenes(self, scenes: Scenes, known: dict[str, Tensor] | None = None) -> SupervisedBatch:
        """Of scenes of the model, whatever drew their parameters.

        Args:
            known: ``(N, M)`` bool by site, the values that have a u; all where a site is not named.

        Raises:
            ModelError: the program did not sample one of the sites.
        """
        drawn, found = self.label(scenes), quantiles_of(self.model, scenes)
        self._check(found)
        for name, of in (known or {}).items():
            M = found[name].shape[1]
            found[name] = found[name].where(pad(of[:, :M], (0, max(0, M - of.shape[1]))), torch.nan)
        derivation = scenes.derivation.trimmed()
        class_nodes = ClassNodes.from_derivation(self.model.grammar, self.model.classes, derivation)
        N, M = derivation.kind.shape

        def nodes(part: Tensor, empty: float) -> Tensor:
            taken = class_nodes.gather(part[:, :M])
            return taken.where((class_nodes.kind >= 0).view(*class_nodes.kind.shape, *(1,) * (taken.ndim - 2)), empty)

        u = torch.stack([found[site.name] for site in self.node_sites], -1) if self.node_sites else torch.zeros(N, M, 0)
        scene = [of_scenes(found[site.name]) for site in self.scene_sites]
        return SupervisedBatch(
            drawn._replace(
                label=nodes(drawn.label, -1),
                centre=nodes(drawn.centre, 0.0),
                size=nodes(drawn.size, 0.0),
                visible=nodes(drawn.visible, 0.0),
            ),
            class_nodes.kind,
            class_nodes.parent,
            nodes(derivation.parent, -1),
            nodes(u, torch.nan),
            torch.cat(scene, 1) if scene else torch.zeros(N, 0),
        )

    def _check(self, found: dict[str, Tensor]) -> None:
        for site in (*self.node_sites, *self.scene_sites):
            if site.name not in found:
                raise ModelError(
                    f"expected site {site.name!r} in every call of the program of model {self.model.name!r}, got a "
                    "call without it; sample it always, inside scene.nodes(...) where only some scenes have it, or "
                    "leave it out of learning with infer={'learn': False}."
                )


def concatenate(parts: list[SupervisedBatch]) -> SupervisedBatch:
    """Several batches as one."""
    nodes = max(part.parent.shape[1] for part in parts)

    def all_of(name: str, empty: float = -1) -> Tensor:
        found = [getattr(part if name in SupervisedBatch._fields else part.drawn, name) for part in parts]
        return torch.cat([_padded(one, nodes, empty) for one in found])

    drawn = parts[0].drawn._replace(
        image=torch.cat([part.drawn.image for part in parts]),
        **{name: all_of(name) for name in ("label", "centre", "size", "visible")},
    )
    scene_u = torch.cat([part.scene_u for part in parts])
    return SupervisedBatch(drawn, all_of("kind"), all_of("parent"), all_of("group"), all_of("u", torch.nan), scene_u)


def _padded(part: Tensor, nodes: int, empty: float) -> Tensor:
    """``(N, nodes, ...)`` of ``(N, M, ...)``."""
    tail = (0, 0) * (part.ndim - 2)
    return torch.nn.functional.pad(part, (*tail, 0, nodes - part.shape[1]), value=empty)
