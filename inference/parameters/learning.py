"""Parameters from unlabelled images: a reader, maximum likelihood on what it reads, rounds of both, and refinement.

1. A reader is trained on renders (``reading.training``), half of them arranged as the prior hardly arranges them, and
   then what it reads of whole scenes.
2. It is tried on renders of the prior: sites that it can read are learnt, the others keep their prior (``skill``).
3. It reads the target; a guide learns the values by maximum likelihood (``likelihood``), beside objects that are not
   found there (``reading.missing``).
4. Rounds: the reader is trained further, mostly on the guide's own renders, which look like the target, so that it
   reads the target better; it reads it again, and the guide goes on. This is empirical Bayes.
5. What is read in the guide's renders is brought to what is read in the target (``energy``).
6. It is settled which sites keep their prior. The scene's sites that are read with little skill are read anew, by a
   network of their own; renders that are like the target but have the prior's values of them are weighted until what
   is read is distributed as in the target.

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
from .energy import EnergyDistance, OwnReadings, WeightedEnergyDistance, site_rows
from .guide import ParameterGuide
from .likelihood import MaximumLikelihood, Values
from .missed_objects import MissedObjects
from .reader import Reader
from .reader_training import GlobalHeadTraining, ReaderTraining, SupervisedBatch
from .scene_graph_builder import SceneGraphBuilder, order_by_variance
from .schedule import EACH, ENERGY, LIKELIHOOD, OF_GUIDE, READING, SCENES, UNCLEAR, WEIGHTS, ParameterSchedule
from .sites import Site, find_sites
from .supervised_renders import Label, SupervisedRenders, joined

TRIED = 500  # renders that a reader is tried on, and that are drawn at once at most, as they take memory
ASSEMBLED, MISSED = 200, 400  # renders in which it is seen how objects of a scene go together; what is not found
OWN, ANEW = 0.65, 0.5  # of a round's renders, and of those from which sites are read anew, are the guide's own
AHEAD, ARRANGED = 8, 0.5  # steps for which they are drawn together; of the other renders are arranged
GROUPS, ANYWHERE = 4, 0.3  # of own renders for sites of scenes; how often such a site has its prior in one


class ParameterLearning:
    """A ``Training`` of a ``ParameterGuide``, made of trainings one after the other.

    Args:
        model: the scene model.
        structure: the policy of the structures.
        eye: what the reader sees by.
        label: renders and labels scenes.
        images: gives the target's, ``(L, C, H, W)`` uint8.
        schedule: how long.
        seed: of everything random.
        held: judges the guide after each of its trainings, which is undone where it made its scenes surely farther.
        settle: names sites that would keep their prior: when ``held`` judges; with True, for good, before unclear ones.

    Attributes:
        unit, total, done: see ``Training``; steps of all trainings.
        sites: of the model.
        tried: the reader, and what is known of it.
        guide: what is learnt; None before it is known which sites are, and where there are none.
        settled: the sites that ``settle`` named at the end; None before.
    """

    unit = "steps"

    def __init__(
        self,
        model: SceneModel,
        structure: Policy,
        eye: Backbone,
        label: Label,
        images: Callable[[], Tensor],
        schedule: ParameterSchedule,
        seed: int = 0,
        held: HeldOutSet | None = None,
        settle: Callable[["ParameterLearning", bool], Collection[str]] | None = None,
    ):
        self.best = None if held is None else CheckpointSelector(held)
        self.settle = settle or (lambda *_: frozenset[str]())
        self.settled: frozenset[str] | None = None
        self.model, self.structure, self.images, self.schedule, self.seed = model, structure, images, schedule, seed
        seed_everything(batch_seed(seed, 0))
        self.sites = find_sites(model)
        open_to = [site for site in self.sites if not site.keeps]
        self.node_sites = tuple(site for site in open_to if not site.of_scene)
        self.scene_sites = tuple(site for site in open_to if site.of_scene)
        self.renders = SupervisedRenders(model, label, self.node_sites, self.scene_sites)
        reader = Reader(eye, len(model.classes), len(self.node_sites), len(self.scene_sites))
        self.tried = CalibratedReader(model, reader, self.node_sites, self.scene_sites)
        self.phases, self.lengths = zip(*schedule.phases(bool(self.scene_sites)), strict=True)
        self.total, self.done, self.phase = sum(self.lengths), 0, 0
        self.guide: ParameterGuide | None = None
        self.missing: MissedObjects | None = None  # while likelihood is gone up
        self.inner: Training | None = None
        self.ahead: tuple[tuple[int, int], list[SupervisedBatch]] = (-1, -1), []

    @property
    def learnt(self) -> tuple[Site, ...]:
        """The sites that can be read, in the order of the program; none before the reader was tried."""
        return tuple(site for site in self.sites if site in self.tried.good_sites)

    def run(self, callback: Callback | None = None) -> None:
        """See ``Training``."""
        while self.phase < len(self.lengths):
            if self.tried.skill is None and self.phases[self.phase] == LIKELIHOOD:
                self._try()
            if self.tried.skill is not None and not self.learnt:  # nothing can be read
                self.phase, self.done = len(self.lengths), self.total
                return
            if not self._idle:
                self._run_phase(callback)
            self.phase += 1
            self.done = sum(self.lengths[: self.phase])

    def _run_phase(self, callback: Callback | None) -> None:
        if self.phases[self.phase] == UNCLEAR and self.settled is None:
            self.settled = frozenset(self.settle(self, True))
        self.inner = self.inner or self._begun()

        def relay(training: Training, report: dict[str, float]) -> None:
            self.done = sum(self.lengths[: self.phase]) + training.done
            if callback is not None:
                callback(self, report)

        self.inner.run(relay)
        self.inner = self.missing = None
        if self.phases[self.phase] in OF_GUIDE and self.best is not None and self.guide is not None:
            self.best.after(self.guide, frozenset((*self.settle(self, False), *self._unclear)))

    def summary(self) -> dict[str, Any]:
        """Nothing more for the log."""
        return {}

    def state(self) -> dict[str, Tensor]:
        """All that ``restore`` needs, as named tensors."""
        tensors = {**self.tried.state(), "phase": torch.tensor(self.phase)}
        if self.settled is not None:
            tensors["settled"] = torch.tensor([site.name in self.settled for site in self.learnt])
        if self.guide is not None:
            tensors |= {f"guide.{key}": value for key, value in self.guide.net.state_dict().items()}
            tensors |= {f"best.{key}": value for key, value in (self.best.state() if self.best else {}).items()}
        if self.missing is not None:
            tensors |= {f"missing.{key}": torch.as_tensor(part) for key, part in self.missing._asdict().items()}
        if self.inner is not None:
            tensors |= {f"inner.{key}": value for key, value in self.inner.state().items()}
        return {key: value.clone() for key, value in tensors.items()}  # the reader is also its training's

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Go on from a ``state``."""
        self.phase = int(tensors["phase"])
        self.tried.restore(tensors)
        if self.tried.skill is not None:
            self.guide = self._new_guide()
        if "settled" in tensors:
            each = zip(self.learnt, tensors["settled"].tolist(), strict=True)
            self.settled = frozenset(site.name for site, is_settled in each if is_settled)
        if self.guide is not None:
            self.guide.net.load_state_dict(of_prefix(tensors, "guide."))
            if self.best is not None:
                self.best.restore(of_prefix(tensors, "best."))
        missing, inner = of_prefix(tensors, "missing."), of_prefix(tensors, "inner.")
        self.missing = MissedObjects(**missing) if missing else None
        if inner:
            self.inner = self._begun()
            self.inner.restore(inner)
        self.done = sum(self.lengths[: self.phase]) + (0 if self.inner is None else self.inner.done)

    def _begun(self) -> Training:
        """The training of this phase, from its first step."""
        schedule, what, steps = self.schedule, self.phases[self.phase], self.lengths[self.phase]
        first = self.guide is None or self.phase == self.phases.index(LIKELIHOOD)
        seed = batch_seed(self.seed, 1, self.phase)
        if what == READING:
            rate = schedule.reader_rate / (1 if first else 2)
            return ReaderTraining(self.tried.reader, self._drawn, steps, schedule.reader_images, rate, seed)
        if what in (SCENES, UNCLEAR):
            rate = schedule.scene_rate / (1 if first or what == UNCLEAR else 2)
            overall = self.tried.reader.overall if what == SCENES else self.tried.reading_anew()
            return GlobalHeadTraining(overall, self._entered, EACH * steps, rate, seed)
        guide = self.guide
        assert guide is not None
        if what == LIKELIHOOD and self.missing is None:
            seed_everything(batch_seed(self.seed, 7, self.phase))
            self.missing = self.tried.missing(self.own_scenes(num=MISSED))
        values, made = self._read()
        if what == WEIGHTS:
            own = self._own(made, schedule.weighted_scenes, self._unclear)
            return WeightedEnergyDistance(guide.net, values, own, [*self._unclear.values()], steps, schedule.rate, seed)
        if what == ENERGY:
            own, scenes, rate = partial(self._own, made), schedule.energy_scenes, schedule.energy_rate
            return EnergyDistance(guide.net, values, own, self.tried.noisy, steps, scenes, rate, seed)
        rate = schedule.rate if first else 0.6 * schedule.rate
        return MaximumLikelihood(guide.net, values, steps, schedule.step_images, rate, seed)

    @property
    def _idle(self) -> bool:
        """Whether there is nothing to do in this phase."""
        what = self.phases[self.phase]
        if what == SCENES:
            return self.tried.skill is not None and not len(self.tried.columns[1])
        return not self._unclear if what in (UNCLEAR, WEIGHTS) else what == ENERGY and not self.tried.noisy.any()

    def _entered(self, num: int) -> tuple[Tensor, Tensor]:
        """Renders for what is read of the whole scene. In some groups of the guide's a site has its prior; only of
        these it is told what it is, as a reader that learnt what the guide draws would guess toward that. Unclear sites
        are read anew from fewer of the guide's, as these are not all like the target."""
        last = self.phases[self.phase] == UNCLEAR
        own = 0 if self.guide is None else round((ANEW if last else OWN) * num)
        drawn = [self.renders.draw(num - own, self.model.pretraining_policy, arranged=ARRANGED)]
        for i in range(min(GROUPS, own)):
            anywhere = {site.name for site in self.learnt if site.of_scene and torch.rand(()) < ANYWHERE}
            kept = {*(self._unclear if last else anywhere), *(self.settled or ())}
            told = [site not in self.learnt or site.name in kept for site in self.scene_sites]
            valued = self.own_scenes(kept, (own + i) // min(GROUPS, own))
            drawn.append(valued._replace(overall=valued.overall.where(torch.tensor(told), torch.nan)))
        entered = [self.tried.reader.eye.enter(some.drawn.image) for some in drawn]
        open_to = torch.tensor([not last or site.name in self._unclear for site in self.scene_sites])
        return torch.cat(entered), torch.cat([some.overall for some in drawn]).where(open_to, torch.nan)

    def _drawn(self, num: int) -> SupervisedBatch:
        """Renders for a step of the reader. Those of several steps are drawn together, which takes hardly longer: a
        program runs once, and a guide goes from node to node for many scenes as fast as for one."""
        training, own = cast(ReaderTraining, self.inner), 0 if self.guide is None else round(OWN * num)
        part, place = divmod(training.done, AHEAD)
        if (self.phase, part) != self.ahead[0]:
            seed_everything(batch_seed(self.seed, 5, self.phase, part))
            drawn = [self.renders.draw(AHEAD * (num - own), self.model.pretraining_policy, arranged=ARRANGED)]
            self.ahead = (self.phase, part), [*drawn, self.own_scenes(num=AHEAD * own)] if own else drawn
            seed_everything(batch_seed(training.seed, training.done))  # as where they were drawn before
        parts = zip(self.ahead[1], (num - own, own), strict=False)
        # Both in each step, as batch norm is of what a step looks at.
        return joined([some.of(slice(place * n, (place + 1) * n)) for some, n in parts])

    @property
    def _unclear(self) -> dict[str, int]:
        """The guide's sites of scenes that are read with little skill, by name which they are."""
        assert self.guide is not None
        return {site.name: g for g, site in enumerate(self.guide.scene_sites) if site.name in self.tried.unclear}

    def _try(self) -> None:
        """See what the reader can read in the prior's renders."""
        seed_everything(batch_seed(self.seed, 2))
        self.tried.on(self.renders.draw(TRIED, self.model.pretraining_policy), self.images())
        self.guide = self._new_guide()

    def _new_guide(self) -> ParameterGuide | None:
        """Of the sites that can be read; None where there are none."""
        return ParameterGuide(self.model, self.learnt, self.structure) if self.learnt else None

    def _read(self) -> tuple[Values, SceneGraphBuilder]:
        """What the reader reads in the target, with what is missing there, and how objects of a scene go together."""
        made, images = self._assembly, self.images()
        seed_everything(batch_seed(self.seed, 3, self.phase))
        found = self.tried.reader.find(images)
        made = order_by_variance(made, found)
        return self.tried.values(made, found, len(images), missing=self.missing)[0], made

    @torch.no_grad()
    def site_rows(self, images: dict[str, Tensor]) -> dict[str, dict[str, tuple[Tensor, Tensor]]]:
        """What is read of each learnt site in images ``(L, C, H, W)`` uint8 of several sources, ``"target"`` among
        them: by site and source, see ``energy.site_rows``."""
        found = {name: self.tried.reader.find(some) for name, some in images.items()}
        made = order_by_variance(self._assembly, found["target"])
        seed_everything(batch_seed(self.seed, 6))
        read = {name: self.tried.values(made, objects, len(images[name]))[0] for name, objects in found.items()}
        names = [site.name for site in (*self.node_sites, *self.scene_sites) if site in self.tried.good_sites]
        return {s: {name: site_rows(values.site(i)) for name, values in read.items()} for i, s in enumerate(names)}

    def own_scenes(self, kept: Collection[str] = (), num: int = TRIED) -> SupervisedBatch:
        """The guide's renders, in which sites of some names have their prior, and those that are settled."""
        assert self.guide is not None
        self.guide.passed = frozenset(kept) | (self.settled or frozenset())
        sizes, suited = [len(some) for some in torch.arange(num).split(TRIED)], self.guide.suited(self.model)
        valued = joined([self.renders.draw(size, self.structure, suited) for size in sizes])
        self.guide.passed = frozenset()
        return valued

    @torch.no_grad()
    def _own(self, made: SceneGraphBuilder, num: int, kept: Collection[str] = ()) -> OwnReadings:
        """What it reads in renders of the guide, see ``own_scenes``."""
        return self.tried.own(made, self.own_scenes(kept, num))

    @cached_property
    def _assembly(self) -> SceneGraphBuilder:
        """What the prior's scenes have in common; the same in every phase."""
        seed_everything(batch_seed(self.seed, 4))
        return self.tried.assembly(self.renders.draw(ASSEMBLED, self.model.pretraining_policy))
