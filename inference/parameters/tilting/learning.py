"""Parameters by how images look as wholes, without a reader: what it reads in photographs, of which it has seen none,
may be anything.

A round draws scenes x of the guide q, renders them, and moves q downhill in the energy distance [1] of their features
from the target's images r. With own renders x', that distance changes with the probability of a scene by

    w(x) = E |x - r| - E |x - x'|

so that exp(-eta w) q is a step of mirror descent on it, a natural gradient step of length eta [2]. Most of w is chance:
where objects stand, and noise. So the step is along v, what a linear regression on numbers of the chosen sites says of
w. The guide is fitted to it by maximum likelihood, on scenes drawn in proportion to exp(-eta v), as in the
cross-entropy method [3]; eta is as large as leaves a given effective share of them, but smaller where v could be chance
as well [6]. Distances to the target that no parameter changes, as photographs are not renders, are the same for all
scenes and weigh nothing.

Several sorts of features each have a w, in units of the gradient's norm; along their sum none of the distances grows,
as in multiple-gradient descent [4]. What is seen of labelled objects is one of them, if there are any.

Whole images move sites of the whole scene alone, such as light and camera: were places left to them, objects would
stand where photographs are dark. A site keeps its prior until w has depended on it beyond chance. Nor do they move a
site that sizes or places of objects go by. Such sites, and those of nodes, are moved by labelled objects (``objects``),
if there are any: each site is tilted by exp(-eta h), with h the part of the objects' w that it explains, less what
could be chance; nothing is left to tilt where renders and labels agree. Axis letters: N scenes, M nodes, S sites of
nodes, G sites of scenes, C classes, L images, D features.

References:
    [1] Székely and Rizzo, *Energy statistics: a class of statistics based on distances*, 2013.
    [2] Amari, *Natural gradient works efficiently in learning*, Neural Computation 1998.
    [3] Rubinstein, *The cross-entropy method for combinatorial and continuous optimization*, 1999.
    [4] Désidéri, *Multiple-gradient descent algorithm for multiobjective optimization*, 2012.
    [5] Benjamini and Hochberg, *Controlling the false discovery rate*, 1995.
    [6] Ezekiel, *Methods of correlation analysis*, 1930: the adjusted coefficient of determination.
"""

from collections.abc import Callable

import numpy as np
import torch
import torch.nn.functional as F
from scipy.optimize import root_scalar
from scipy.spatial.distance import cdist
from scipy.stats import chi2, false_discovery_control
from torch import Tensor, nn

from probscene.model import SceneModel
from probscene.policy import Policy
from probscene.sampling import seed_everything

from ...features.base import class_table
from ...statistics.energy import Features
from ...training import AdamTraining, Callback, TrainingLoop, batch_seed, of_prefix
from ..guide import ParameterGuide
from ..net import ParameterNet
from ..sites import U_EPS, Site, find_sites
from ..supervised_renders import Label, SupervisedRenders, concatenate
from ..values import Values, images_per_step, log_density
from .objects import (
    BOX,
    MIN_SD,
    Objects,
    Witness,
    aspect_of,
    basis,
    concatenate_objects,
    dependence,
    object_basis,
    object_witness,
    objects_of,
    scene_means,
    scene_witness,
    slope_of,
)
from .schedule import TiltingSchedule

RENDERS_PER_CALL = 100  # scenes that are drawn and rendered together
MAX_SCENES = 200  # of a step of the guide
FALSE_DISCOVERY_RATE = 0.05  # of the sites that are moved, at most, say nothing of images in the mean [5]
MAX_ETA = 1e3  # eta, in standard deviations of w
OBJECT_ETA = 2.0  # eta of objects, at most: a step of about the distance that is left
OBJECT_P_VALUE = 0.05  # of "labelled objects do not say which way", below which a site is moved by them
MIN_UNIT = 0.1  # share of w's standard deviation
EXACT_SD = 1e-6  # standard deviation of u that is known
Look = Callable[[Tensor], Tensor]


