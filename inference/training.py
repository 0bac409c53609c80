"""What a training that can be interrupted keeps: a module, its optimisers and a few numbers, as named tensors."""

import numpy as np
import torch
from torch import Tensor, nn


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
