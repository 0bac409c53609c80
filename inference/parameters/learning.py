"""Parameters from unlabelled images: a reader, marginal maximum likelihood on its readings, and rounds of both.

1. A reader is trained on renders of the prior (``reader_training``): for each object it finds, and for the scene, what
   their images say of u. u is uniform under the prior, so that a reading is proportional to a likelihood.
2. It is calibrated on renders of the prior: sites that it can read are learnt, the others keep their prior (``skill``).
3. It reads the target; a guide learns the distribution of u by maximum marginal likelihood (``stochastic_em``), with
   objects imputed that the reader misses there (``missed_objects``).
4. Rounds: the reader is trained further, mostly on renders that look like the target: the guide's, in which each value
   is a draw of the prior with probability one half, and only such values supervise it. So its readings stay
   likelihoods, and are those of scenes like the target's. It reads the target again, and the guide goes on.

This is empirical Bayes with an amortised likelihood [1]. Axis letters: N scenes, L images, K objects.

References:
    [1] Vandegar et al., *Neural empirical Bayes*, AISTATS 2021.
"""

from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from functools import cached_property, partial
from typing import Any

import torch
from torch import Tensor

from probscene.model import SceneModel
from probscene.policy import Policy
from probscene.prefetch import ahead
from probscene.sampling import seed_everything

from ..training import Callback, Training, batch_seed, of_prefix
from .backbone import Backbone
from .calibration import CalibratedReader
from .guide import ParameterGuide
from .missed_objects import MissedObjects
from .reader import Reader
from .reader_training import GlobalHeadTraining, ReaderTraining, SupervisedBatch
from .scene_graph_builder import SceneGraphBuilder, order_by_variance
from .schedule import LIKELIHOOD, READING, RENDERS_PER_STEP, SCENES, ParameterSchedule
from .sites import Site, find_sites
from .stochastic_em import StochasticEM
from .supervised_renders import Label, SupervisedRenders, concatenate
from .values import Values

CALIBRATION_RENDERS = 500  # also the most that are drawn at once, as they take memory
BUILDER_RENDERS = 200  # for ``fit_scene_graph_builder``
MISSED_RENDERS = 400  # of the guide, for ``MissedObjects``
GUIDE_SHARE = 0.65  # of a round's renders; the others are the prior's
PRIOR_PROBABILITY = 0.5  # of each value in these
PREFETCH_STEPS = 8  # whose renders are drawn together
AUGMENTED_SHARE = 0.5  # of the prior's renders


