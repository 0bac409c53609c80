"""A ``Training`` in steps of one optimiser, each seeded by its number."""

import math
from typing import Any

import torch
from torch import Tensor, nn

from probscene.sampling import seed_everything

from .training import Report, batch_seed, check_finite, restore_training, training_state

REPORTED = 10  # steps from one report to the next


class StepTraining:
    """Subclasses give ``loss``.

    Args:
        module: trained in place.
        optimiser: of its parameters, each group at its largest rate; rates fall to 0 along a cosine.
        steps: in all.
        seed: of everything random.
        warming: first steps, in which rates rise from 0.
        longest: gradient that is taken whole; the norm of longer ones is cut to it.

    Attributes:
        what: is trained, in words, for messages.
        unit, total, done: see ``Training``.
    """

    what = "the network"
    unit = "steps"

    def __init__(
        self,
        module: nn.Module,
        optimiser: torch.optim.Optimizer,
        steps: int,
        seed: int,
        warmup_steps: int = 0,
        max_grad_norm: float = 5.0,
    ):
        self.module, self.optimiser, self.total, self.seed, self.done = module, optimiser, steps, seed, 0
        self.rates = [group["lr"] for group in optimiser.param_groups]
        self.warmup_steps, self.max_grad_norm = warmup_steps, max_grad_norm

    def loss(self) -> Tensor:
        """Of a step, with its gradient; it may draw random numbers."""
        raise NotImplementedError

    def run(self, each: Report | None = None) -> None:
        """Take the steps that are left; ``each`` hears the mean loss after every tenth.

        Raises:
            ProbsceneError: the loss or a parameter is no longer finite.
        """
        self.module.train()
        losses = []
        while self.done < self.total:
            seed_everything(batch_seed(self.seed, self.done))
            losses.append(self._step())
            self.done += 1
            if self.done % REPORTED == 0 or self.done == self.total:
                mean, losses = sum(losses) / len(losses), []
                where = f"at step {self.done}"
                check_finite(mean, self.module.parameters(), self.what, where, "begin again with a lower rate")
                if each is not None:
                    each(self, {"loss": mean})
        self.module.eval()

    def summary(self) -> dict[str, Any]:
        """Nothing more for the log."""
        return {}

    def state(self) -> dict[str, Tensor]:
        """All that ``restore`` needs, as named tensors."""
        return training_state(self.module, {"adam": self.optimiser}, done=self.done)

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Go on from a ``state``."""
        self.done = int(restore_training(self.module, {"adam": self.optimiser}, tensors)["done"])

    def _step(self) -> float:
        warm = min(1.0, (self.done + 1) / self.warmup_steps) if self.warmup_steps else 1.0
        factor = warm * 0.5 * (1 + math.cos(math.pi * self.done / self.total))
        for group, rate in zip(self.optimiser.param_groups, self.rates, strict=True):
            group["lr"] = rate * factor
        loss = self.loss()
        self.optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.module.parameters(), self.max_grad_norm)
        self.optimiser.step()
        return loss.item()
