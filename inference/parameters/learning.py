"""Parameters from unlabelled images: a reader, maximum likelihood on what it reads, and rounds of both.

1. A reader is trained on renders (``reader_training``), half of them arranged as the prior hardly arranges them.
2. It is tried on renders of the prior: sites that it can read are learnt, the others keep their prior (``skill``).
3. It reads the target; a guide learns the values by maximum likelihood (``likelihood``).
4. Rounds: the reader is trained further, mostly on the guide's own renders, which look like the target, so that it
   reads the target better; it reads it again, and the guide goes on. This is empirical Bayes.

Axis letters: N scenes, L images, K objects.
"""

from collections.abc import Callable
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from probscene.model import SceneModel
from probscene.policy import Policy
from probscene.sampling import seed_everything

from ..training import Report, Training, batch_seed
from .graph import Graph
from .guide import ParameterGuide
from .likelihood import MaximumLikelihood, Values
from .reading.assembly import Assembly, along_the_widest, assembly
from .reading.eyes import Eye
from .reading.reader import Found, Reader
from .reading.skill import Skill
from .reading.training import MIN_VISIBLE, ReaderTraining, Valued
from .reading.valued import Label, ValuedRenders, joined
from .schedule import ParameterSchedule
from .sites import Site, find_sites, having

