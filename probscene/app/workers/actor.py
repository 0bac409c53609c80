"""What runs on a node of a cluster: one task at a time, in a process of its own."""

import traceback
from collections.abc import Callable
from importlib.metadata import version
from typing import Any

import probscene
from probscene.errors import ProbsceneError
from probscene.renderers.engine_choice import engine_version
from probscene.renderers.generator.pool import close_pools
from probscene.threads import use_threads

DECIDING = ("torch", "numpy", "pyro-ppl", "opencv-python-headless")
"""Packages, beside the engine, of which another version may give other bytes."""


def versions() -> dict[str, str]:
    """Of the library and of what its bytes depend on, here."""
    packages = {name: version(name) for name in DECIDING}
    return {"probscene": probscene.__version__, "engine": engine_version(), **packages}


class Actor:
    """Does tasks by a function that it prepares once. Answers are pairs: ``"result"`` and what came of it, or
    ``"fault"`` and an exception."""

    def __init__(self):
        self._work: Callable[[Any], Any] | None = None

    def versions(self) -> tuple[str, Any]:
        """Answers with ``versions``."""
        return _answer(versions)

    def prepare(self, prepare: Callable[..., Callable[[Any], Any]], arguments: tuple, threads: int) -> tuple[str, Any]:
        """Answers with None."""

        def work() -> None:
            use_threads(threads)
            self._work = prepare(*arguments)

        return _answer(work)

    def close(self) -> None:
        """End the generators that were started here."""
        close_pools()

    def do(self, task: Any) -> tuple[str, Any]:
        work = self._work
        assert work is not None
        return _answer(lambda: work(task))


def _answer(work: Callable[[], Any]) -> tuple[str, Any]:
    try:
        return "result", work()
    except ProbsceneError as error:
        return "fault", error
    except Exception:
        return "fault", RuntimeError("on a node of the cluster:\n" + traceback.format_exc())
