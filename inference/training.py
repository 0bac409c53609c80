"""Trainings: work in steps that can be interrupted and goes on bit for bit, and what it keeps to do so."""

import math
from collections.abc import Callable, Iterable
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor, nn

from probscene.errors import ProbsceneError

Report = Callable[["Training", dict[str, float]], None]
"""Called after each step or few steps with the training and what it says of them, such as ``{"loss": 0.3}``."""


class Training(Protocol):
    """What ``fit`` runs, shows, saves and resumes: a feature network's training, a projection, a guide's learning.

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

    def run(self, each: Report | None = None) -> None:
        """Take the steps that are left; ``each`` hears of them.

        Raises:
            ProbsceneError: a loss or a parameter is no longer finite, see ``check_finite``.
        """
        ...

    def summary(self) -> dict[str, Any]:
        """A line for the log once it is finished, such as how well it went; empty for none."""
        ...

    def state(self) -> dict[str, Tensor]:
        """All that ``restore`` needs, as named tensors."""
        ...

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Go on from a ``state``."""
        ...


def of_prefix(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """The tensors whose names begin with it, by the rest of their names."""
    return {key.removeprefix(prefix): value for key, value in tensors.items() if key.startswith(prefix)}


def check_finite(loss: float, parameters: Iterable[Tensor], what: str, where: str, remedy: str) -> None:
    """The guard of every training.

    Args:
        what: whose loss it is, where: at which step, remedy: what to do; words of the message.

    Raises:
        ProbsceneError: the loss or a parameter is NaN or infinite.
    """
    if not math.isfinite(loss) or not all(torch.isfinite(p).all() for p in parameters):
        raise ProbsceneError(
            f"expected a finite loss and finite parameters of {what}, got a loss of {loss} {where} or parameters "
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
