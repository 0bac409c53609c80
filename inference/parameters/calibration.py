"""A reader, which sites it can read, and its readings of images.

Axis letters: L images, M nodes, K objects, S sites of nodes, G sites of scenes.
"""

import math
from collections.abc import Callable, Iterable

import torch
from torch import Tensor

from probscene.model import SceneModel

from ..training import of_prefix
from .graph import SceneGraph
from .missed_objects import MissedObjects
from .reader import Detections, Reader
from .reader_training import MIN_VISIBLE, SupervisedBatch
from .recalibration import Recalibration
from .scene_graph_builder import SceneGraphBuilder, fit_scene_graph_builder
from .sites import Site, site_mask
from .skill import MIN_OBJECTS, MIN_SD, Skill
from .values import Values

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
        self.recalibration = Recalibration.identity(len(node_sites) + len(scene_sites))

    def state(self) -> dict[str, Tensor]:
        """All that ``restore`` needs, as named tensors."""
        tensors = {f"reader.{key}": value for key, value in self.reader.state_dict().items()}
        if self.skill is not None:
            tensors |= {
                "skill.geometry": self.skill.geometry,
                "skill.explained": self.skill.explained,
                "readings": self.num_readings,
                "recalibration": torch.stack(self.recalibration),
            }
        return tensors

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """As it was in a ``state``, among other tensors."""
        self.reader.load_state_dict(of_prefix(tensors, "reader."))
        self.reader.eval()
        if "skill.geometry" in tensors:
            self.skill = Skill(tensors["skill.geometry"], tensors["skill.explained"])
            self.num_readings = tensors["readings"]
            self.recalibration = Recalibration(*tensors["recalibration"].clone())

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
        self.reader.score_threshold.fill_(as_good[0])
        enough = found.score > float(self.reader.score_threshold)
        return found.select(enough), which[enough]

    def calibrate(self, valued: SupervisedBatch, images: Tensor) -> None:
        """Measure its skill on renders of the prior, and how often it detects each class in the target's images."""
        found, which = self.choose_threshold(valued)
        of_nodes = Skill.from_readings(found.raw[which >= 0], valued.u[found.image, which][which >= 0])
        of_scenes = Skill.from_readings(found.scene_raw, valued.scene_u)
        self.skill = Skill(*(torch.cat(pair) for pair in zip(of_nodes, of_scenes, strict=True)))
        objects = self.reader.detect(images).label.bincount(minlength=len(self.model.classes))
        of_class = dict(zip(self.model.classes, objects.tolist(), strict=True))
        number = [sum(of_class.get(kind, 0) for kind in site.kinds) for site in self.node_sites]
        self.num_readings = torch.tensor([*number, *(len(images) for _ in self.scene_sites)], dtype=torch.int64)

    def recalibrate(self, batches: Iterable[SupervisedBatch]) -> None:
        """Make readings likelihoods by renders like the target, whose u are draws of the prior where they are known."""
        assert self.skill is not None
        known = []
        for valued in batches:
            found = self.reader.detect(valued.drawn.image)
            which = matched(found, valued)
            is_it = which >= 0
            known.append((found.raw[is_it], valued.u[found.image, which][is_it], found.scene_raw, valued.scene_u))
        raw, u, scene_raw, scene_u = (torch.cat(part) for part in zip(*known, strict=True))
        of_nodes = self.skill.select(slice(0, len(self.node_sites)))
        of_scenes = self.skill.select(slice(len(self.node_sites), None))
        parts = (
            Recalibration.from_readings(*skill.read(raw), u, skill.turns)
            for skill, raw, u in ((of_nodes, raw, u), (of_scenes, scene_raw, scene_u))
        )
        self.recalibration = Recalibration(*(torch.cat(pair) for pair in zip(*parts, strict=True)))

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

    def why_not(self, site: Site) -> str:
        """Why a site is not learnt; empty where it is."""
        if site in self.good_sites:
            return ""
        assert self.skill is not None
        number = [*self.node_sites, *self.scene_sites].index(site)
        if not self.skill.readable[number]:
            return "it cannot be read in renders"
        return f"it was read {int(self.num_readings[number])} times in the target, fewer than {MIN_OBJECTS}"

    def readings(self, images: Tensor) -> dict[str, Tensor]:
        """u of each learnt site as it is read in ``(L, C, H, W)`` uint8 images, of all objects that have it or of all
        scenes."""
        found, (nodes, scenes) = self.reader.detect(images), self._readers()
        kind = kinds_of(self.model, found.label)
        has = site_mask(self.model.grammar, self.node_sites, kind).unbind(1)
        each = [u[there] for u, there in zip(nodes(found.raw)[0].unbind(1), has, strict=True)]
        sites = (*self.node_sites, *self.scene_sites)
        columns = zip(sites, [*each, *scenes(found.scene_raw)[0].unbind(1)], strict=True)
        return {site.name: u.clamp(0, 1) for site, u in columns if site in self.good_sites}

    def values(
        self,
        builder: SceneGraphBuilder,
        found: Detections,
        number: int,
        missed: MissedObjects | None = None,
    ) -> Values:
        """Scene graphs of the detections in so many images and of imputed missed objects, with the learnt sites."""
        assert self.skill is not None
        (of_nodes, of_scenes), (node, scene) = self._readers(), self.columns
        mean, sd = (part[:, node] for part in of_nodes(found.raw))
        scene_mean, scene_sd = (part[:, scene] for part in of_scenes(found.scene_raw))
        weight = torch.ones(len(mean))
        if missed is not None:
            found, u, weight = missed.impute(found, number)
            mean, sd = torch.cat([mean, u]), torch.cat([sd, torch.full_like(u, MIN_SD)])
        both = torch.cat([mean, weight[:, None]], 1)
        kind, parent, both, sd = builder.values(found, number, both, sd)
        has = site_mask(self.model.grammar, tuple(self.node_sites[i] for i in node.tolist()), kind)
        turns, outliers = self.skill.turns[self.good], self.recalibration.outliers[self.good]
        mean, sd = (part.where(has, torch.nan) for part in (both[..., :-1], sd))
        return Values(kind, parent, mean, sd, scene_mean, scene_sd, turns, both[..., -1].nan_to_num(0.0), outliers)

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

    def _readers(self) -> tuple[Callable[[Tensor], tuple[Tensor, Tensor]], Callable[[Tensor], tuple[Tensor, Tensor]]]:
        """Mean and standard deviation of u, recalibrated, from outputs for nodes and for scenes."""
        skill, S = self.skill, len(self.node_sites)
        assert skill is not None

        def of(sites: slice) -> Callable[[Tensor], tuple[Tensor, Tensor]]:
            own = Recalibration(*(part[sites] for part in self.recalibration))
            return lambda raw: own.apply(*skill.select(sites).read(raw))

        return of(slice(0, S)), of(slice(S, None))


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
