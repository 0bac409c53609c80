"""A reader, which sites it can read, and its readings of images.

Axis letters: L images, M nodes, K objects, S sites of nodes, G sites of scenes.
"""

import math

import torch
from torch import Tensor

from probscene.model import SceneModel

from ..training import of_prefix
from .energy import GuideReadings
from .global_head import GlobalHead
from .graph import SceneGraph
from .likelihood import Values
from .missed_objects import MissedObjects
from .reader import Detections, Reader
from .reader_training import MIN_VISIBLE, SupervisedBatch
from .scene_graph_builder import SceneGraphBuilder, fit_scene_graph_builder
from .sites import Site, site_mask
from .skill import MIN_OBJECTS, MIN_SD, Skill

LOW_SKILL = 0.5  # below it, it is doubtful whether a site can be read in the target
HIGH_SKILL = 0.9  # from it on, the error of readings needs no correction
MAX_MATCH_DISTANCE = 12.0  # pixels from a detection to its object


class CalibratedReader:
    """A reader of a model's sites. It is calibrated once; from then on it reads those sites that it can read.

    Args:
        model: the scene model.
        reader: of its classes and of these sites.
        node_sites, scene_sites: that are not kept.

    Attributes:
        skill: of the reader, for the sites of nodes and then of scenes; None before it is calibrated.
        num_readings: ``(S + G,)`` how many readings of each there are in the target.
    """

    def __init__(self, model: SceneModel, reader: Reader, node_sites: tuple[Site, ...], scene_sites: tuple[Site, ...]):
        self.model, self.reader, self.node_sites, self.scene_sites = model, reader, node_sites, scene_sites
        self.skill: Skill | None = None
        self.num_readings = torch.zeros(0, dtype=torch.int64)

    def state(self) -> dict[str, Tensor]:
        """All that ``restore`` needs, as named tensors."""
        tensors = {f"reader.{key}": value for key, value in self.reader.state_dict().items()}
        if self.skill is not None:
            tensors |= {"skill.way": self.skill.way, "skill.share": self.skill.share, "readings": self.num_readings}
        return tensors

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """As it was in a ``state``, among other tensors."""
        self.reader.load_state_dict(of_prefix(tensors, "reader."))
        self.reader.eval()
        if "skill.way" in tensors:
            self.skill = Skill(tensors["skill.way"], tensors["skill.share"])
            self.num_readings = tensors["readings"]

    def choose_threshold(self, valued: SupervisedBatch) -> tuple[Detections, Tensor]:
        """Choose the score from which on detections count: the lowest with the fewest errors in some renders (objects
        that are missed, detected twice or detected where there is none), up to chance, as scores are lower in a target.

        Returns:
            the detections in the renders then, and the node that each is, see ``matched``.
        """
        found, drawn = self.reader.detect_all(valued.drawn.image), valued.drawn
        which, mistakes = matched(found, valued), []
        node, number = found.image * drawn.label.shape[1] + which, int(visible(valued).sum())
        for threshold in self.reader.thresholds:
            enough = found.score > threshold
            hit = len(node[enough & (which >= 0)].unique())
            mistakes.append(number + int(enough.sum()) - 2 * hit)
        most = min(mistakes) + math.sqrt(min(mistakes))
        as_good = [threshold for threshold, some in zip(self.reader.thresholds, mistakes, strict=True) if some <= most]
        self.reader.least.fill_(as_good[0])
        enough = found.score > self.reader.least
        return found.select(enough), which[enough]

    def calibrate(self, valued: SupervisedBatch, images: Tensor) -> None:
        """Measure its skill on renders of the prior, and how often it detects each class in the target's images."""
        found, which = self.choose_threshold(valued)
        of_nodes = Skill.from_readings(found.raw[which >= 0], valued.u[found.image, which][which >= 0])
        of_scenes = Skill.from_readings(found.overall, valued.overall)
        self.skill = Skill(*(torch.cat(pair) for pair in zip(of_nodes, of_scenes, strict=True)))
        objects = self.reader.detect(images).label.bincount(minlength=len(self.model.classes))
        of_class = dict(zip(self.model.classes, objects.tolist(), strict=True))
        number = [sum(of_class.get(kind, 0) for kind in site.kinds) for site in self.node_sites]
        self.num_readings = torch.tensor([*number, *(len(images) for _ in self.scene_sites)], dtype=torch.int64)

    @property
    def good(self) -> Tensor:
        """``(S + G,)`` bool, which are learnt; none before it is calibrated."""
        if self.skill is None:
            return torch.zeros(len(self.node_sites) + len(self.scene_sites), dtype=torch.bool)
        return self.skill.readable & (self.num_readings >= MIN_OBJECTS)

    @property
    def good_sites(self) -> frozenset[Site]:
        """Those."""
        each = zip((*self.node_sites, *self.scene_sites), self.good.tolist(), strict=True)
        return frozenset(site for site, good in each if good)

    @property
    def columns(self) -> tuple[Tensor, Tensor]:
        """Their numbers, among the sites of nodes and among those of scenes."""
        node, scene = self.good.tensor_split([len(self.node_sites)])
        return node.nonzero().flatten(), scene.nonzero().flatten()

    @property
    def noisy(self) -> Tensor:
        """Of the sites that are learnt, in the order of ``columns``, which are read with an error of some size."""
        assert self.skill is not None
        return self.skill.share[self.good] < HIGH_SKILL

    @property
    def low_skill_sites(self) -> frozenset[str]:
        """Names of the sites that are learnt, but read with little skill."""
        assert self.skill is not None
        each = zip((*self.node_sites, *self.scene_sites), self.skill.share.tolist(), strict=True)
        return frozenset(site.name for site, share in each if site in self.good_sites and share < LOW_SKILL)

    def use_refit_head(self) -> GlobalHead:
        """The head that sites of scenes with low skill are read by from now on."""
        anew = [site.name in self.low_skill_sites for site in self.scene_sites]
        self.reader.anew.copy_(torch.tensor(anew))
        return self.reader.again

    def unidentifiable_sites(self, valued: SupervisedBatch) -> dict[str, float]:
        """Which low-skill sites cannot be read in renders that look like the target, but have the prior's values of
        these sites: what the prior's renders show may be hidden there, as a sun behind clouds. By name, the share of
        the variance that is explained."""
        assert self.skill is not None
        found = self.reader.detect(valued.drawn.image)
        which, (nodes, scenes) = matched(found, valued), self._skills()
        of_nodes = nodes.explained_variance(found.raw[which >= 0], valued.u[found.image, which][which >= 0])
        there = Skill(self.skill.way, torch.cat([of_nodes, scenes.explained_variance(found.overall, valued.overall)]))
        seen = (there.readable | there.share.isnan()).tolist()
        each = zip((*self.node_sites, *self.scene_sites), there.share.tolist(), seen, strict=True)
        return {site.name: share for site, share, seen in each if site.name in self.low_skill_sites and not seen}

    def why_not(self, site: Site) -> str:
        """Why a site is not learnt; empty where it is."""
        if site in self.good_sites:
            return ""
        assert self.skill is not None
        number = [*self.node_sites, *self.scene_sites].index(site)
        if not self.skill.readable[number]:
            return "it cannot be read in renders"
        return f"it was read {int(self.num_readings[number])} times in the target, of {MIN_OBJECTS} that it takes"

    def readings(self, images: Tensor) -> dict[str, Tensor]:
        """u of each learnt site as it is read in ``(L, C, H, W)`` uint8 images, of all objects that have it or of all
        scenes."""
        found, (nodes, scenes) = self.reader.detect(images), self._skills()
        kind = kinds_of(self.model, found.label)
        has = site_mask(self.model.grammar, self.node_sites, kind).unbind(1)
        each = [u[there] for u, there in zip(nodes.read(found.raw)[0].unbind(1), has, strict=True)]
        sites = (*self.node_sites, *self.scene_sites)
        columns = zip(sites, [*each, *scenes.read(found.overall)[0].unbind(1)], strict=True)
        return {site.name: u.clamp(0, 1) for site, u in columns if site in self.good_sites}

    def values(
        self,
        builder: SceneGraphBuilder,
        found: Detections,
        number: int,
        of: Tensor | None = None,
        missed: MissedObjects | None = None,
    ) -> tuple[Values, Tensor]:
        """Scene graphs of the detections in so many images and of imputed missed objects, with the learnt sites; and
        ``of (K,)`` of each object, ``(L, M)`` int64, -1 where there is none."""
        skills, (node, scene) = self._skills(), self.columns
        mean, sd = (part[:, node] for part in skills[0].read(found.raw))
        scene_mean, scene_sd = (part[:, scene] for part in skills[1].read(found.overall))
        of, weight = torch.full((len(mean),), -1) if of is None else of, torch.ones(len(mean))
        if missed is not None:
            found, u, weight = missed.impute(found, number)
            mean, sd = torch.cat([mean, u]), torch.cat([sd, torch.full_like(u, MIN_SD)])
            of = torch.cat([of, of.new_full((len(u),), -1)])
        both = torch.cat([mean, of[:, None].to(mean.dtype), weight[:, None]], 1)
        kind, parent, both, sd = builder.values(found, number, both, sd)
        has = site_mask(self.model.grammar, tuple(self.node_sites[i] for i in node.tolist()), kind)
        turns = torch.cat([skills[0].turns[node], skills[1].turns[scene]])
        mean, sd = (part.where(has, torch.nan) for part in (both[..., :-2], sd))
        values = Values(kind, parent, mean, sd, scene_mean, scene_sd, turns, both[..., -1].nan_to_num(0.0))
        return values, both[..., -2].nan_to_num(-1).long()

    def guide_readings(self, builder: SceneGraphBuilder, valued: SupervisedBatch) -> GuideReadings:
        """Its readings of renders, with the true values."""
        found = self.reader.detect(valued.drawn.image)
        read, which = self.values(builder, found, len(valued.kind), matched(found, valued))
        node, scene = self.columns
        return GuideReadings(valued.kind, valued.parent, valued.u[..., node], valued.overall[:, scene], read, which)

    def scene_graph_builder(self, valued: SupervisedBatch) -> SceneGraphBuilder:
        """Fitted to some scenes of the prior."""
        label, kind = valued.drawn.label, kinds_of(self.model, valued.drawn.label)
        centre = valued.drawn.centre.where((label >= 0).unsqueeze(-1), torch.nan)
        graph = SceneGraph.from_nodes(kind, valued.parent)
        return fit_scene_graph_builder(self.model.grammar, self.model.classes, graph, centre, valued.group)

    def missed_objects(self, valued: SupervisedBatch) -> MissedObjects:
        """Objects that it does not detect in some renders, after ``choose_threshold`` by these renders."""
        found, which = self.choose_threshold(valued)
        there = torch.zeros_like(valued.kind, dtype=torch.bool)
        is_it = (which >= 0) & (found.label == valued.drawn.label[found.image, which])
        there[found.image[is_it], which[is_it]] = True
        return MissedObjects.from_renders(
            valued, kinds_of(self.model, torch.arange(len(self.model.classes))), there, self.columns[0]
        )

    def _skills(self) -> tuple[Skill, Skill]:
        """Of the sites of nodes, and of scenes."""
        assert self.skill is not None
        S = len(self.node_sites)
        return Skill(*(part[:S] for part in self.skill)), Skill(*(part[S:] for part in self.skill))


def kinds_of(model: SceneModel, label: Tensor) -> Tensor:
    """The grammar's kind of each class ``(...)``; -1 for none."""
    return torch.tensor([*(model.grammar.kind(name) for name in model.classes), -1])[label]


def visible(valued: SupervisedBatch) -> Tensor:
    """``(N, M)`` bool, the nodes that can be seen."""
    return (valued.drawn.label >= 0) & (valued.drawn.visible >= MIN_VISIBLE)


def matched(found: Detections, valued: SupervisedBatch) -> Tensor:
    """``(K,)`` the node nearest to each object that was found; -1 where none is near."""
    away = (valued.drawn.centre[found.image] - found.centre[:, None]).norm(dim=-1)
    away = away.masked_fill(~visible(valued)[found.image], torch.inf)
    least, which = away.min(1)
    return torch.where(least < MAX_MATCH_DISTANCE, which, -1)