class TiltingLearning(TrainingLoop):
    """A ``Training`` of a ``ParameterGuide``.

    Args:
        model: the scene model.
        structure: the policy of the structures.
        label: renders and labels scenes.
        looks: give features ``(N, D)`` of images, of several sorts.
        real: the target's features ``(L, D)`` by each.
        schedule: how long.
        seed: of everything random.
        objects: of the target, those that are labelled.

    Attributes:
        unit, total, done: see ``Training``.
        sites: of the model.
        open_to: those that can be moved; of nodes only if there are labelled objects.
        dependence: ``(G, 2)`` how much w has depended on each site of scenes, and by how many degrees of freedom, until
            it was moved.
        aspects: ``(G,)`` int64 of sites of scenes, the aspect of objects' boxes that goes by it most, -1 for none;
            whole images do not move those that have one.
        aspects_of: ``(S, C)`` int64 of sites of nodes, the aspect of objects of each class.
        chosen: ``(G,)`` bool, sites of scenes that are moved.
        chosen_of: ``(S, C)`` bool, sites of nodes that are moved, of each class.
        guide: what is learnt, of all of them; None where there are none.
    """

    unit = "rounds"
    subject = "the parameters"
    seed_path = (1,)

    def __init__(
        self,
        model: SceneModel,
        structure: Policy,
        label: Label,
        looks: tuple[Look, ...],
        real: tuple[Tensor, ...],
        schedule: TiltingSchedule,
        seed: int = 0,
        objects: Objects | None = None,
    ):
        self.model, self.structure, self.looks, self.schedule = model, structure, looks, schedule
        self.real, self.objects = [features.double().numpy() for features in real], objects
        seed_everything(batch_seed(seed, 0))
        self.sites = find_sites(model)
        self.open_to = tuple(s for s in self.sites if not s.keeps and (s.of_scene or objects is not None))
        self.node_sites = tuple(site for site in self.open_to if not site.of_scene)
        self.scene_sites = tuple(site for site in self.open_to if site.of_scene)
        self.renders = SupervisedRenders(model, label, self.node_sites, self.scene_sites)
        self.guide = ParameterGuide(model, self.open_to, structure) if self.open_to else None
        S, G = len(self.node_sites), len(self.scene_sites)
        C = len(model.classes)
        self.dependence, self.chosen = torch.zeros(G, 2), torch.zeros(G, dtype=torch.bool)
        self.chosen_of = torch.zeros(S, C, dtype=torch.bool)
        self.aspects, self.aspects_of = torch.full((G,), -1), torch.full((S, C), -1)
        net = nn.Module() if self.guide is None else self.guide.net
        super().__init__(net, {}, schedule.rounds if self.open_to else 0, seed)

    @property
    def learnt(self) -> tuple[Site, ...]:
        """The sites that are chosen, in the order of the program."""
        each = zip(
            (*self.node_sites, *self.scene_sites), [*self.chosen_of.any(1).tolist(), *self.chosen.tolist()], strict=True
        )
        chosen = {site for site, is_chosen in each if is_chosen}
        return tuple(site for site in self.open_to if site in chosen)

    @property
    def by_images(self) -> tuple[Site, ...]:
        """Those of them that whole images have moved."""
        moved = (self.chosen & (self.aspects < 0)).tolist()
        return tuple(site for site, is_moved in zip(self.scene_sites, moved, strict=True) if is_moved)

    def why_not(self, site: Site) -> str:
        """Why a site is not learnt."""
        if site not in self.open_to:
            return site.keeps or "it is of single objects, and no box of one is known"
        if not site.of_scene:
            return "labelled objects do not depend on it"
        if self.aspects[self.scene_sites.index(site)] < 0:
            return "the similarity of images does not depend on it"
        if self.objects is None:
            return "sizes or places of objects go by it, and no box of one is known"
        return "sizes or places of objects go by it, and labelled ones do not say which way"

    def run(self, callback: Callback | None = None) -> None:
        """See ``Training``."""
        self._set_prior_sites()
        super().run(callback)

    def state(self) -> dict[str, Tensor]:
        """See ``Training``."""
        own = {"done": torch.tensor(self.done), "chosen": self.chosen, "dependence": self.dependence}
        own |= {"chosen_of": self.chosen_of, "aspects": self.aspects, "aspects_of": self.aspects_of}
        net = {f"guide.{key}": value for key, value in self.module.state_dict().items()}
        return {key: value.clone() for key, value in (own | net).items()}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """See ``Training``."""
        self.done, self.chosen = int(tensors["done"]), tensors["chosen"].clone()
        self.dependence, self.chosen_of = tensors["dependence"].clone(), tensors["chosen_of"].clone()
        self.aspects, self.aspects_of = tensors["aspects"].clone(), tensors["aspects_of"].clone()
        self.module.load_state_dict(of_prefix(tensors, "guide."))

    def step(self) -> float:
        """A round. Its loss is the sum of the squared energy distances of the renders that were drawn, in units of the
        target's spread."""
        guide = self.guide
        assert guide is not None
        features, values, own = self._drawn(guide, self.schedule.scenes if self.done else self.schedule.first)
        each = [witness(own_features, real) for own_features, real in zip(features, self.real, strict=True)]
        freed = [without_structure(values.kind, w) for w, _ in each]
        if not self.done:
            self._find_aspects(values, own)
        of_objects = None if self.objects is None else object_witness(own, self.objects)
        if of_objects is not None:
            freed.append(without_structure(values.kind, scene_witness(of_objects, own.images)))
        self._choose_by_images(values.scene, freed)
        slopes = {} if of_objects is None else self._slopes(values, own, of_objects)
        self._set_prior_sites()
        if self.learnt:
            weight = self._weights(values, freed, slopes)
            seed = batch_seed(self.seed, 2, self.done)
            _WeightedLikelihood(guide.net, values, *weight, self._chosen_columns, self.schedule, seed).run()
        return sum(apart for _, apart in each)

    def _find_aspects(self, values: Values, own: Objects) -> None:
        """By what each site can be judged."""
        scenes, mean = scene_means(own)
        for g in range(len(self.scene_sites)):
            self.aspects[g] = aspect_of(mean, values.scene[scenes, g], BOX)
        for c in np.unique(own.label).tolist():
            of = own.label == c
            for s in range(len(self.node_sites)):
                u = values.nodes[own.image[of], own.node[of], s]
                self.aspects_of[s, c] = -1 if u.isnan().any() else aspect_of(own.seen[of], u)

    def _choose_by_images(self, u: Tensor, freed: list[Features]) -> None:
        """Add the sites of scenes that w is known to depend on."""
        free = self.aspects < 0
        if not free.any():
            return
        depends = dependence(u[:, free], normalised_sum(u[:, free], freed))
        self.dependence[free] += depends.where(~self.chosen[free].unsqueeze(1), 0.0)
        found = self.dependence[free].numpy()
        p = chi2.sf(found[:, 0], found[:, 1].clip(min=1))
        self.chosen[free] |= torch.from_numpy(false_discovery_control(p) < FALSE_DISCOVERY_RATE)

    def _slopes(self, values: Values, own: Objects, w: Witness) -> dict[tuple[int, ...], Features]:
        """The slope of w of each site that objects move, by its number for sites of scenes, by number and class for
        those of nodes. Which these are is decided in the first round."""
        found = {}
        for g in (self.aspects >= 0).nonzero().flatten().tolist():
            found[(g,)] = slope_of(w, values.scene[w.owner, g].numpy(), int(self.aspects[g]))
        for s, c in (self.aspects_of >= 0).nonzero().tolist():
            u = values.nodes[w.owner, own.node[w.rows], s].numpy()
            found[(s, c)] = slope_of(w, np.where(w.label == c, u, np.nan), int(self.aspects_of[s, c]))
        if not self.done:
            for key, one in found.items():
                (self.chosen if len(key) == 1 else self.chosen_of)[key] = one.p < OBJECT_P_VALUE
        chosen = [key for key in found if (self.chosen if len(key) == 1 else self.chosen_of)[key]]
        return {key: found[key].sure * found[key].slope for key in chosen}

    def _weights(
        self, values: Values, freed: list[Features], slopes: dict[tuple[int, ...], Features]
    ) -> tuple[Tensor, Tensor]:
        """Of the values of sites of nodes ``(N, M, S)`` and of scenes ``(N, G)``, 1 in the mean of each."""
        nodes, scene, least = torch.ones_like(values.nodes), torch.ones_like(values.scene), self.schedule.ess_fraction
        by_images = self.chosen & (self.aspects < 0)
        if by_images.any():
            of = values.scene[:, by_images]
            v, sure = explained_part(of, normalised_sum(of, freed))
            weight = tilted_weights(v, 1 - sure * (1 - least)) * len(v)
            scene[:, by_images] = torch.from_numpy(weight).float()[:, None]
        label = class_table(self.model.grammar.kinds, self.model.classes)[values.kind]
        for key, slope in slopes.items():
            if len(key) == 1:
                u, part = values.scene[:, key[0]], scene[:, key[0]]
                there = ~u.isnan()
            else:
                s, c = key
                u, part = values.nodes[..., s], nodes[..., s]
                there = (label == c) & ~u.isnan()
            h = object_basis(u[there].double().numpy()) @ slope
            part[there] = torch.from_numpy(step_weights(h, least) * len(h)).float()
        return nodes, scene

    @property
    def _chosen_columns(self) -> Tensor:
        return torch.cat([self.chosen_of.any(1), self.chosen])

    def _set_prior_sites(self) -> None:
        if self.guide is not None:
            self.guide.prior_sites = frozenset(site.name for site in self.open_to if site not in self.learnt)

    @torch.no_grad()
    def _drawn(self, guide: ParameterGuide, num: int) -> tuple[list[Features], Values, Objects]:
        """Features ``(N, D)`` of the guide's renders by each look, their scenes' values of all sites, and their
        objects."""
        model, features, parts, objects = guide.with_parameters(self.model), [], [], []
        for first in range(0, num, RENDERS_PER_CALL):
            some = self.renders.draw(min(RENDERS_PER_CALL, num - first), self.structure, model)
            features.append([look(some.drawn.image) for look in self.looks])
            objects.append(objects_of(some.drawn))
            parts.append(some._replace(drawn=some.drawn._replace(image=some.drawn.image[..., :0])))  # to save memory
        of, turns = concatenate(parts), torch.zeros(len(self.open_to), dtype=torch.bool)
        scene, nodes = (u.clamp(U_EPS, 1 - U_EPS) for u in (of.scene_u, of.u))
        known = (torch.full_like(u, EXACT_SD) for u in (nodes, scene))
        values = Values(of.kind, of.parent, nodes, next(known), scene, next(known), turns)
        found = [torch.cat(part).double().numpy() for part in zip(*features, strict=True)]
        return found, values, concatenate_objects(objects)


