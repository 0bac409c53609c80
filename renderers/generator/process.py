"""One process of a ``Command``: started, asked for one scene after the other, killed with all that it has started."""

import os
import secrets
import signal
import socket
import subprocess
import time
from pathlib import Path
from typing import Any

from probscene import worker
from probscene.errors import GeneratorError, MachineError
from probscene.generator import Command

from .reaper import kill_group
from .reply import Fault, Picture, parse_reply

LOG_LINES, MAX_LOG_BYTES = 12, 1 << 20  # lines of a log in a message; bytes after which the log is emptied
MAX_REPLY_BYTES = 1 << 30  # bytes of an answer
_POLL_SECONDS = 0.1  # seconds between two checks that a process which has not connected still runs
_LOG_CHARACTERS = 4000  # characters


class Process:
    """A worker that was started; it draws once it is connected.

    Args:
        command: what runs.
        folder: for its socket, its log and the file that it imports.
        number: of the worker, for the names of these.

    Attributes:
        drawn: scenes so far.
        memory: megabytes that it had in use, at most.

    Raises:
        GeneratorError: the program cannot be started.
        MachineError: there is no room for temporary files.
    """

    def __init__(self, command: Command, folder: Path, number: int):
        self.command, self.drawn, self.memory = command, 0, 0.0
        self._log = log_of(folder, number)
        try:
            self._log.write_bytes(b"")
            self._listening, address = worker.listening(folder, number)
        except OSError as error:
            raise no_space(command, error) from error
        self._token = secrets.token_hex(16)
        variables = {worker.SOCKET: address, worker.TOKEN: self._token, "PROBSCENE_WORKER": str(folder)}
        try:
            with open(self._log, "ab") as log:  # so that it can be cut off while it is written
                self._process = subprocess.Popen(
                    command.argv,
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=subprocess.STDOUT,
                    env={**os.environ, **variables},
                    start_new_session=True,
                )
        except OSError as error:
            self._listening.close()
            raise GeneratorError(
                f"expected to start the generator {command.name}, got {error.strerror} for {command.argv[0]!r}; "
                "fix the argv of its Command."
            ) from error

    def connect(self) -> None:
        """Wait until it connects and names its protocol and version.

        Raises:
            GeneratorError: the program is of another version or protocol.
            Fault: it ended, or did not call ``serve`` in time.
        """
        with self._listening:
            self._wire = self._accepted()
            self._handshake()

    def draw(self, record: dict[str, Any]) -> Picture:
        """Draw a scene.

        Raises:
            Fault: it raised an error, ended, took too long, or sent something else.
        """
        wire = _Timed(self._wire, self.command.timeout)
        try:
            worker.send(wire, record)
            answer = worker.receive(wire, MAX_REPLY_BYTES)
        except TimeoutError:
            raise Fault(
                f"it had drawn nothing after {self.command.timeout:g} seconds; raise timeout= of its Command where a "
                "scene may take longer, or fix the program"
            ) from None
        except (OSError, ValueError) as error:
            raise Fault(f"{self._ended()}{type(error).__name__}: {error}; fix the program") from error
        if answer is None:
            raise Fault(f"{self._ended()}it hung up; fix the program")
        self.drawn += 1
        memory = answer[0].get("memory")
        self.memory = memory if isinstance(memory, float) else 0.0
        picture = parse_reply(record, *answer)
        if self._log.stat().st_size > MAX_LOG_BYTES:
            os.truncate(self._log, 0)
        return picture

    @property
    def pid(self) -> int:
        """Of the process, and of its group."""
        return self._process.pid

    @property
    def exceeds_memory(self) -> bool:
        """Whether it is to be replaced by a fresh one."""
        command = self.command
        too_many = command.restart_after is not None and self.drawn >= command.restart_after
        return too_many or (command.memory is not None and self.memory > command.memory)

    def kill(self) -> None:
        """End it, and all that it has started in its process group."""
        kill_group(self._process.pid)
        self._process.wait()
        if hasattr(self, "_wire"):
            self._wire.close()

    def _accepted(self) -> socket.socket:
        """The connection to the process, once it has made it."""
        self._listening.settimeout(_POLL_SECONDS)
        end = time.monotonic() + self.command.start_timeout
        while True:
            try:
                return self._listening.accept()[0]
            except TimeoutError:
                if self._process.poll() is not None:
                    raise Fault(f"{self._ended()}it had not called serve; run its argv by hand") from None
                if time.monotonic() > end:
                    raise Fault(
                        f"it had not called serve {self.command.start_timeout:g} seconds after it was started; raise "
                        "start_timeout= of its Command, or run its argv by hand to see what it waits for"
                    ) from None

    def _handshake(self) -> None:
        try:
            hello = worker.receive(_Timed(self._wire, self.command.start_timeout), 1 << 16)
        except TimeoutError:
            raise Fault(f"it had said nothing {self.command.start_timeout:g} seconds after it called") from None
        except (OSError, ValueError) as error:
            raise GeneratorError(self._protocol_error("something else")) from error
        if hello is None:
            raise Fault(f"{self._ended()}it hung up")
        greeting = hello[0]
        if greeting.get("protocol") != worker.PROTOCOL or greeting.get("token") != self._token:
            raise GeneratorError(self._protocol_error(f"protocol {greeting.get('protocol')!r}"))
        if self.command.version and greeting.get("version") != self.command.version:
            raise GeneratorError(
                f"expected version {self.command.version!r} of the generator {self.command.name}, got "
                f"{greeting.get('version')!r}; start that one, or change version= of the Command and fit again."
            )

    def _protocol_error(self, actual: str) -> str:
        return (
            f"expected the generator {self.command.name} to speak protocol {worker.PROTOCOL} of probscene, got "
            f"{actual}; let it import the file probscene_worker in the folder that PROBSCENE_WORKER names, not a copy."
        )

    def _ended(self) -> str:
        """How it ended, where it has."""
        try:
            status = self._process.wait(0.5)
        except subprocess.TimeoutExpired:
            return ""
        if status < 0:
            return f"it was ended by {signal.Signals(-status).name}; "
        return f"it ended with status {status}; "


def no_space(command: Command, error: OSError) -> MachineError:
    """What to do where temporary files cannot be written."""
    return MachineError(
        f"expected to write temporary files for the generator {command.name}, got {error.strerror}; make room, or "
        "set TMPDIR."
    )


def log_of(folder: Path, number: int) -> Path:
    """Where a worker prints."""
    return folder / f"{number}.log"


def tail(log: Path) -> str:
    """The end of what a worker has printed; empty where that is nothing."""
    try:
        printed = log.read_bytes()[-_LOG_CHARACTERS:]
    except OSError:
        return ""
    return "\n".join(printed.decode(errors="replace").splitlines()[-LOG_LINES:])


class _Timed:
    """A socket with so many seconds in all."""

    def __init__(self, wire: socket.socket, seconds: float):
        self._wire, self._end = wire, time.monotonic() + seconds

    def recv(self, number: int) -> bytes:
        return self._now().recv(number)

    def sendall(self, data: bytes) -> None:
        self._now().sendall(data)

    def _now(self) -> socket.socket:
        left = self._end - time.monotonic()
        if left <= 0:
            raise TimeoutError
        self._wire.settimeout(left)
        return self._wire
