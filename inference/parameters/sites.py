"""The sites of a model's program whose distributions can be learnt, and their values in the prior's own scale.

A value alpha of a site is seen as ``u = F(alpha)``, with F the CDF of the site's prior given everything sampled before
it. Under the prior every u is uniform on 0..1, whatever unit alpha has. Axis letters: N scenes, M nodes.
"""

from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import Any

import torch
from pyro.poutine.messenger import Messenger
from pyro.poutine.util import site_is_subsample
from torch import Tensor

from probscene.drawing import Drawing
from probscene.model import SceneModel
from probscene.policy import Policy
from probscene.sampling import Scenes, run_program, sample
from probscene.world import World

DRAWN = 200  # scenes of which a model's sites are found
ENOUGH, POINT_MASS = 50, 0.05  # values of a site, and the share of them that are one, that show a point mass
NEAR = 1e-6  # from 0 and 1; the logit of what is nearer is no number
LEARN = "learn"  # of a site's ``infer``


@dataclass(frozen=True)
class Site:
    """A site of a model's program.

    Attributes:
        name: its own.
        kinds: of the nodes that have it, by name; empty for a site of the scene.
        keeps: why it keeps its prior; empty where it can be learnt.
    """

    name: str
    kinds: tuple[str, ...]
    keeps: str = ""

    @property
    def of_scene(self) -> bool:
        """Whether each scene has one value."""
        return not self.kinds


class Quantiles(Messenger):
    """Inside it the sites that a program samples are seen as u.

    Attributes:
        found: u by site, ``(N, M)`` or ``(N, 1)``, NaN where the site's mask leaves a node out.
        kept: by site that has no u, why.
    """

    def __init__(self):
        super().__init__()
        self.found: dict[str, Tensor] = {}
        self.kept: dict[str, str] = {}

    def _pyro_post_sample(self, msg: Any) -> None:
        name, fn = msg["name"], msg["fn"]
        if site_is_subsample(msg) or name.startswith("rule_") or name == "z":
            return
        because = why_kept(fn, msg["value"], msg["infer"])
        if because:
            self.kept[name] = because
            return
        u = fn.cdf(msg["value"]).detach().clamp(NEAR, 1 - NEAR)
        mask = msg["mask"]
        self.found[name] = u if mask is None else u.where(torch.as_tensor(mask).expand(u.shape), torch.nan)


def why_kept(fn: Any, value: Tensor, infer: dict[str, Any] | None) -> str:
    """Why a site keeps its prior; empty where it can be learnt.

    Args:
        fn: its distribution.
        infer: what the program says of it.
    """
    if infer and infer.get(LEARN) is False:
        return "the program says so"
    if not value.is_floating_point() or getattr(fn.support, "is_discrete", False):
        return "it is discrete"
    if fn.event_shape:
        return "its values are vectors"
    try:
        fn.icdf(fn.cdf(value))
    except (NotImplementedError, AttributeError):
        return f"{type(fn).__name__} has no inverse CDF"
    return ""


def find_sites(model: SceneModel) -> tuple[Site, ...]:
    """A model's sites in the order of its program, from some scenes of the policy that guides are pretrained on.

    Those of other plates than the scene's nodes, such as decoration, keep their prior: nothing says which of them is
    which.
    """
    quantiles = Quantiles()
    scenes = sample(within(model, quantiles), model.pretraining_policy, DRAWN)
    kind, found = scenes.derivation.kind, []
    for name, value in scenes.parameters.items():
        mask = scenes.site_mask[name]
        because = quantiles.kept.get(name, "") or _unlike_uniform(quantiles.found.get(name))
        if because:
            found.append(Site(name, (), because))
        elif value.shape[1] == 1 and not _masked_as_nodes(mask, kind):
            found.append(Site(name, ()))
        elif mask.shape == kind.shape and not (mask & (kind < 0)).any():  # a plate of another sort may be as wide
            with_it = [model.grammar.kinds[k] for k in kind[mask & (kind >= 0)].unique().tolist()]
            seen = any(name in model.classes for name in with_it)
            found.append(Site(name, tuple(with_it), "" if seen else "it belongs to no node that has a class"))
        else:
            found.append(Site(name, (), "it belongs to no node of the scene"))
    return tuple(found)


def _unlike_uniform(u: Tensor | None) -> str:
    """Why the u of a site is not uniform under its prior; empty where nothing says so."""
    if u is None:
        return ""
    there = u[~u.isnan()]
    if len(there) < ENOUGH:
        return ""
    most = int(there.unique(return_counts=True)[1].max())
    return "its prior has a point mass" if most > POINT_MASS * len(there) else ""


def _masked_as_nodes(mask: Tensor, kind: Tensor) -> bool:
    """Whether a site with one value a scene stands on a plate of nodes, of which there is one."""
    return mask.shape == kind.shape and not mask.all()


def quantiles_of(model: SceneModel, scenes: Scenes) -> dict[str, Tensor]:
    """The u of all sites that have one, see ``Quantiles``; the program is run again on the scenes' own values."""
    quantiles = Quantiles()
    run_program(within(model, quantiles), scenes.derivation, scenes.parameters)
    return quantiles.found


def within(model: SceneModel, *handlers: Messenger) -> SceneModel:
    """The model, its program run inside handlers, the first one outermost; ``run_program`` hides it from others."""

    def program(num_scenes: int, structure: Policy) -> Drawing | World:
        with ExitStack() as stack:
            for handler in handlers:
                stack.enter_context(handler)
            return model.program(num_scenes, structure)

    return replace(model, program=program)
