"""A process that cleans up after a pool whose own process was killed: it ends the workers, also those that never
connected, and removes the pool's folder.

It is this file run as a script, and needs the standard library alone.
"""

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

END = "end"


class Reaper:
    """The cleaning process, which is told of each worker.

    Args:
        folder: removed when it ends.

    Raises:
        OSError: it cannot be started.
    """

    def __init__(self, folder: Path):
        self._folder = folder
        self._process = subprocess.Popen(
            [sys.executable, "-I", "-S", __file__, str(folder)],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
            text=True,
        )

    def started(self, pid: int) -> None:
        """Register a worker, the leader of its process group."""
        self._send(f"+{pid}")

    def ended(self, pid: int) -> None:
        """Remove a worker that has ended."""
        self._send(f"-{pid}")

    def close(self) -> None:
        """End the workers that run, and remove the folder."""
        self._send(END)  # a fork of this process may hold the pipe open
        assert self._process.stdin is not None
        with suppress(OSError):
            self._process.stdin.close()
        self._process.wait()
        shutil.rmtree(self._folder, ignore_errors=True)  # where the reaper was killed

    def _send(self, line: str) -> None:
        assert self._process.stdin is not None
        with suppress(OSError, ValueError):  # it is gone, or closed: the pool ends its workers itself
            print(line, file=self._process.stdin, flush=True)


def kill_group(pid: int) -> None:
    """End a process and its group."""
    with suppress(OSError):  # it has ended
        if hasattr(os, "killpg") and hasattr(signal, "SIGKILL"):
            os.killpg(pid, signal.SIGKILL)
        else:
            os.kill(pid, signal.SIGTERM)


def watch(folder: str, lines: Iterable[str]) -> None:
    """Follow which workers run until ``END``, or until the process that writes the lines has ended; then end them."""
    running = set()
    for line in lines:
        if line.strip() == END:
            break
        (running.add if line[0] == "+" else running.discard)(int(line[1:]))
    for pid in running:
        kill_group(pid)
    shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    watch(sys.argv[1], sys.stdin)
