"""Parameters from unlabelled images: a reader, maximum likelihood on its readings, rounds of both, and refinement.

1. A reader is trained on renders (``reader_training``), half of them with layouts that the prior hardly has; then its
   head for sites of the whole scene.
2. It is calibrated on renders of the prior: sites that it can read are learnt, the others keep their prior (``skill``).
3. It reads the target; a guide learns the values by maximum likelihood (``likelihood``), with objects imputed that the
   reader misses there (``missed_objects``).
4. Rounds: the reader is trained further, mostly on the guide's own renders, which look like the target, so that it
   reads the target better; it reads it again, and the guide goes on. This is empirical Bayes.
5. The distribution of readings in the guide's renders is brought to that in the target (``energy``).
6. It is decided which sites keep their prior. Sites of the scene with low skill are read by a head that is refitted for
   them; renders that are like the target but have the prior's values of these sites are weighted until their readings
   are distributed as in the target.

Axis letters: N scenes, L images, K objects.
"""

from collections.abc import Callable, Collection
from functools import cached_property, partial
from typing import Any, cast

import torch
from torch import Tensor

from probscene.model import SceneModel
from probscene.policy import Policy
from probscene.sampling import seed_everything

from ..training import Callback, Training, batch_seed, of_prefix
from .backbone import Backbone
from .calibration import CalibratedReader
from .checkpoint_selection import CheckpointSelector, HeldOutSet
from .energy import EnergyDistance, GuideReadings, WeightedEnergyDistance, site_rows
from .guide import ParameterGuide
from .likelihood import MaximumLikelihood, Values
from .missed_objects import MissedObjects
from .reader import Reader
from .reader_training import GlobalHeadTraining, ReaderTraining, SupervisedBatch
from .scene_graph_builder import SceneGraphBuilder, order_by_variance
from .schedule import ENERGY, LIKELIHOOD, OF_GUIDE, READING, REFIT, RENDERS_PER_STEP, SCENES, WEIGHTS, ParameterSchedule
from .sites import Site, find_sites
from .supervised_renders import Label, SupervisedRenders, concatenate

CALIBRATION_RENDERS = 500  # also the most that are drawn at once, as they take memory
BUILDER_RENDERS = 200  # for ``fit_scene_graph_builder``
MISSED_RENDERS = 400  # of the guide, for ``MissedObjects``
GUIDE_SHARE = 0.65  # of a round's renders; the others are the prior's
REFIT_GUIDE_SHARE = 0.5  # of the renders that a head is refitted on
PREFETCH_STEPS = 8  # whose renders are drawn together
AUGMENTED_SHARE = 0.5  # of the prior's renders
GUIDE_GROUPS = 4  # of own renders for sites of scenes
PRIOR_PROBABILITY = 0.3  # of such a site in such a group


