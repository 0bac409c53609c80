"""What becomes of memory that is freed: the one place where that, a setting of the whole process, is changed."""

import ctypes
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3  # numbers in glibc's malloc.h
KEPT, USUAL = 1 << 30, 32 << 20  # bytes; the latter is what glibc comes to by itself where large tensors are freed


@contextmanager
def freed_memory_kept() -> Iterator[None]:
    """Memory that is freed inside stays with the process, and is given back afterwards.

    What a network computes of a batch of images takes tens of megabytes, again and again. glibc gives blocks of that
    size back to the system at once, which then clears every page anew. Nothing changes where the C library is another
    one.
    """
    settings = _settings()
    if settings is None:
        yield
        return
    change, give_back = settings
    change(MMAP_THRESHOLD, KEPT)
    change(TRIM_THRESHOLD, KEPT)
    try:
        yield
    finally:
        change(MMAP_THRESHOLD, USUAL)
        change(TRIM_THRESHOLD, 2 * USUAL)
        give_back(0)


def _settings() -> tuple[Callable[[int, int], int], Callable[[int], int]] | None:
    """``mallopt`` and ``malloc_trim``, see their manual pages; None where there are none."""
    if not sys.platform.startswith("linux"):
        return None
    library = ctypes.CDLL(None)
    if not hasattr(library, "mallopt") or not hasattr(library, "malloc_trim"):  # musl has none
        return None
    return library.mallopt, library.malloc_trim