class ParameterLearning:
    """A ``Training`` of a ``ParameterGuide``, made of trainings one after the other.

    Args:
        model: the scene model.
        structure: the policy of the structures.
        backbone: the backbone of the reader.
        label: renders and labels scenes.
        images: gives the target's, ``(L, C, H, W)`` uint8.
        schedule: how long.
        seed: of everything random.

    Attributes:
        unit, total, done: see ``Training``; steps of all trainings.
        sites: of the model.
        calibrated: the reader, and what is known of it.
        guide: what is learnt; None before it is known which sites are, and where there are none.
    """

    unit = "steps"

    def __init__(
        self,
        model: SceneModel,
        structure: Policy,
        backbone: Backbone,
        label: Label,
        images: Callable[[], Tensor],
        schedule: ParameterSchedule,
        seed: int = 0,
    ):
        self.model, self.structure, self.images, self.schedule, self.seed = model, structure, images, schedule, seed
        seed_everything(batch_seed(seed, 0))
        self.sites = find_sites(model)
        open_to = [site for site in self.sites if not site.keeps]
        self.node_sites = tuple(site for site in open_to if not site.of_scene)
        self.scene_sites = tuple(site for site in open_to if site.of_scene)
        self.renders = SupervisedRenders(model, label, self.node_sites, self.scene_sites)
        reader = Reader(backbone, len(model.classes), len(self.node_sites), len(self.scene_sites))
        self.calibrated = CalibratedReader(model, reader, self.node_sites, self.scene_sites)
        self.phases, self.lengths = zip(*schedule.phases(bool(self.scene_sites)), strict=True)
        self.total, self.done, self.phase = sum(self.lengths), 0, 0
        self.guide: ParameterGuide | None = None
        self.missed: MissedObjects | None = None  # during maximum likelihood
        self.inner: Training | None = None
        self.batches: Iterator[SupervisedBatch] = iter(())  # of a reader's training

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
        self.inner = self.inner or self._new_training()

        def relay(training: Training, report: dict[str, float]) -> None:
            self.done = sum(self.lengths[: self.phase]) + training.done
            if callback is not None:
                callback(self, report)

        with closing(self._draw_batches(self.inner)) as self.batches:
            self.inner.run(relay)
        self.inner = self.missed = None

    def summary(self) -> dict[str, Any]:
        """See ``Training``; empty."""
        return {}

    def state(self) -> dict[str, Tensor]:
        """See ``Training``."""
        tensors = {**self.calibrated.state(), "phase": torch.tensor(self.phase)}
        if self.guide is not None:
            tensors |= {f"guide.{key}": value for key, value in self.guide.net.state_dict().items()}
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
        if self.guide is not None:
            self.guide.net.load_state_dict(of_prefix(tensors, "guide."))
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
            return ReaderTraining(self.calibrated.reader, self._next_batch, steps, schedule.reader_images, rate, seed)
        if what == SCENES:
            rate = schedule.scene_rate / (1 if first else 2)
            head = self.calibrated.reader.scene_head
            return GlobalHeadTraining(head, self._draw_entering, RENDERS_PER_STEP * steps, rate, seed)
        guide = self.guide
        assert guide is not None
        if self.missed is None:
            seed_everything(batch_seed(self.seed, 7, self.phase))
            self.missed = self.calibrated.missed_objects(self._guide_scenes(MISSED_RENDERS))
            sizes = _batch_sizes(self.schedule.recalibration_renders)
            self.calibrated.recalibrate(self.renders.draw_mixed(size, guide, PRIOR_PROBABILITY) for size in sizes)
        images = self.images()
        seed_everything(batch_seed(self.seed, 3, self.phase))
        values = self.readings(images, self.missed)
        rate = schedule.rate if first else schedule.round_rate
        return StochasticEM(guide.net, values, steps, schedule.step_images, rate, seed, from_prior=first)

    @property
    def _idle(self) -> bool:
        """Whether there is nothing to do in this phase."""
        if self.phases[self.phase] != SCENES:
            return False
        return self.calibrated.skill is not None and not len(self.calibrated.columns[1])

    def _draw_entering(self, num: int) -> tuple[Tensor, Tensor]:
        """Renders for the head of the whole scene, as they enter, and their u."""
        own = 0 if self.guide is None else round(GUIDE_SHARE * num)
        drawn = [self.renders.draw_augmented(num - own, self.model.pretraining_policy, AUGMENTED_SHARE)]
        if self.guide is not None and own:
            drawn.append(self.renders.draw_mixed(own, self.guide, PRIOR_PROBABILITY))
        entered = [self.calibrated.reader.backbone.enter(some.drawn.image) for some in drawn]
        return torch.cat(entered), torch.cat([some.scene_u for some in drawn])

    def _next_batch(self) -> SupervisedBatch:
        """Renders for a step of the reader."""
        return next(self.batches)

    def _draw_batches(self, training: Training) -> Generator[SupervisedBatch]:
        """Renders for the steps of the reader that are left. Those of several steps are drawn together, which takes
        hardly longer: a program runs once, and a guide goes from node to node for many scenes as fast as for one. The
        next are drawn in another thread meanwhile, unless steps draw random numbers, too."""
        if not isinstance(training, ReaderTraining):
            return
        num, is_random = training.images, self.calibrated.reader.backbone.is_random
        own = 0 if self.guide is None else round(GUIDE_SHARE * num)
        first, skipped = divmod(training.done, PREFETCH_STEPS)
        numbers = range(first, -(-training.total // PREFETCH_STEPS))
        draw = partial(self._draw_part, num - own, own)
        with closing((draw(number) for number in numbers) if is_random else ahead(draw, numbers)) as drawn:
            for some in drawn:
                if is_random:
                    seed_everything(batch_seed(training.seed, training.done))
                for place in range(skipped, PREFETCH_STEPS):
                    parts = zip(some, (num - own, own), strict=False)
                    # Both in each step, as batch norm is of what a step looks at.
                    yield concatenate([of.select(slice(place * n, (place + 1) * n)) for of, n in parts])
                skipped = 0

    def _draw_part(self, of_prior: int, of_guide: int, number: int) -> list[SupervisedBatch]:
        """Renders of the prior and of the guide for several steps, so many a step of each."""
        seed_everything(batch_seed(self.seed, 5, self.phase, number))
        policy = self.model.pretraining_policy
        drawn = [self.renders.draw_augmented(PREFETCH_STEPS * of_prior, policy, AUGMENTED_SHARE)]
        if self.guide is not None and of_guide:
            drawn.append(self.renders.draw_mixed(PREFETCH_STEPS * of_guide, self.guide, PRIOR_PROBABILITY))
        return drawn

    def _calibrate(self) -> None:
        """Find which sites the reader can read, by the prior's renders."""
        seed_everything(batch_seed(self.seed, 2))
        self.calibrated.calibrate(self.renders.draw(CALIBRATION_RENDERS, self.model.pretraining_policy), self.images())
        self.guide = self._new_guide()

    def _new_guide(self) -> ParameterGuide | None:
        """Of the sites that can be read; None where there are none."""
        return ParameterGuide(self.model, self.learnt, self.structure) if self.learnt else None

    @torch.no_grad()
    def readings(self, images: Tensor, missed: MissedObjects | None = None) -> Values:
        """What is read of the learnt sites in images ``(L, C, H, W)`` uint8; with missed objects imputed."""
        found = self.calibrated.reader.detect(images)
        return self.calibrated.values(order_by_variance(self._builder, found), found, len(images), missed)

    def _guide_scenes(self, num: int) -> SupervisedBatch:
        """The guide's renders."""
        assert self.guide is not None
        model = self.guide.with_parameters(self.model)
        return concatenate([self.renders.draw(size, self.structure, model) for size in _batch_sizes(num)])

    @cached_property
    def _builder(self) -> SceneGraphBuilder:
        """Fitted to scenes of the prior; the same in every phase."""
        with torch.random.fork_rng(devices=[]):
            seed_everything(batch_seed(self.seed, 4))
            drawn = self.renders.draw(BUILDER_RENDERS, self.model.pretraining_policy)
            return self.calibrated.scene_graph_builder(drawn)


def _batch_sizes(num: int) -> list[int]:
    """How many renders are drawn at a time, of ``num``."""
    return [len(rows) for rows in torch.arange(num).split(CALIBRATION_RENDERS)]