class _WeightedLikelihood(AdamTraining):
    """Maximum likelihood of values that are known.

    Args:
        nodes, scene: how much each counts, ``(N, M, S)`` and ``(N, G)``.
        chosen: ``(S + G,)`` bool, the sites that are learnt.
    """

    subject = "the parameters"

    def __init__(
        self,
        net: ParameterNet,
        values: Values,
        nodes: Tensor,
        scene: Tensor,
        chosen: Tensor,
        schedule: TiltingSchedule,
        seed: int,
    ):
        adam = torch.optim.Adam(net.parameters(), lr=schedule.rate)
        super().__init__(net, adam, schedule.steps, seed, max_grad_norm=10.0)
        self.net, self.values, self.scene, self.chosen = net, values._replace(weight=nodes), scene, chosen
        self.images = images_per_step(net, values, MAX_SCENES)

    def loss(self) -> Tensor:
        """See ``AdamTraining``."""
        rows = torch.randint(len(self.scene), (self.images,))
        weight = F.pad(self.scene[rows], (self.net.node_sites, 0), value=1.0)
        return -(weight * log_density(self.net, self.values.select(rows)))[:, self.chosen].sum(1).mean()


def step_weights(h: Features, ess_fraction: float) -> Features:
    """Weights ``(n,)`` in proportion to exp(-eta h), eta ``OBJECT_ETA``, or as large as leaves an effective share of
    them."""
    weight = np.exp(-OBJECT_ETA * (h - h.min()))
    weight /= weight.sum()
    return tilted_weights(h, ess_fraction) if 1 / np.square(weight).sum() < ess_fraction * len(h) else weight


