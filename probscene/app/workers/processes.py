"""Worker processes: tasks by number, shared out one at a time.

They are spawned, because the engine and torch do not survive a fork, and hold no state worth saving: the parent kills
them when it is interrupted, and a worker whose parent is gone ends after its task.

A process that is spawned first imports the script that started it. A script whose calls are not under a main guard
would begin again there.
"""

import os
import signal
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import current_process, get_context, resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import Any, cast

from probscene.errors import MachineError, ProbsceneError
from probscene.threads import use_threads

GUARD = 'if __name__ == "__main__":'
UNGUARDED = 78  # exit code of a worker that came to the call that had started it
NAME = "probscene worker"


def end_if_starting() -> None:
    """End this process where it is one of ``spread`` that still imports the script: without a main guard, what the
    script calls would begin again. For the first line of calls that take their time or start workers."""
    process = current_process()
    if process.name == NAME and getattr(process, "_inheriting", False):
        raise SystemExit(UNGUARDED)


def spread(
    prepare: Callable[..., Callable[[int], int]],
    arguments: tuple,
    workers: int,
    tasks: list[int],
    done: Callable[[int], None],
) -> None:
    """Call ``prepare(*arguments)(task)`` for every task in one of ``workers`` processes, each with one torch thread.

    Args:
        prepare: a module's function; called once a process.
        done: called here with each result, in the order they come.

    Raises:
        ProbsceneError: the first that a worker raised; the script has no main guard, or is in no file.
        MachineError: a worker was killed.
    """
    end_if_starting()
    _check_script()
    context = get_context("spawn")
    todo = iter(tasks)
    crew, begun = {}, set()
    if hasattr(signal, "pthread_sigmask"):
        resource_tracker.ensure_running()  # otherwise the first start would, and let interrupts through
    try:
        for _ in range(min(workers, len(tasks))):
            here, there = context.Pipe()
            process = context.Process(target=_work, args=(there, prepare, arguments), name=NAME, daemon=True)
            crew[here] = process
            with _interrupts_held():  # a worker inherits this: Ctrl-C on the terminal reaches the parent alone
                process.start()
            there.close()
            here.send(next(todo))
        while crew:
            for here in cast(list[Connection], wait(list(crew))):
                kind, value = _received(here, crew[here], here in begun)
                begun.add(here)
                if kind == "begun":
                    continue
                done(value)
                task = next(todo, None)
                if task is None:
                    here.close()
                    crew.pop(here).join()
                else:
                    here.send(task)
    finally:
        for process in crew.values():
            if process.pid is not None:
                process.kill()
                process.join()


def _check_script() -> None:
    """See that a worker can import the script, if any, as ``multiprocessing`` does."""
    main = sys.modules["__main__"]
    file = None if getattr(main, "__spec__", None) is not None else getattr(main, "__file__", None)
    if file is not None and not os.path.isfile(file):
        raise ProbsceneError(
            f"expected a script in a file, which worker processes import, got one from {file}; save it in a file, "
            f"with the calls that start workers under '{GUARD}', or take one worker."
        )


def _received(here: Connection, process: SpawnProcess, begun: bool) -> tuple[str, Any]:
    """What a worker sends; ``begun`` once it has said that it has imported the script."""
    try:
        kind, value = here.recv()
    except (EOFError, ConnectionError) as error:
        process.join()
        raise _ended(process.exitcode or 0, begun) from error
    if kind == "fault":
        raise value
    return kind, value


def _ended(code: int, begun: bool) -> ProbsceneError:
    remedy = f"put the calls that start workers under '{GUARD}', or take one worker."
    if code == UNGUARDED:
        return ProbsceneError(
            f"expected a script with a main guard, as worker processes import it, got one without; {remedy}"
        )
    if code >= 0 and not begun:
        return ProbsceneError(
            f"expected a worker process to start, got one that ended with code {code} while it imported the script; "
            f"what it printed stands above. Where the script has no main guard, {remedy}"
        )
    again = "Run the same command again: it continues where it stopped"
    if code >= 0:
        return MachineError(f"A worker process ended with code {code}; what it printed stands above. {again}.")
    return MachineError(
        f"A worker process was killed, most often for lack of memory. {again}; fewer workers need less memory."
    )


def _work(there: Connection, prepare: Callable, arguments: tuple) -> None:
    try:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # where there is no mask to inherit
        use_threads(1)
        there.send(("begun", None))
        task = there.recv()
        work = prepare(*arguments)
        while True:
            there.send(("result", work(task)))
            task = there.recv()
    except (EOFError, ConnectionError):
        pass  # all is done, or the parent is gone
    except ProbsceneError as error:
        there.send(("fault", error))
    except Exception:
        there.send(("fault", RuntimeError("in a worker process:\n" + traceback.format_exc())))


@contextmanager
def _interrupts_held() -> Iterator[None]:
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
