"""Memory that a process frees and asks for again."""

import ctypes

TRIM, PAD, MAP = -1, -2, -3  # M_TRIM_THRESHOLD, M_TOP_PAD and M_MMAP_THRESHOLD of glibc's malloc.h


def tune_malloc() -> None:
    """Let glibc keep what is freed; elsewhere nothing happens.

    It gives large blocks back to the system at once, and the next batch's tensors, of the same size, come as new pages,
    each of them cleared and mapped: on a virtual machine two thirds of the time of learning a structure.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError, TypeError):  # no glibc
        return
    for option, size in ((MAP, 2**25), (MAP, 2**30), (TRIM, 2**29), (PAD, 2**25)):  # an old glibc takes 2**25 at most
        mallopt(option, size)
