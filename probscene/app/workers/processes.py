"""Worker processes: tasks by number, shared out one at a time.

They are spawned, because Taichi and torch do not survive a fork, and hold no state worth saving: the parent kills them
when it is interrupted, and a worker whose parent is gone ends after its task.
"""

import signal
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import get_context, resource_tracker
from multiprocessing.connection import Connection, wait
from typing import cast

from probscene.errors import MachineError, ProbsceneError
from probscene.threads import use_threads


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
        ProbsceneError: the first that a worker raised.
        MachineError: a worker was killed.
    """
    context = get_context("spawn")
    todo = iter(tasks)
    crew = {}
    if hasattr(signal, "pthread_sigmask"):
        resource_tracker.ensure_running()  # otherwise the first start would, and let interrupts through
    try:
        for _ in range(min(workers, len(tasks))):
            here, there = context.Pipe()
            process = context.Process(target=_work, args=(there, prepare, arguments), daemon=True)
            crew[here] = process
            with _interrupts_held():  # a worker inherits this: Ctrl-C on the terminal reaches the parent alone
                process.start()
            there.close()
            here.send(next(todo))
        while crew:
            for here in cast(list[Connection], wait(list(crew))):
                done(_answer(here))
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


def _answer(here: Connection) -> int:
    try:
        kind, value = here.recv()
    except (EOFError, ConnectionError) as error:
        raise MachineError(
            "A worker process was killed, most often for lack of memory. Run the same command again: it goes on where "
            "it stopped; fewer workers need less memory."
        ) from error
    if kind == "fault":
        raise value
    return value


def _work(there: Connection, prepare: Callable, arguments: tuple) -> None:
    try:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # where there is no mask to inherit
        use_threads(1)
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
