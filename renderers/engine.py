"""The one module that imports Taichi, or Quadrants in its place: started lazily, on the CPU, in the process that draws.

Kernels live in modules of their own, take ``ti`` from here, and have arrays as their only arguments. Three facts about
both on a CPU shape them: a loop of at most 512 iterations runs on one thread, so a kernel counts to 512 for every
worker and lets the first of each 512 work; arrays should be flat; postponed annotations break kernels.
"""

import contextlib
import io
import os
import tempfile
import warnings
from typing import Any

from probscene.cache import cache_folder
from probscene.errors import ModelError, ProbsceneError
from probscene.threads import cores

from .engine_choice import engine_name

os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")
os.environ.setdefault("ENABLE_QUADRANTS_HEADER_PRINT", "0")
os.environ.setdefault("TI_SKIP_VERSION_CHECK", "ON")  # otherwise the import asks a server for the latest version

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # deprecations inside the engine must not fail a run under -W error
    if engine_name() == "quadrants":
        import quadrants as ti
    else:
        import taichi as ti

__all__ = ["check_canvas", "started", "start", "ti"]

_forked_after_start = False


def check_canvas(canvas: tuple[int, int], threads: int | None, most: int) -> tuple[tuple[int, int], int]:
    """Height and width, pixels, and how many threads render: one for every core where None.

    Raises:
        ModelError: a canvas that is empty or of more than ``most`` pixels, or fewer than one thread.
    """
    height, width = canvas
    if min(height, width) < 1 or height * width > most:
        raise ModelError(f"expected a canvas of 1 to {most} pixels, got {height} by {width}; choose another size.")
    if threads is not None and threads < 1:
        raise ModelError(f"expected at least one thread, got {threads}; leave it out to use every core.")
    return (int(height), int(width)), threads or cores()


def started() -> bool:
    """Whether the engine runs in this process, by ``start`` or by the user's own ``ti.init``."""
    return ti.cfg is not None


def start() -> None:
    """Start the engine unless it runs already; a program that has called ``ti.init`` itself keeps what it chose.

    How many threads a kernel uses is decided at each call by its number of workers; the engine gets one for every core.

    Raises:
        ProbsceneError: in a process forked from one in which it ran; its threads are gone and a kernel would hang.
    """
    if _forked_after_start:
        raise ProbsceneError(
            f"expected to render in a process that started {ti.__name__} itself, got a fork of one that had rendered; "
            "start worker processes with multiprocessing's 'spawn' method."
        )
    if started():
        return
    with contextlib.redirect_stdout(io.StringIO()):  # ti.init prints a banner
        ti.init(
            arch=ti.cpu,
            cpu_max_num_threads=cores(),
            fast_math=False,
            cfg_optimization=False,  # takes longer than all other passes where arrays are local; LLVM does as well
            log_level=ti.ERROR,
            **_cache(),
        )


def _cache() -> dict[str, Any]:
    """Where compiled kernels are kept between runs, safe with several processes; nowhere if nothing can be written."""
    folder = cache_folder() / ti.__name__
    with contextlib.suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
    if os.access(folder, os.W_OK | os.X_OK):
        return {"offline_cache": True, "offline_cache_file_path": str(folder)}
    # Taichi crashes at exit if it cannot write to its folder, even where it keeps no cache.
    return {"offline_cache": False, "offline_cache_file_path": tempfile.gettempdir()}


def _remember_fork() -> None:
    global _forked_after_start
    _forked_after_start = _forked_after_start or started()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_remember_fork)
