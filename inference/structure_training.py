"""Training of a guide's structure: Pyro's ``SVI`` with Adam on the score-function objective, a batch a step, so that a
training that was interrupted goes on to the same result."""

import math
from dataclasses import dataclass
from typing import Any, cast

import pyro
import torch
from pyro.infer import SVI
from pyro.optim import PyroOptim
from torch import Tensor

from probscene.errors import ProbsceneError

from .guides.base import Guide
from .objective import ScoreFunction
from .render_cache import RenderCache
from .training import Callback, TrainingLoop, check_finite, of_prefix, restore_training, training_state


@dataclass(frozen=True)
class StructureSchedule:
    """How long structures are trained.

    Args:
        batches: rendered batches in all.
        num_scenes: scenes a batch, N.
        num_real: real images a batch, a new sample each time (the paper); all of them where None.
        learning_rate: at the start; it falls to 0 along a cosine, or stays where ``cosine`` is False (the paper).
    """

    batches: int
    num_scenes: int = 500
    num_real: int | None = None
    learning_rate: float = 1e-2
    cosine: bool = True


class StructureTraining(TrainingLoop):
    """``SVI`` on a ``ScoreFunction``; each step draws and renders one batch of scenes.

    Args:
        model: a scene model.
        guide: trained in place.
        objective: its ``updates`` are taken on each batch.
        real: ``(L, D)`` features of the real images.
        schedule: how long.
        seed: batch k is drawn from (seed, k).
        render_cache: the cache that the objective looks features up in, if any; part of ``state``.

    Attributes:
        unit, total, done: see ``Training``; batches.
    """

    unit = "batches"
    subject = "the guide"

    def __init__(
        self,
        model: Any,
        guide: Guide,
        objective: ScoreFunction,
        real: Tensor,
        schedule: StructureSchedule,
        seed: int = 0,
        render_cache: RenderCache | None = None,
    ):
        super().__init__(guide, {}, schedule.batches, seed)
        self.model, self.guide, self.objective, self.real = model, guide, objective, real
        self.schedule, self.render_cache = schedule, render_cache
        self.adam = _Adam(schedule.learning_rate)
        self.svi = SVI(model, guide, self.adam, loss=objective)

    def run(self, callback: Callback | None = None) -> None:
        """See ``Training``; the callback is given ``diagnostics``. If a batch fails, the guide is as it was before."""
        self.guide.zero_grad()  # SVI adds to the gradients that it finds
        with pyro.get_param_store().scope():  # another guide's parameters have the same names
            super().run(callback)

    def step(self) -> float:
        """See ``TrainingLoop``."""
        before = {key: value.clone() for key, value in self.guide.state_dict().items()}
        try:
            return self._batch()
        except ProbsceneError as error:
            self.guide.load_state_dict(before)
            raise type(error)(f"At batch {self.done + 1} of {self.total}: {error}") from error

    def report(self, loss: float) -> dict[str, float]:
        """See ``TrainingLoop``."""
        return self.diagnostics()

    def diagnostics(self) -> dict[str, float]:
        """Of the last batch: mean and standard deviation of the cost, rejections, mean length of a derivation, learning
        rate; with a render cache, how many scenes were rendered in all batches, and ``of`` how many."""
        batch, cache = self.objective.batch, self.render_cache
        assert batch is not None
        return {
            "batch": self.done,
            "cost": batch.cost.mean().item(),
            "cost_sd": batch.cost.std().item(),
            "rejections": batch.rejections,
            "length": batch.derivation.lengths.float().mean().item(),
            "learning_rate": self.adam.rate,
            **({} if cache is None else {"rendered": cache.rendered, "of": cache.requested}),
        }

    def state(self) -> dict[str, Tensor]:
        """See ``Training``."""
        averages = {f"average-{stratum}": value for stratum, value in self.objective.averages.items()}
        adam = self.adam.combined(list(self.guide.parameters()))
        cached = {} if self.render_cache is None else self.render_cache.state()
        renders = {f"pool.{key}": value for key, value in cached.items()}
        return training_state(self.guide, {"adam": adam}, done=self.done, **averages) | renders

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """See ``Training``."""
        adam = torch.optim.Adam(self.guide.parameters())
        numbers = restore_training(self.guide, {"adam": adam}, tensors)
        self.adam.split(adam)
        self.done = int(numbers["done"])
        averages = {key: value for key, value in numbers.items() if key.startswith("average-")}
        if self.render_cache is not None:
            self.render_cache.restore(of_prefix(tensors, "pool."))
        self.objective.averages = {int(key.removeprefix("average-")): value for key, value in averages.items()}

    def _batch(self) -> float:
        real, schedule = self.real, self.schedule
        if schedule.num_real is not None and schedule.num_real < len(real):
            real = real[torch.randperm(len(real))[: schedule.num_real]]
        updates, loss = self.objective.config.updates, 0.0
        for update in range(updates):
            progress = (self.done * updates + update) / (self.total * updates)
            self.adam.rate = schedule.learning_rate * (
                0.5 * (1 + math.cos(math.pi * progress)) if schedule.cosine else 1.0
            )
            loss = cast(float, self.svi.step(schedule.num_scenes, real=real))
        remedy = (
            f"begin again with a lower rate, such as learning_rate={schedule.learning_rate / 4:g}, or a larger "
            "variance; the guide is as it was before the batch"
        )
        check_finite(loss, self.guide.parameters(), self.subject, "in this batch", remedy)
        return loss


class _Adam(PyroOptim):
    """Adam whose rate is the same for all parameters and can be set between two steps."""

    pt_optim_args: dict[str, Any]

    def __init__(self, rate: float):
        super().__init__(torch.optim.Adam, {"lr": rate})

    @property
    def rate(self) -> float:
        return self.pt_optim_args["lr"]

    @rate.setter
    def rate(self, rate: float) -> None:
        self.pt_optim_args["lr"] = rate  # of parameters that it has no optimiser of yet
        for optimiser in self.optim_objs.values():
            for group in optimiser.param_groups:
                group["lr"] = rate

    def combined(self, parameters: list[Tensor]) -> torch.optim.Optimizer:
        """One optimiser of all parameters with the state of each; Pyro has one optimiser a parameter."""
        adam = torch.optim.Adam(parameters)
        for parameter in parameters:
            if parameter in self.optim_objs:
                adam.state[parameter] = self.optim_objs[parameter].state[parameter]
        return adam

    def split(self, adam: torch.optim.Optimizer) -> None:
        """The reverse of ``combined``."""
        for parameter, slots in adam.state.items():
            self.optim_objs[parameter] = torch.optim.Adam([parameter], lr=self.rate)
            self.optim_objs[parameter].state[parameter] = slots
            self.grad_clip[parameter] = None
