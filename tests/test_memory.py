"""Freed memory that stays with the process."""

import resource
import sys

import pytest
import torch

from probscene.memory import freed_memory_kept

MANY = 64 << 20  # bytes

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="glibc's allocator alone")


def faults():
    """Pages that the system has to clear, for three tensors one after the other."""
    torch.zeros(MANY, dtype=torch.uint8).add_(1)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(3):
        torch.ones(MANY, dtype=torch.uint8)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before


def resident():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * resource.getpagesize()


def test_freed_memory_is_used_again_and_given_back_at_the_end():
    usual = faults()
    with freed_memory_kept():
        assert min(faults() for _ in range(10)) < 0.1 * usual  # the first ones may leave gaps
        torch.ones(4 * MANY, dtype=torch.uint8)
        held = resident()
    assert held - resident() > 3 * MANY


def test_it_is_given_back_after_an_error_too():
    with pytest.raises(ZeroDivisionError), freed_memory_kept():
        torch.ones(4 * MANY, dtype=torch.uint8)
        held = resident()
        raise ZeroDivisionError
    assert held - resident() > 3 * MANY
