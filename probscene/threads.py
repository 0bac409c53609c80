"""How many threads torch computes with: the one place where that, a setting of the whole process, is changed."""

import os
from collections.abc import Iterator
from contextlib import contextmanager

import torch


def cores() -> int:
    """The cores that this process may use: fewer than the machine has, where the system tells."""
    if hasattr(os, "sched_getaffinity"):  # Linux
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def default_threads() -> int:
    """As many as ``OMP_NUM_THREADS`` says, which torch goes by as well, and schedulers set; else one for each core."""
    first = os.environ.get("OMP_NUM_THREADS", "").split(",")[0].strip()  # the others are of nested loops
    return int(first) if first.isdecimal() and int(first) else cores()


@contextmanager
def threads(number: int) -> Iterator[None]:
    """So many of torch's threads inside; as many as before afterwards.

    Small tensors, such as a guide's, are faster with one. Sums of floats depend on how many threads share them, so that
    what is to be the same bytes everywhere has a number of its own.
    """
    before = torch.get_num_threads()
    use_threads(number)
    try:
        yield
    finally:
        use_threads(before)


def use_threads(number: int) -> None:
    """So many of torch's threads from now on: for a process that is all one's own, such as a worker or a benchmark."""
    torch.set_num_threads(number)
