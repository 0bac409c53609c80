"""The device on which networks compute: the one place where a word becomes a ``torch.device``.

Grammars, programs and rendering stay on the CPU. A network that is placed on another device takes there what it is
given, and gives what it finds back on the CPU. Trainings draw their random numbers on the CPU, but for dropout's and
those that torchvision's Mask R-CNN draws.
"""

from itertools import chain

import torch
from torch import nn

from .errors import MachineError, ProbsceneError

CPU = torch.device("cpu")
AUTO = "auto"
TYPES = ("cpu", "cuda", "mps")


def chosen_device(name: str) -> torch.device:
    """The device of a word: ``"cpu"``, ``"cuda"``, ``"cuda:1"``, ``"mps"``, or ``"auto"``, a CUDA GPU where there is
    one and else the CPU.

    Raises:
        ProbsceneError: another word.
        MachineError: a device that this machine lacks.
    """
    if name == AUTO:
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
    except RuntimeError:
        device = None
    if device is None or device.type not in TYPES:
        raise ProbsceneError(f"expected a device auto, cpu, cuda, cuda:1 or mps, got {name!r}.")
    if (device.index or 0) >= (number := _number(device.type)):
        remedy = f"name one below {number}" if number else "take cpu, or install a build of torch for it"
        raise MachineError(
            f"expected a device that torch finds on this machine, got {name}, where it finds {number} of type "
            f"{device.type}; {remedy}."
        )
    return device if device.index else torch.device(device.type)  # the first one has one name


def device_of(module: nn.Module) -> torch.device:
    """Where a module's parameters are, or its buffers where it has none; the CPU where it has neither."""
    first = next(chain(module.parameters(), module.buffers()), None)
    return CPU if first is None else first.device


def _number(kind: str) -> int:
    """How many devices of a type there are."""
    if kind == "cuda":
        return torch.cuda.device_count() if torch.cuda.is_available() else 0
    return 1 if kind == "cpu" else int(torch.backends.mps.is_available())
