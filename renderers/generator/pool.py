"""As many processes of one ``Command`` as are asked for, shared by all who draw with it in this process.

A scene goes to whichever worker is free; what it draws does not depend on which. A worker that fails is killed with all
that it has started, and a fresh one tries the scene again. At the end of this process all are ended, by the reaper
where it was killed.
"""

import os
import shutil
import socket
import tempfile
import threading
from collections import Counter
from concurrent.futures import Future
from multiprocessing.util import Finalize
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from probscene import worker
from probscene.errors import GeneratorError
from probscene.generator import Command

from .picture_cache import PictureCache
from .process import Process, log_of, no_space, tail
from .reaper import Reaper
from .reply import Fault, Picture

_MAX_PATH_LENGTH = 80  # characters of a folder's path: a socket's may have 107
_POOLS: dict[tuple[int, Command], "Pool"] = {}
_LOCK = threading.Lock()
_Task = tuple[dict[str, Any], "Future[Picture]"]


def pool_for(command: Command, workers: int) -> "Pool":
    """The pool of a command in this process, of at least so many workers unless the command says how many."""
    with _LOCK:
        key = os.getpid(), command  # a fork has none of its parent's
        if key not in _POOLS or _POOLS[key].closed:
            _POOLS[key] = Pool(command)
        _POOLS[key].grow(workers if command.workers is None else command.workers)
        return _POOLS[key]


def close_pools(command: Command | None = None) -> None:
    """End the workers of a command in this process, or of all; who draws again has fresh ones."""
    with _LOCK:
        for key in [key for key in _POOLS if key[0] == os.getpid() and command in (None, key[1])]:
            _POOLS.pop(key).close()


class Pool:
    """Workers, started when there is something to draw.

    Args:
        command: what they run.

    Raises:
        MachineError: there is no room for temporary files.
    """

    def __init__(self, command: Command):
        self.command, self.closed = command, False
        self._cache = None if command.keep is None else PictureCache(Path(command.keep), command)
        self._tasks: SimpleQueue[_Task | None] = SimpleQueue()
        self._processes: dict[int, Process] = {}
        self._threads: list[threading.Thread] = []
        self._lock, self._owner = threading.RLock(), os.getpid()
        try:
            self.folder = Path(tempfile.mkdtemp(prefix="probscene-"))
            if hasattr(socket, "AF_UNIX") and len(str(self.folder)) > _MAX_PATH_LENGTH:
                self.folder.rmdir()
                self.folder = Path(tempfile.mkdtemp(prefix="probscene-", dir="/tmp"))
            shutil.copyfile(worker.__file__, self.folder / "probscene_worker.py")
            self._reaper = Reaper(self.folder)
        except OSError as error:
            raise no_space(command, error) from error
        Finalize(None, self.close, exitpriority=1)  # also at the end of a process that multiprocessing has started

    def grow(self, workers: int) -> None:
        """Let at least so many workers draw at once."""
        with self._lock:
            for number in range(len(self._threads), workers):
                thread = threading.Thread(target=self._work, args=(number,), daemon=True)
                self._threads.append(thread)
                thread.start()

    def draw(self, records: list[dict[str, Any]]) -> list[Picture]:
        """Draw scenes; the answers come in their order.

        Raises:
            GeneratorError: the program does not start, or a scene could not be drawn in as many attempts as its command
                says; the first such one.
        """
        futures: list[Future[Picture]] = [Future() for _ in records]
        for task in zip(records, futures, strict=True):
            self._tasks.put(task)
        try:
            return [future.result() for future in futures]
        finally:
            for future in futures:
                future.cancel()

    def processes(self) -> list[int]:
        """The process ids of the workers that run."""
        with self._lock:
            return [process.pid for process in self._processes.values()]

    def close(self) -> None:
        """End all workers; what is being drawn is an error."""
        if self._owner != os.getpid():
            return
        with self._lock:
            self.closed = True
            for process in self._processes.values():
                process.kill()
            for _ in self._threads:
                self._tasks.put(None)
        self._reaper.close()

    def _work(self, number: int) -> None:
        """One worker's thread."""
        while True:
            task = self._tasks.get()
            if task is None:
                return
            record, future = task
            if not future.set_running_or_notify_cancel():
                continue
            try:
                future.set_result(self._drawn(record, number))
            except BaseException as error:
                future.set_exception(error)

    def _drawn(self, record: dict[str, Any], number: int) -> Picture:
        if self._cache is None:
            return self._draw(record, number)
        if (picture := self._cache.load(record)) is None:
            self._cache.save(record, picture := self._draw(record, number))
        return picture

    def _draw(self, record: dict[str, Any], number: int) -> Picture:
        faults: list[str] = []
        for _ in range(self.command.attempts):
            try:
                process = self._process(number)
                picture = process.draw(record)
            except Fault as fault:
                if self.closed:
                    break
                printed = tail(log_of(self.folder, number))
                faults.append(f"{fault}\nThe end of what it printed:\n{printed}" if printed else str(fault))
                self._end(number)
                continue
            if process.exceeds_memory:
                self._end(number)
            return picture
        if self.closed:
            raise GeneratorError(f"The generator {self.command.name} was ended while it drew.")
        raise GeneratorError(
            f"expected the generator {self.command.name} to draw the scene of seed {record['seed']} "
            f"({_contents(record)}), got, in {len(faults)} attempts: {faults[-1]}"
        )

    def _process(self, number: int) -> Process:
        with self._lock:
            if self.closed:
                raise Fault("it was ended")
            if number in self._processes:
                return self._processes[number]
            process = self._processes[number] = Process(self.command, self.folder, number)
            self._reaper.started(process.pid)
        try:
            process.connect()
        except BaseException:
            self._end(number)
            raise
        return process

    def _end(self, number: int) -> None:
        with self._lock:
            process = self._processes.get(number)
        if process is not None:
            process.kill()
            with self._lock:  # only now, as close() kills what is still here
                self._processes.pop(number, None)
                self._reaper.ended(process.pid)


def _contents(record: dict[str, Any]) -> str:
    counts = Counter(node["kind"] for node in record["nodes"])
    return ", ".join(f"{number} {kind}" for kind, number in counts.items()) or "empty"