class ParameterLearning:
    """A ``Training`` of a ``ParameterGuide``, made of trainings one after the other.

    Args:
        model: the scene model.
        structure: the policy of the structures.
        eye: the backbone of the reader.
        label: renders and labels scenes.
        images: gives the target's, ``(L, C, H, W)`` uint8.
        schedule: how long.
        seed: of everything random.
        held: compares the guide with held-out images after each of its trainings, which is undone where it made its
            scenes significantly farther from them.
        select_prior_sites: gives names of sites that would keep their prior, for these comparisons; with True, for
            good, before sites with low skill are learnt.

    Attributes:
        unit, total, done: see ``Training``; steps of all trainings.
        sites: of the model.
        calibrated: the reader, and what is known of it.
        guide: what is learnt; None before it is known which sites are, and where there are none.
        prior_sites: names of sites that keep their prior for good; None before they are selected.
    """

    unit = "steps"

    def __init__(  # noqa: PLR0913
        self,
        model: SceneModel,
        structure: Policy,
        eye: Backbone,
        label: Label,
        images: Callable[[], Tensor],
        schedule: ParameterSchedule,
        seed: int = 0,
        held: HeldOutSet | None = None,
        select_prior_sites: Callable[["ParameterLearning", bool], Collection[str]] | None = None,
    ):
        self.best = None if held is None else CheckpointSelector(held)
        self.select_prior_sites = select_prior_sites or (lambda *_: frozenset[str]())
        self.prior_sites: frozenset[str] | None = None
        self.model, self.structure, self.images, self.schedule, self.seed = model, structure, images, schedule, seed
        seed_everything(batch_seed(seed, 0))
        self.sites = find_sites(model)
        open_to = [site for site in self.sites if not site.keeps]
        self.node_sites = tuple(site for site in open_to if not site.of_scene)
        self.scene_sites = tuple(site for site in open_to if site.of_scene)
        self.renders = SupervisedRenders(model, label, self.node_sites, self.scene_sites)
        reader = Reader(eye, len(model.classes), len(self.node_sites), len(self.scene_sites))
        self.calibrated = CalibratedReader(model, reader, self.node_sites, self.scene_sites)
        self.phases, self.lengths = zip(*schedule.phases(bool(self.scene_sites)), strict=True)
        self.total, self.done, self.phase = sum(self.lengths), 0, 0
        self.guide: ParameterGuide | None = None
        self.missed: MissedObjects | None = None  # during maximum likelihood
        self.inner: Training | None = None
        self.prefetched: tuple[tuple[int, int], list[SupervisedBatch]] = (-1, -1), []

    @property
    def learnt(self) -> tuple[Site, ...]:
        """The sites that can be read, in the order of the program; none before the reader is calibrated."""
        return tuple(site for site in self.sites if site in self.calibrated.good_sites)

    def run(self, callback: Callback | None = None) -> None:
        """See ``Training``."""
        while self.phase < len(self.lengths):
            if self.calibrated.skill is None and self.phases[self.phase] == LIKELIHOOD:
                self._calibrate()
            if self.calibrated.skill is not None and not self.learnt:  # nothing can be read
                self.phase, self.done = len(self.lengths), self.total
                return
            if not self._idle:
                self._run_phase(callback)
            self.phase += 1
            self.done = sum(self.lengths[: self.phase])

    def _run_phase(self, callback: Callback | None) -> None:
        if self.phases[self.phase] == REFIT and self.prior_sites is None:
            self.prior_sites = frozenset(self.select_prior_sites(self, True))
        self.inner = self.inner or self._new_training()

        def relay(training: Training, report: dict[str, float]) -> None:
            self.done = sum(self.lengths[: self.phase]) + training.done
            if callback is not None:
                callback(self, report)

        self.inner.run(relay)
        self.inner = self.missed = None
        if self.phases[self.phase] in OF_GUIDE and self.best is not None and self.guide is not None:
            self.best.update(self.guide, frozenset((*self.select_prior_sites(self, False), *self._low_skill)))

    def summary(self) -> dict[str, Any]:
        """See ``Training``; empty."""
        return {}

    def state(self) -> dict[str, Tensor]:
        """See ``Training``."""
        tensors = {**self.calibrated.state(), "phase": torch.tensor(self.phase)}
        if self.prior_sites is not None:
            tensors["settled"] = torch.tensor([site.name in self.prior_sites for site in self.learnt])
        if self.guide is not None:
            tensors |= {f"guide.{key}": value for key, value in self.guide.net.state_dict().items()}
            tensors |= {f"best.{key}": value for key, value in (self.best.state() if self.best else {}).items()}
        if self.missed is not None:
            tensors |= {f"missing.{key}": torch.as_tensor(part) for key, part in self.missed._asdict().items()}
        if self.inner is not None:
            tensors |= {f"inner.{key}": value for key, value in self.inner.state().items()}
        return {key: value.clone() for key, value in tensors.items()}  # the reader is also its training's

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """See ``Training``."""
        self.phase = int(tensors["phase"])
        self.calibrated.restore(tensors)
        if self.calibrated.skill is not None:
            self.guide = self._new_guide()
        if "settled" in tensors:
            pairs = zip(self.learnt, tensors["settled"].tolist(), strict=True)
            self.prior_sites = frozenset(site.name for site, keeps_prior in pairs if keeps_prior)
        if self.guide is not None:
            self.guide.net.load_state_dict(of_prefix(tensors, "guide."))
            if self.best is not None:
                self.best.restore(of_prefix(tensors, "best."))
        missing, inner = of_prefix(tensors, "missing."), of_prefix(tensors, "inner.")
        self.missed = MissedObjects(**missing) if missing else None
        if inner:
            self.inner = self._new_training()
            self.inner.restore(inner)
        self.done = sum(self.lengths[: self.phase]) + (0 if self.inner is None else self.inner.done)

    def _new_training(self) -> Training:
        """The training of this phase, from its first step."""
        schedule, what, steps = self.schedule, self.phases[self.phase], self.lengths[self.phase]
        first = self.guide is None or self.phase == self.phases.index(LIKELIHOOD)
        seed = batch_seed(self.seed, 1, self.phase)
        if what == READING:
            rate = schedule.reader_rate / (1 if first else 2)
            return ReaderTraining(self.calibrated.reader, self._draw, steps, schedule.reader_images, rate, seed)
        if what in (SCENES, REFIT):
            rate = schedule.scene_rate / (1 if first or what == REFIT else 2)
            overall = self.calibrated.reader.overall if what == SCENES else self.calibrated.use_refit_head()
            return GlobalHeadTraining(overall, self._draw_entering, RENDERS_PER_STEP * steps, rate, seed)
        guide = self.guide
        assert guide is not None
        if what == LIKELIHOOD and self.missed is None:
            seed_everything(batch_seed(self.seed, 7, self.phase))
            self.missed = self.calibrated.missed_objects(self.guide_scenes(num=MISSED_RENDERS))
        values, builder = self._read_target()
        if what == WEIGHTS:
            own = self._guide_readings(builder, schedule.weighted_scenes, self._low_skill)
            sites = [*self._low_skill.values()]
            return WeightedEnergyDistance(guide.net, values, own, sites, steps, schedule.rate, seed)
        if what == ENERGY:
            own, scenes, rate = partial(self._guide_readings, builder), schedule.energy_scenes, schedule.energy_rate
            return EnergyDistance(guide.net, values, own, self.calibrated.noisy, steps, scenes, rate, seed)
        rate = schedule.rate if first else 0.6 * schedule.rate
        return MaximumLikelihood(guide.net, values, steps, schedule.step_images, rate, seed)

    @property
    def _idle(self) -> bool:
        """Whether there is nothing to do in this phase."""
        what = self.phases[self.phase]
        if what == SCENES:
            return self.calibrated.skill is not None and not len(self.calibrated.columns[1])
        return not self._low_skill if what in (REFIT, WEIGHTS) else what == ENERGY and not self.calibrated.noisy.any()

    def _draw_entering(self, num: int) -> tuple[Tensor, Tensor]:
        """Renders for the head of the whole scene, as they enter, and their u. In some groups of the guide's renders a
        site has its prior; only these have a label of it, as a head that learnt what the guide draws would guess toward
        that. A head is refitted on fewer of the guide's renders, as these are not all like the target."""
        last = self.phases[self.phase] == REFIT
        own = 0 if self.guide is None else round((REFIT_GUIDE_SHARE if last else GUIDE_SHARE) * num)
        drawn = [self.renders.draw(num - own, self.model.pretraining_policy, augmented=AUGMENTED_SHARE)]
        for i in range(min(GUIDE_GROUPS, own)):
            anywhere = {site.name for site in self.learnt if site.of_scene and torch.rand(()) < PRIOR_PROBABILITY}
            kept = {*(self._low_skill if last else anywhere), *(self.prior_sites or ())}
            labelled = [site not in self.learnt or site.name in kept for site in self.scene_sites]
            valued = self.guide_scenes(kept, (own + i) // min(GUIDE_GROUPS, own))
            drawn.append(valued._replace(overall=valued.overall.where(torch.tensor(labelled), torch.nan)))
        entered = [self.calibrated.reader.eye.enter(some.drawn.image) for some in drawn]
        open_to = torch.tensor([not last or site.name in self._low_skill for site in self.scene_sites])
        return torch.cat(entered), torch.cat([some.overall for some in drawn]).where(open_to, torch.nan)

    def _draw(self, num: int) -> SupervisedBatch:
        """Renders for a step of the reader. Those of several steps are drawn together, which takes hardly longer: a
        program runs once, and a guide goes from node to node for many scenes as fast as for one."""
        training, own = cast(ReaderTraining, self.inner), 0 if self.guide is None else round(GUIDE_SHARE * num)
        part, place = divmod(training.done, PREFETCH_STEPS)
        if (self.phase, part) != self.prefetched[0]:
            seed_everything(batch_seed(self.seed, 5, self.phase, part))
            policy, number = self.model.pretraining_policy, PREFETCH_STEPS * (num - own)
            drawn = [self.renders.draw(number, policy, augmented=AUGMENTED_SHARE)]
            drawn += [self.guide_scenes(num=PREFETCH_STEPS * own)] if own else []
            self.prefetched = (self.phase, part), drawn
            seed_everything(batch_seed(training.seed, training.done))  # as where they were drawn before
        parts = zip(self.prefetched[1], (num - own, own), strict=False)
        # Both in each step, as batch norm is of what a step looks at.
        return concatenate([some.select(slice(place * n, (place + 1) * n)) for some, n in parts])

    @property
    def _low_skill(self) -> dict[str, int]:
        """The index of each of the guide's sites of scenes that has low skill, by name."""
        assert self.guide is not None
        names = self.calibrated.low_skill_sites
        return {site.name: g for g, site in enumerate(self.guide.scene_sites) if site.name in names}

    def _calibrate(self) -> None:
        """Find which sites the reader can read, by the prior's renders."""
        seed_everything(batch_seed(self.seed, 2))
        self.calibrated.calibrate(self.renders.draw(CALIBRATION_RENDERS, self.model.pretraining_policy), self.images())
        self.guide = self._new_guide()

    def _new_guide(self) -> ParameterGuide | None:
        """Of the sites that can be read; None where there are none."""
        return ParameterGuide(self.model, self.learnt, self.structure) if self.learnt else None

    def _read_target(self) -> tuple[Values, SceneGraphBuilder]:
        """The reader's readings of the target, missed objects imputed, and the builder of their scene graphs."""
        builder, images = self._builder, self.images()
        seed_everything(batch_seed(self.seed, 3, self.phase))
        found = self.calibrated.reader.detect(images)
        builder = order_by_variance(builder, found)
        return self.calibrated.values(builder, found, len(images), missed=self.missed)[0], builder

    @torch.no_grad()
    def site_rows(self, images: dict[str, Tensor]) -> dict[str, dict[str, tuple[Tensor, Tensor]]]:
        """Readings of each learnt site in images ``(L, C, H, W)`` uint8 of several sources, ``"target"`` among them: by
        site and source, see ``energy.site_rows``."""
        found = {name: self.calibrated.reader.detect(some) for name, some in images.items()}
        builder = order_by_variance(self._builder, found["target"])
        seed_everything(batch_seed(self.seed, 6))
        read = {name: self.calibrated.values(builder, objects, len(images[name]))[0] for name, objects in found.items()}
        names = [site.name for site in (*self.node_sites, *self.scene_sites) if site in self.calibrated.good_sites]
        return {s: {name: site_rows(values.site(i)) for name, values in read.items()} for i, s in enumerate(names)}

    def guide_scenes(self, kept: Collection[str] = (), num: int = CALIBRATION_RENDERS) -> SupervisedBatch:
        """The guide's renders, in which sites of some names, and the ``prior_sites``, have their prior."""
        assert self.guide is not None
        self.guide.prior_sites = frozenset(kept) | (self.prior_sites or frozenset())
        sizes = [len(rows) for rows in torch.arange(num).split(CALIBRATION_RENDERS)]
        model = self.guide.with_parameters(self.model)
        valued = concatenate([self.renders.draw(size, self.structure, model) for size in sizes])
        self.guide.prior_sites = frozenset()
        return valued

    @torch.no_grad()
    def _guide_readings(self, builder: SceneGraphBuilder, num: int, kept: Collection[str] = ()) -> GuideReadings:
        """Readings of renders of the guide, see ``guide_scenes``."""
        return self.calibrated.guide_readings(builder, self.guide_scenes(kept, num))

    @cached_property
    def _builder(self) -> SceneGraphBuilder:
        """Fitted to scenes of the prior; the same in every phase."""
        seed_everything(batch_seed(self.seed, 4))
        return self.calibrated.scene_graph_builder(self.renders.draw(BUILDER_RENDERS, self.model.pretraining_policy))
