"""Training: one loop of seeded steps, which can be interrupted and goes on bit for bit, and what it keeps to do so."""

import math
from collections.abc import Callable, Iterable
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor, nn

from probscene.errors import ProbsceneError
from probscene.sampling import seed_everything

Callback = Callable[["Training", dict[str, float]], None]
"""Called after each step or few steps with the training and numbers about them, such as ``{"loss": 0.3}``."""


class Training(Protocol):
    """What ``fit`` runs, shows, saves and resumes: a feature network's training, a projection, a guide's training.

    Laws: ``done`` only grows, up to ``total`` at most; ``run`` takes the steps that are left; a training of the same
    arguments that is given ``state()`` by ``restore`` goes on to the same result, bit for bit.

    Attributes:
        unit: what a step is called, in the plural: ``"steps"``, ``"epochs"``, ``"batches"``, ``"structures"``.
        total: steps at most.
        done: steps taken.
    """

    unit: str
    total: int
    done: int

    def run(self, callback: Callback | None = None) -> None:
        """Take the steps that are left.

        Raises:
            ProbsceneError: a loss or a parameter is no longer finite, see ``check_finite``.
        """
        ...

    def summary(self) -> dict[str, Any]:
        """A line for the log once the training is finished; empty for none."""
        ...

    def state(self) -> dict[str, Tensor]:
        """All that ``restore`` needs, as named tensors."""
        ...

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Go on from a ``state``."""
        ...


class TrainingLoop:
    """A ``Training`` by ``step``, which subclasses give. Step k draws its random numbers from (seed, k).

    Args:
        module: trained in place.
        optimisers: by the name that their state has in ``state``.
        total: steps at most.
        seed: of everything random.

    Attributes:
        unit, total, done: see ``Training``.
        subject, remedy: what is trained and what to do if it fails, for messages.
        report_every: steps from one finite check and callback to the next.
        seed_path: step k is seeded by (seed, seed_path, k).
    """

    unit = "steps"
    subject = "the network"
    remedy = "begin again with a lower rate"
    report_every = 1
    seed_path: tuple[int, ...] = ()

    def __init__(self, module: nn.Module, optimisers: dict[str, torch.optim.Optimizer], total: int, seed: int):
        self.module, self.optimisers, self.total, self.seed, self.done = module, optimisers, total, seed, 0

    def step(self) -> float:
        """Take one step and return its loss."""
        raise NotImplementedError

    def seed_step(self) -> None:
        """Seed the next step."""
        seed_everything(batch_seed(self.seed, *self.seed_path, self.done))

    @property
    def finished(self) -> bool:
        """Whether no step is left."""
        return self.done >= self.total

    def report(self, loss: float) -> dict[str, float]:
        """What the callback is given; ``loss`` is the mean over the steps since the last report."""
        return {"loss": loss}

    def run(self, callback: Callback | None = None) -> None:
        """See ``Training``."""
        losses = []
        while not self.finished:
            self.seed_step()
            losses.append(self.step())
            self.done += 1
            if self.done % self.report_every == 0 or self.finished:
                loss, losses = sum(losses) / len(losses), []
                where = f"after {self.done} of {self.total} {self.unit}"
                check_finite(loss, self.module.parameters(), self.subject, where, self.remedy)
                if callback is not None:
                    callback(self, self.report(loss))

    def summary(self) -> dict[str, Any]:
        """See ``Training``; empty."""
        return {}

    def state(self) -> dict[str, Tensor]:
        """See ``Training``."""
        return training_state(self.module, self.optimisers, done=self.done)

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """See ``Training``."""
        self.done = int(restore_training(self.module, self.optimisers, tensors)["done"])


class AdamTraining(TrainingLoop):
    """A ``TrainingLoop`` of one optimiser by ``loss``, which subclasses give.

    Args:
        module: trained in place.
        optimiser: of its parameters, each group at its largest rate; rates fall to 0 along a cosine.
        steps: in all.
        seed: of everything random.
        warmup_steps: first steps, in which rates rise from 0.
        max_grad_norm: gradients of a larger norm are scaled down to it.
    """

    report_every = 10

    def __init__(
        self,
        module: nn.Module,
        optimiser: torch.optim.Optimizer,
        steps: int,
        seed: int,
        warmup_steps: int = 0,
        max_grad_norm: float = 5.0,
    ):
        super().__init__(module, {"adam": optimiser}, steps, seed)
        self.optimiser, self.rates = optimiser, [group["lr"] for group in optimiser.param_groups]
        self.warmup_steps, self.max_grad_norm = warmup_steps, max_grad_norm

    def loss(self) -> Tensor:
        """Of a step, with its gradient; it may draw random numbers."""
        raise NotImplementedError

    def step(self) -> float:
        """See ``TrainingLoop``."""
        warmup = min(1.0, (self.done + 1) / self.warmup_steps) if self.warmup_steps else 1.0
        factor = warmup * 0.5 * (1 + math.cos(math.pi * self.done / self.total))
        for group, rate in zip(self.optimiser.param_groups, self.rates, strict=True):
            group["lr"] = rate * factor
        loss = self.loss()
        self.optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(self.module.parameters(), self.max_grad_norm)
        self.optimiser.step()
        return loss.item()

    def run(self, callback: Callback | None = None) -> None:
        """See ``Training``; the callback is given the mean loss after every tenth step."""
        self.module.train()
        super().run(callback)
        self.module.eval()


def of_prefix(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """The tensors whose names begin with it, by the rest of their names."""
    return {key.removeprefix(prefix): value for key, value in tensors.items() if key.startswith(prefix)}


def check_finite(loss: float, parameters: Iterable[Tensor], subject: str, where: str, remedy: str) -> None:
    """Raise unless a loss and all parameters are finite.

    Args:
        subject: whose loss it is, for the message; where: at which step; remedy: what to do.

    Raises:
        ProbsceneError: the loss or a parameter is NaN or infinite.
    """
    if not math.isfinite(loss) or not all(torch.isfinite(p).all() for p in parameters):
        raise ProbsceneError(
            f"expected a finite loss and finite parameters of {subject}, got a loss of {loss} {where} or parameters "
            f"that are NaN or infinite; {remedy}."
        )


def batch_seed(seed: int, *path: int) -> int:
    """A seed of its own for the part of a run that ``path`` names, ``0..2**32 - 1``."""
    return int(np.random.SeedSequence(seed, spawn_key=path).generate_state(1)[0])


def training_state(
    module: nn.Module, optimisers: dict[str, torch.optim.Optimizer], **numbers: float
) -> dict[str, Tensor]:
    """Named tensors from which ``restore_training`` goes on bit for bit."""
    tensors = {f"module.{key}": value for key, value in module.state_dict().items()}
    for name, optimiser in optimisers.items():
        for index, slots in optimiser.state_dict()["state"].items():
            tensors |= {f"slot.{name}.{index}.{slot}": torch.as_tensor(value) for slot, value in slots.items()}
    return tensors | {f"number.{key}": torch.tensor(value, dtype=torch.float64) for key, value in numbers.items()}


def restore_training(
    module: nn.Module, optimisers: dict[str, torch.optim.Optimizer], tensors: dict[str, Tensor]
) -> dict[str, float]:
    """Put a ``training_state`` back, in place; returns its numbers."""
    module.load_state_dict({k[7:]: v for k, v in tensors.items() if k.startswith("module.")})
    for name, optimiser in optimisers.items():
        whole = optimiser.state_dict()
        for key, value in tensors.items():
            if key.startswith(f"slot.{name}."):
                index, slot = key.split(".")[2:]
                whole["state"].setdefault(int(index), {})[slot] = value.clone()
        optimiser.load_state_dict(whole)
    return {k[7:]: v.item() for k, v in tensors.items() if k.startswith("number.")}
