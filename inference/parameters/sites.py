"""The sites of a model's program whose distributions can be learnt, and their values in the prior's own scale.

A value alpha of a site is seen as ``u = F(alpha)``, with F the CDF of the site's prior given everything sampled before
it. Under the prior every u is uniform on 0..1, whatever unit alpha has.

A site that several scenarios have by one name, ``city/car.place`` and ``rural/car.place``, is one site, ``car.place``:
an image does not say which scenario it is of, and u is of each scenario's own prior. Axis letters: N scenes, M nodes.
"""

from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from pyro.poutine.messenger import Messenger
from pyro.poutine.util import site_is_subsample
from torch import Tensor
from torch.nn.functional import pad

from probscene.branching import Branching
from probscene.grammar import Grammar
from probscene.model import SceneModel
from probscene.policy import Policy
from probscene.request import Renderable
from probscene.sampling import Scenes, run_program, sample
from probscene.scenarios import JointGrammar
from probscene.support import Support

NUM_SCENES = 200  # scenes of which a model's sites are found
MIN_VALUES, MAX_POINT_MASS = 50, 0.05  # values of a site, and the share of them that are one, that show a point mass
U_EPS = 1e-6  # from 0 and 1; the logit of what is nearer is no number
LEARN = "learn"  # of a site's ``infer``
OPTED_OUT = "the program fixes it with infer={'learn': False}"  # why a site keeps its prior where that is False


@dataclass(frozen=True)
class Site:
    """A site of a model's program.

    Attributes:
        name: its own, without the scenario's.
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
        because = reason_not_learnable(fn, msg["value"], msg["infer"])
        if because:
            self.kept[name] = because
            return
        u = fn.cdf(msg["value"]).detach().clamp(U_EPS, 1 - U_EPS)
        mask = msg["mask"]
        self.found[name] = u if mask is None else u.where(torch.as_tensor(mask).expand(u.shape), torch.nan)


def reason_not_learnable(fn: Any, value: Tensor, infer: dict[str, Any] | None) -> str:
    """Why a site keeps its prior; empty where it can be learnt.

    Args:
        fn: its distribution.
        infer: what the program says of it.
    """
    if infer and infer.get(LEARN) is False:
        return OPTED_OUT
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

    A site of nodes without a class is one of the scene where each scene has one of these nodes, such as a camera. Those
    of other plates than the scene's nodes, such as decoration, keep their prior: nothing says which of them is which.
    """
    return _sites(model, model.classes)


def _sites(model: SceneModel, classes: tuple[str, ...]) -> tuple[Site, ...]:
    if isinstance(model.grammar, JointGrammar):
        return _of_all({name: part.grammar for name, part in model.scenarios}, [
            _sites(part, classes) for _, part in model.scenarios
        ])  # fmt: skip
    quantiles = Quantiles()
    scenes = sample(with_handlers(model, quantiles), model.pretraining_policy, NUM_SCENES)
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
            found.append(_of_nodes(name, with_it, model.grammar, classes))
        else:
            found.append(Site(name, (), "it belongs to no node of the scene"))
    return tuple(found)


def _of_nodes(name: str, kinds: list[str], grammar: Grammar, classes: tuple[str, ...]) -> Site:
    if any(kind in classes for kind in kinds):
        return Site(name, tuple(kinds))
    if occurs_once(grammar, kinds):
        return Site(name, ())
    return Site(name, tuple(kinds), "it belongs to no node that has a class")


def occurs_once(grammar: Grammar, kinds: list[str]) -> bool:
    """Whether every scene that a grammar derives has exactly one node of some kinds."""
    process = Branching(grammar, Support(grammar, grammar.legal[:, None, None]).uniform_table())
    numbers = [grammar.kind(kind) for kind in kinds]
    nodes = np.isin(grammar.objects.numpy()[process.rule], numbers).sum(1)
    return process.max_total(nodes) == -process.max_total(-nodes) == 1