def witness(own: Features, real: Features) -> tuple[Features, float]:
    """w of each scene ``(N,)``, by features ``(N, D)`` of all and of the target ``(L, D)``; and the squared energy
    distance, without bias. Both in units of how far the target's images are apart."""
    toward, among, within = cdist(own, real), cdist(own, own), cdist(real, real)
    among, within = (each.sum(1) / max(1, len(each) - 1) for each in (among, within))
    spread = max(float(within.mean()), MIN_SD)
    return (toward.mean(1) - among) / spread, float(2 * toward.mean() - among.mean() - within.mean()) / spread


def without_structure(kind: Tensor, w: Features) -> Features:
    """w without what a linear regression on the number and the presence of each kind of node ``(N, M)`` explains: it is
    structure's, which is not moved here."""
    number = np.stack([(kind == k).sum(1).numpy() for k in kind.unique()], 1)
    x = np.concatenate([number, number > 0, np.ones((len(w), 1))], 1).astype(np.float64)
    return w - x @ np.linalg.lstsq(x, w, rcond=None)[0]


def normalised_sum(u: Tensor, each: list[Features]) -> Features:
    """The sum of several w, each in its ``unit``."""
    return np.stack([w / unit(u, w) for w in each]).sum(0)


def unit(u: Tensor, w: Features) -> float:
    """The standard deviation of what sites' u ``(N, G)`` explain of w: the norm of the gradient that a guide of these
    sites can follow. A tenth of w's own, if that is more."""
    return max(float(explained_part(u, w)[0].std()), MIN_UNIT * float(w.std()), MIN_SD)


