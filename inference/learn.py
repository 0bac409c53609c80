"""The learning loop of a guide: Adam on the objective, each batch seeded by its number, so that a loop that was
interrupted goes on to the same result."""

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from probscene.errors import ProbsceneError
from probscene.sampling import seed_everything

from .objective import ScoreFunction
from .training import batch_seed, restore_training, training_state


class Trainer:
    """Adam on a ``ScoreFunction``, resumable after every rendered batch.

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

    Attributes:
        done: batches taken.
    """

    def __init__(
        self,
        model: Any,
        guide: nn.Module,
        objective: ScoreFunction,
        real: Tensor,
        batches: int,
        num_scenes: int = 500,
        num_real: int | None = None,
        learning_rate: float = 1e-2,
        cosine: bool = True,
        seed: int = 0,
    ):
        self.model, self.guide, self.objective, self.real = model, guide, objective, real
        self.batches, self.num_scenes, self.num_real, self.seed = batches, num_scenes, num_real, seed
        self.learning_rate, self.cosine = learning_rate, cosine
        self.optimiser = torch.optim.Adam(guide.parameters(), lr=learning_rate)
        self.done = 0

    def run(self, each: Callable[["Trainer", dict[str, float]], None] | None = None) -> None:
        """Take the batches that are left; ``each`` sees the learner and its diagnostics after every one.

        Raises:
            ProbsceneError: a cost or a parameter is no longer finite; the guide is then as it was before that batch.
        """
        while self.done < self.batches:
            before = {key: value.clone() for key, value in self.guide.state_dict().items()}
            seed_everything(batch_seed(self.seed, self.done))
            real = self.real
            if self.num_real is not None and self.num_real < len(real):
                real = real[torch.randperm(len(real))[: self.num_real]]
            for update in range(self.objective.updates):
                progress = (self.done * self.objective.updates + update) / (self.batches * self.objective.updates)
                for group in self.optimiser.param_groups:
                    factor = 0.5 * (1 + math.cos(math.pi * progress)) if self.cosine else 1.0
                    group["lr"] = self.learning_rate * factor
                self.optimiser.zero_grad()
                try:
                    loss = self.objective(self.model, self.guide, self.num_scenes, real=real)
                except ProbsceneError as error:
                    self.guide.load_state_dict(before)
                    raise type(error)(f"At batch {self.done + 1} of {self.batches}: {error}") from error
                loss.backward()
                self.optimiser.step()
            if not all(torch.isfinite(p).all() for p in self.guide.parameters()):
                self.guide.load_state_dict(before)
                raise ProbsceneError(
                    f"At batch {self.done + 1} of {self.batches}: Expected finite parameters, actual NaN or infinity; "
                    "the guide is as it was before it. Begin again with a lower rate, such as "
                    f"learning_rate={self.learning_rate / 4:g}, or a larger variance."
                )
            self.done += 1
            if each is not None:
                each(self, self.diagnostics())

    def diagnostics(self) -> dict[str, float]:
        """Of the last batch: its mean cost, that cost's spread, rejections and length."""
        batch = self.objective.batch
        return {
            "batch": self.done,
            "cost": batch.cost.mean().item(),
            "cost_sd": batch.cost.std().item(),
            "rejections": batch.rejections,
            "length": batch.derivation.lengths.float().mean().item(),
            "learning_rate": self.optimiser.param_groups[0]["lr"],
        }

    def state(self) -> dict[str, Tensor]:
        """All that ``restore`` needs, as named tensors."""
        averages = {f"average-{stratum}": value for stratum, value in self.objective.averages.items()}
        return training_state(self.guide, {"adam": self.optimiser}, done=self.done, **averages)

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Go on from a ``state``."""
        numbers = restore_training(self.guide, {"adam": self.optimiser}, tensors)
        self.done = int(numbers["done"])
        averages = {key: value for key, value in numbers.items() if key.startswith("average-")}
        self.objective.averages = {int(key.removeprefix("average-")): value for key, value in averages.items()}
