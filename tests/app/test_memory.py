"""What is freed stays: asked for again, it is not cleared and mapped anew."""

import platform
import subprocess
import sys

import pytest

FAULTS = """
import resource
import numpy as np
from probscene.app.memory import tune_malloc

def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(20):
        np.ones(2**21)  # 16 MB, 4096 pages
        np.ones(2**23)  # a network's maps of 64 images
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

first = faults()
tune_malloc()
faults()
print(first, faults())
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="glibc alone gives memory back at once")
def test_memory_is_kept():
    done = subprocess.run([sys.executable, "-c", FAULTS], capture_output=True, text=True, check=True)
    first, again = map(int, done.stdout.split())
    assert again < 100 and again < first
