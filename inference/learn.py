"""The learning loop of a guide: Pyro's ``SVI`` with Adam on the objective, each batch seeded by its number, so that a
loop that was interrupted goes on to the same result."""

import math
from typing import Any, cast

import pyro
import torch
from pyro.infer import SVI
from pyro.optim import PyroOptim
from torch import Tensor

from probscene.errors import ProbsceneError
from probscene.sampling import seed_everything

from .guides.base import Guide
from .objective import ScoreFunction
from .render_cache import RenderCache
from .training import Report, batch_seed, check_finite, of_prefix, restore_training, training_state


class Trainer:
    """A ``Training`` of a guide's structure: ``SVI`` on a ``ScoreFunction``, resumable after every rendered batch.

    Args:
        model: a scene model.
        guide: learnt in place.
        objective: its ``updates`` are taken on each batch.
        real: ``(L, D)`` features of the real images.
        batches: rendered batches in all.
        num_scenes: scenes a batch, N.
        num_real: real images a batch, drawn anew each time (the paper); all of them where None.
        learning_rate: the first; it falls to 0 along a cosine, or stays where ``cosine`` is False (the paper).
        seed: batch k is drawn from (seed, k).
        pool: from which the objective takes renders again, kept with the rest.

    Attributes:
        unit, total, done: see ``Training``; batches.
    """

    unit = "batches"

    def __init__(
        self,
        model: Any,
        guide: Guide,
        objective: ScoreFunction,
        real: Tensor,
        batches: int,
        num_scenes: int = 500,
        num_real: int | None = None,
        learning_rate: float = 1e-2,
        cosine: bool = True,
        seed: int = 0,
        pool: RenderCache | None = None,
    ):
        self.pool = pool
        self.model, self.guide, self.objective, self.real = model, guide, objective, real
        self.total, self.num_scenes, self.num_real, self.seed = batches, num_scenes, num_real, seed
        self.learning_rate, self.cosine = learning_rate, cosine
        self.adam = _Adam(learning_rate)
        self.svi = SVI(model, guide, self.adam, loss=objective)
        self.done = 0

    def run(self, each: Report | None = None) -> None:
        """Take the batches that are left; ``each`` hears of the last one's ``diagnostics``.

        Raises:
            ProbsceneError: a cost or a parameter is no longer finite; the guide is then as it was before that batch.
        """
        self.guide.zero_grad()  # SVI adds to the gradients that it finds
        with pyro.get_param_store().scope():  # another guide's parameters have the same names
            while self.done < self.total:
                before = {key: value.clone() for key, value in self.guide.state_dict().items()}
                try:
                    self._batch()
                except ProbsceneError as error:
                    self.guide.load_state_dict(before)
                    raise type(error)(f"At batch {self.done + 1} of {self.total}: {error}") from error
                self.done += 1
                if each is not None:
                    each(self, self.diagnostics())

    def diagnostics(self) -> dict[str, float]:
        """Of the last batch: its mean cost, that cost's spread, rejections and length; and of all batches, how many
        scenes were rendered, and of how many, where renders are taken again."""
        batch = self.objective.batch
        assert batch is not None
        return {
            "batch": self.done,
            "cost": batch.cost.mean().item(),
            "cost_sd": batch.cost.std().item(),
            "rejections": batch.rejections,
            "length": batch.derivation.lengths.float().mean().item(),
            "learning_rate": self.adam.rate,
            **({} if self.pool is None else {"rendered": self.pool.drawn, "of": self.pool.asked}),
        }

    def summary(self) -> dict[str, Any]:
        """Nothing more for the log."""
        return {}

    def state(self) -> dict[str, Tensor]:
        """All that ``restore`` needs, as named tensors."""
        averages = {f"average-{stratum}": value for stratum, value in self.objective.averages.items()}
        whole = self.adam.whole(list(self.guide.parameters()))
        pool = {} if self.pool is None else self.pool.state()
        kept = {f"pool.{key}": value for key, value in pool.items()}
        return training_state(self.guide, {"adam": whole}, done=self.done, **averages) | kept

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Go on from a ``state``."""
        whole = torch.optim.Adam(self.guide.parameters())
        numbers = restore_training(self.guide, {"adam": whole}, tensors)
        self.adam.take(whole)
        self.done = int(numbers["done"])
        averages = {key: value for key, value in numbers.items() if key.startswith("average-")}
        if self.pool is not None:
            self.pool.restore(of_prefix(tensors, "pool."))
        self.objective.averages = {int(key.removeprefix("average-")): value for key, value in averages.items()}

    def _batch(self) -> None:
        seed_everything(batch_seed(self.seed, self.done))
        real = self.real
        if self.num_real is not None and self.num_real < len(real):
            real = real[torch.randperm(len(real))[: self.num_real]]
        updates, loss = self.objective.updates, 0.0
        for update in range(updates):
            progress = (self.done * updates + update) / (self.total * updates)
            self.adam.rate = self.learning_rate * (0.5 * (1 + math.cos(math.pi * progress)) if self.cosine else 1.0)
            loss = cast(float, self.svi.step(self.num_scenes, real=real))
        remedy = (
            f"begin again with a lower rate, such as learning_rate={self.learning_rate / 4:g}, or a larger variance; "
            "the guide is as it was before the batch"
        )
        check_finite(loss, self.guide.parameters(), "the guide", "in this batch", remedy)


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
        self.pt_optim_args["lr"] = rate  # of parameters that it has not seen yet
        for optimiser in self.optim_objs.values():
            for group in optimiser.param_groups:
                group["lr"] = rate

    def whole(self, parameters: list[Tensor]) -> torch.optim.Optimizer:
        """One optimiser of all parameters with the state of each."""
        whole = torch.optim.Adam(parameters)
        for parameter in parameters:
            if parameter in self.optim_objs:
                whole.state[parameter] = self.optim_objs[parameter].state[parameter]
        return whole

    def take(self, whole: torch.optim.Optimizer) -> None:
        """The reverse of ``whole``."""
        for parameter, slots in whole.state.items():
            self.optim_objs[parameter] = torch.optim.Adam([parameter], lr=self.rate)
            self.optim_objs[parameter].state[parameter] = slots
            self.grad_clip[parameter] = None