TRIED = 200  # renders that a reader is tried on
OWN = 0.65  # of a round's renders are the guide's own
ARRANGED = 0.5  # of the other renders are arranged
ENOUGH = 20  # readings of a site in the target, from which it is learnt
NEAR_ENOUGH = 12.0  # pixels from an object that is found to that which it is


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

    Attributes:
        unit, total, done: see ``Training``; steps of all trainings.
        sites: of the model.
        skill: of the reader, for the sites of nodes and then of scenes that are not kept; None before it is tried.
        readings_of: how many readings of each of these sites there are in the target.
        guide: what is learnt; None before it is known which sites are, and where there are none.
    """

    unit = "steps"

    def __init__(
        self,
        model: SceneModel,
        structure: Policy,
        eye: Eye,
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
        self.renders = ValuedRenders(model, label, self.node_sites, self.scene_sites)
        self.reader = Reader(eye, len(model.classes), len(self.node_sites), len(self.scene_sites))
        self.lengths = [schedule.reader_steps, schedule.steps]
        self.lengths += [schedule.round_reader_steps, schedule.round_steps] * schedule.rounds
        self.total, self.done, self.phase = sum(self.lengths), 0, 0
        self.skill: Skill | None = None
        self.readings_of = torch.zeros(0, dtype=torch.int64)
        self.guide: ParameterGuide | None = None
        self.inner: Training | None = None

    @property
    def learnt(self) -> tuple[Site, ...]:
        """The sites that can be read, and are in the target, in the order of the program; empty before the reader was
        tried."""
        good = dict(zip((*self.node_sites, *self.scene_sites), self._good.tolist(), strict=False))
        return tuple(site for site in self.sites if good.get(site))

    def why_not(self, site: Site) -> str:
        """Why a site keeps its prior; empty where it is learnt."""
        if site.keeps or site in self.learnt:
            return site.keeps
        assert self.skill is not None
        number = [*self.node_sites, *self.scene_sites].index(site)
        if not self.skill.readable[number]:
            return "it cannot be read in renders"
        return f"it was read {int(self.readings_of[number])} times in the target, of {ENOUGH} that it takes"

    @property
    def _good(self) -> Tensor:
        """``(S + G,)`` bool."""
        if self.skill is None:
            return torch.zeros(0, dtype=torch.bool)
        return self.skill.readable & (self.readings_of >= ENOUGH)

    def run(self, each: Report | None = None) -> None:
        """Take the steps that are left.

        Raises:
            ProbsceneError: a loss is no longer finite.
        """
        while self.phase < len(self.lengths):
            if self.phase % 2 and not self.learnt:  # nothing can be read
                self.phase, self.done = len(self.lengths), self.total
                return
            if self.inner is None:
                self.inner = self._begun()
            before = sum(self.lengths[: self.phase])

            def heard(training: Training, told: dict[str, float], before: int = before) -> None:
                self.done = before + training.done
                if each is not None:
                    each(self, told)

            self.inner.run(heard)
            self.inner = None
            self.phase += 1
            self.done = sum(self.lengths[: self.phase])
            if self.phase == 1:
                self._try()

    def summary(self) -> dict[str, Any]:
        """Nothing more for the log."""
        return {}

    def state(self) -> dict[str, Tensor]:
        """All that ``restore`` needs, as named tensors."""
        tensors = {f"reader.{key}": value for key, value in self.reader.state_dict().items()}
        tensors["phase"] = torch.tensor(self.phase)
        if self.skill is not None:
            tensors |= {"skill.way": self.skill.way, "skill.share": self.skill.share, "readings": self.readings_of}
        if self.guide is not None:
            tensors |= {f"guide.{key}": value for key, value in self.guide.net.state_dict().items()}
        if self.inner is not None:
            tensors |= {f"inner.{key}": value for key, value in self.inner.state().items()}
        return {key: value.clone() for key, value in tensors.items()}  # the reader is also its training's

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Go on from a ``state``."""
        self.phase = int(tensors["phase"])
        self.reader.load_state_dict(_within(tensors, "reader."))
        self.reader.eval()
        if "skill.way" in tensors:
            self.skill, self.readings_of = Skill(tensors["skill.way"], tensors["skill.share"]), tensors["readings"]
            self.guide = self._new_guide()
        if self.guide is not None:
            self.guide.net.load_state_dict(_within(tensors, "guide."))
        inner = _within(tensors, "inner.")
        if inner:
            self.inner = self._begun()
            self.inner.restore(inner)
        self.done = sum(self.lengths[: self.phase]) + (0 if self.inner is None else self.inner.done)

    def _begun(self) -> Training:
        """The training of this phase, from its first step."""
        schedule, first = self.schedule, self.phase < 2
        seed = batch_seed(self.seed, 1, self.phase)
        if self.phase % 2 == 0:
            steps = schedule.reader_steps if first else schedule.round_reader_steps
            rate = schedule.reader_rate / (1 if first else 2)
            return ReaderTraining(self.reader, self._drawn, steps, schedule.reader_images, rate, seed)
        guide = self.guide
        assert guide is not None
        steps, rate = (schedule.steps, schedule.rate) if first else (schedule.round_steps, 0.6 * schedule.rate)
        return MaximumLikelihood(guide.net, self._read(), steps, learning_rate=rate, seed=seed)

    def _drawn(self, num: int) -> Valued:
        """Renders for a step of the reader."""
        own = 0 if self.guide is None else round(OWN * num)
        parts = [self.renders.draw(num - own, self.model.pretraining_policy, arranged=ARRANGED)]
        if self.guide is not None and own:
            parts.append(self.renders.draw(own, self.structure, self.guide.suited(self.model)))
        return joined(parts)  # both in each step, as batch norm is of what a step looks at

    def _try(self) -> None:
        """See what the reader can read in the prior's renders."""
        seed_everything(batch_seed(self.seed, 2))
        valued = self.renders.draw(TRIED, self.model.pretraining_policy)
        found = self.reader.find(valued.drawn.image)
        which = matched(found, valued)
        of_nodes = Skill.of(found.raw[which >= 0], valued.u[found.image, which][which >= 0])
        of_scenes = Skill.of(found.overall, valued.overall)
        self.skill = Skill(*(torch.cat(pair) for pair in zip(of_nodes, of_scenes, strict=True)))
        images = self.images()
        objects = self.reader.find(images).label.bincount(minlength=len(self.model.classes))
        of_class = dict(zip(self.model.classes, objects.tolist(), strict=True))
        number = [sum(of_class.get(kind, 0) for kind in site.kinds) for site in self.node_sites]
        self.readings_of = torch.tensor([*number, *(len(images) for _ in self.scene_sites)], dtype=torch.int64)
        self.guide = self._new_guide()

    def _new_guide(self) -> ParameterGuide | None:
        """Of the sites that can be read; None where there are none."""
        return ParameterGuide(self.model, self.learnt, self.structure) if self.learnt else None

    def readings(self, images: Tensor) -> dict[str, Tensor]:
        """u of each learnt site as it is read in ``(L, C, H, W)`` uint8 images, of all objects that have it or of all
        scenes."""
        found, (nodes, scenes) = self.reader.find(images), self._skills()
        kind = torch.tensor([self.model.grammar.kind(name) for name in self.model.classes])[found.label]
        has = having(self.model.grammar, self.node_sites, kind).unbind(1)
        each = [u[there] for u, there in zip(nodes.read(found.raw)[0].unbind(1), has, strict=True)]
        names = [site.name for site in (*self.node_sites, *self.scene_sites)]
        columns = dict(zip(names, [*each, *scenes.read(found.overall)[0].unbind(1)], strict=True))
        return {site.name: columns[site.name].clamp(0, 1) for site in self.learnt}

    def _skills(self) -> tuple[Skill, Skill]:
        """Of the sites of nodes, and of scenes."""
        assert self.skill is not None
        S = len(self.node_sites)
        return Skill(*(part[:S] for part in self.skill)), Skill(*(part[S:] for part in self.skill))

    def _read(self) -> Values:
        """What the reader reads in the target."""
        made, images = self._assembly, self.images()
        seed_everything(batch_seed(self.seed, 3, self.phase))
        found, skills, S = self.reader.find(images), self._skills(), len(self.node_sites)
        node, scene = (some.nonzero().flatten() for some in self._good.tensor_split([S]))
        mean, sd = (part[:, node] for part in skills[0].read(found.raw))
        scene_mean, scene_sd = (part[:, scene] for part in skills[1].read(found.overall))
        kind, parent, *nodes = along_the_widest(made, found).values(found, len(images), mean, sd)
        has = having(self.model.grammar, tuple(self.node_sites[i] for i in node.tolist()), kind)
        turns = torch.cat([skills[0].turns[node], skills[1].turns[scene]])
        mean, sd = (part.where(has, torch.nan) for part in nodes)
        return Values(kind, parent, mean, sd, scene_mean, scene_sd, turns)

    @cached_property
    def _assembly(self) -> Assembly:
        """What the prior's scenes have in common; the same in every phase."""
        seed_everything(batch_seed(self.seed, 4))
        valued = self.renders.draw(TRIED, self.model.pretraining_policy)
        label = valued.drawn.label
        kinds = torch.tensor([self.model.grammar.kind(name) for name in self.model.classes] + [-1])
        centre = valued.drawn.centre.where((label >= 0).unsqueeze(-1), torch.nan)
        graph = Graph.of(kinds[label], valued.parent)
        return assembly(self.model.grammar, self.model.classes, graph, centre, valued.group)


def matched(found: Found, valued: Valued) -> Tensor:
    """``(K,)`` the node nearest to each object that was found; -1 where none is near."""
    drawn = valued.drawn
    there = (drawn.label >= 0) & (drawn.visible >= MIN_VISIBLE)
    away = (drawn.centre[found.image] - found.centre[:, None]).norm(dim=-1).masked_fill(~there[found.image], torch.inf)
    least, which = away.min(1)
    return torch.where(least < NEAR_ENOUGH, which, -1)


def _within(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {key.removeprefix(prefix): value for key, value in tensors.items() if key.startswith(prefix)}