def _of_all(grammars: dict[str, Grammar], parts: list[tuple[Site, ...]]) -> tuple[Site, ...]:
    """The sites of several scenarios, those of one name as one."""
    order = _merged([[site.name for site in sites] for sites in parts])
    found = []
    for name in order:
        own = [next((site for site in sites if site.name == name), None) for sites in parts]
        has = [site for site in own if site is not None]
        kinds = tuple(dict.fromkeys(kind for site in has for kind in site.kinds))
        without = [
            scenario
            for (scenario, grammar), site in zip(grammars.items(), own, strict=True)
            if site is None and (not kinds or set(kinds) & set(grammar.kinds))
        ]
        because = next((site.keeps for site in has if site.keeps), "")
        if not because and len({site.of_scene for site in has}) > 1:
            because = "it belongs to nodes in one scenario and to the scene in another"
        if not because and without:
            because = f"scenario {without[0]!r} does not have it"
        if not because and any(_turned_round(name, [site.name for site in sites], order) for sites in parts):
            because = "scenarios sample it in different orders"
        found.append(Site(name, kinds, because))
    return tuple(found)


def _merged(orders: list[list[str]]) -> list[str]:
    """All names, each after that which stands before it in the first list that has it."""
    whole: list[str] = []
    for order in orders:
        at = 0
        for name in order:
            if name not in whole:
                whole.insert(at, name)
            at = whole.index(name) + 1
    return whole


def _turned_round(name: str, names: list[str], order: list[str]) -> bool:
    """Whether something that comes before a name in one list comes after it in another."""
    before = names[: names.index(name)] if name in names else []
    return any(order.index(other) > order.index(name) for other in before)


def site_name(grammar: Grammar, name: str) -> str:
    """A site's own name, of its name in a program: without the names of scenarios."""
    while isinstance(grammar, JointGrammar):
        scenario, _, own = name.partition("/")
        if scenario not in grammar.parts:
            break
        grammar, name = grammar.parts[scenario], own
    return name


def _unlike_uniform(u: Tensor | None) -> str:
    """Why the u of a site is not uniform under its prior; empty where nothing says so."""
    if u is None:
        return ""
    there = u[~u.isnan()]
    if len(there) < MIN_VALUES:
        return ""
    most = int(there.unique(return_counts=True)[1].max())
    return "its prior has a point mass" if most > MAX_POINT_MASS * len(there) else ""


def _masked_as_nodes(mask: Tensor, kind: Tensor) -> bool:
    """Whether a site with one value a scene stands on a plate of nodes, of which there is one."""
    return mask.shape == kind.shape and not mask.all()


def quantiles_of(model: SceneModel, scenes: Scenes) -> dict[str, Tensor]:
    """The u of all sites that have one by their own names, see ``Quantiles``; the program is run again on the scenes'
    own values. Those of several scenarios are all ``(N, M)``."""
    quantiles = Quantiles()
    run_program(with_handlers(model, quantiles), scenes.derivation, scenes.parameters)
    if not isinstance(model.grammar, JointGrammar):
        return quantiles.found
    M, found = scenes.derivation.trimmed().kind.shape[1], {}
    for name, u in quantiles.found.items():
        own = site_name(model.grammar, name)
        u = pad(u[:, :M], (0, max(0, M - u.shape[1])), value=torch.nan)
        found[own] = u.where(~u.isnan(), found[own]) if own in found else u
    return found


def of_scenes(u: Tensor) -> Tensor:
    """``(N, 1)`` of the u of a site of the scene ``(N, M)``, NaN but at one node or nowhere."""
    there = ~u.isnan()
    return u.nan_to_num(0.0).sum(1, keepdim=True).where(there.any(1, keepdim=True), torch.nan)


def site_mask(grammar: Grammar, sites: tuple[Site, ...], kind: Tensor) -> Tensor:
    """``(..., S)`` bool, which nodes have which of S sites, by the nodes' kinds ``(...)``; -1 pads."""
    has = torch.zeros(len(grammar.kinds) + 1, len(sites), dtype=torch.bool)  # the last is padding
    for s, site in enumerate(sites):
        has[[grammar.kind(name) for name in site.kinds], s] = True
    return has[kind]


def with_handlers(model: SceneModel, *handlers: Messenger) -> SceneModel:
    """The model, its program run inside handlers, the first one outermost; ``run_program`` hides it from others."""

    def program(num_scenes: int, structure: Policy) -> Renderable:
        with ExitStack() as stack:
            for handler in handlers:
                stack.enter_context(handler)
            return model.program(num_scenes, structure)

    return replace(model, program=program)