def explained_part(u: Tensor, w: Features) -> tuple[Features, float]:
    """What a linear regression on numbers of sites' u ``(N, G)`` says of w, less its mean, ``(N,)``; and the share of
    its standard deviation that is more than chance would give, 0 to 1."""
    x, y = np.concatenate([basis(one) for one in u.unbind(1)], 1), w - w.mean()
    slope, _, rank, _ = np.linalg.lstsq(x, y, rcond=None)
    v = x @ slope
    found, left, freedom = np.square(v).sum(), np.square(y - v).sum(), len(y) - 1 - int(rank)
    return v, max(0.0, 1 - float(rank * left / freedom / found)) ** 0.5 if found and freedom > 0 else 0.0


def tilted_weights(w: Features, ess_fraction: float) -> Features:
    """Weights ``(N,)`` in proportion to exp(-eta w), of which so many are effective as ``kept`` says, a share."""
    z = -(w - w.mean()) / max(float(w.std()), 1e-12)

    def weight(eta: float) -> Features:
        found = np.exp(eta * (z - z.max()))
        return found / found.sum()

    def more(eta: float) -> float:
        return 1 / np.square(weight(eta)).sum() / len(w) - ess_fraction

    if ess_fraction >= 1:
        return weight(0.0)
    return weight(root_scalar(more, bracket=(0.0, MAX_ETA)).root if more(MAX_ETA) < 0 else MAX_ETA)
