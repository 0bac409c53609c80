"""Work on the nodes of a Ray cluster, some of which may die or freeze.

``pip install probscene[cluster]`` installs Ray. One actor a core is given one task at a time. A task that is late is
given to another actor as well, and the first answer counts: a frozen node costs that time, and not the run. A task has
to give the same result wherever and however often it is done.
"""

import os
import platform
import re
import socket
import subprocess
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from importlib import import_module
from typing import Any, Self

from probscene.errors import MachineError, ProbsceneError
from probscene.threads import cores

from .actor_pool import ActorPool, first_line

AUTO = "auto"
CONNECT_TIMEOUT = 10.0  # seconds
ANSWER_TIMEOUT = 20.0  # seconds
PROBE = "import sys; from ray._raylet import GcsClient; GcsClient(address=sys.argv[1])"


class Cluster:
    """A connection to a Ray cluster, ended on leaving ``with``.

    Args:
        address: as of ``ray.init``, such as ``"10.0.0.1:6379"`` or ``"ray://10.0.0.1:10001"``; ``"auto"`` for the one
            that runs on this machine or, where none does, one that is started now and ends with the connection.
        callback: called with a message for each node that is lost or frozen.

    Raises:
        ProbsceneError: Ray is not installed.
        MachineError: there is no such cluster, or it has other versions of Ray or Python.
    """

    def __init__(self, address: str = AUTO, callback: Callable[[str], None] = print):
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        try:
            import ray
        except ImportError as error:
            raise ProbsceneError(
                "expected the package ray, which --cluster needs, got none; install it with "
                "pip install 'probscene[cluster]'."
            ) from error
        self.ray, self.address, self.callback = ray, address, callback
        vars(import_module("ray._private.worker"))["_worker_logs_enabled"] = False  # many lines on stdout of dead nodes
        quiet: dict[str, Any] = {"log_to_driver": False, "configure_logging": False}
        try:
            reached = _running() if address == AUTO else _checked_address(address)
            if reached is None:
                ray.init(address="local", num_cpus=cores(), include_dashboard=False, **quiet)
            else:
                ray.init(address=reached, **quiet)
        except (ConnectionError, RuntimeError, ValueError, OSError) as error:
            if str(error).startswith("Version mismatch"):
                theirs = re.findall(r"(?:Ray|Python): \S+", str(error))[:2]
                raise MachineError(
                    f"expected Ray {ray.__version__} and Python {platform.python_version()} at {address}, as here, "
                    f"got {' and '.join(theirs).replace(':', '')}; install the same versions of Ray and Python on "
                    "both."
                ) from error
            raise MachineError(
                f"expected a Ray cluster at {address}, got none ({first_line(error)}). Start one with "
                "ray start --head and name its address, HOST:6379; or let one be started here: --cluster auto."
            ) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.ray.shutdown()

    def actor_pool(self, prepare: Callable[..., Callable[[Any], Any]], arguments: tuple, threads: int = 1) -> ActorPool:
        """Actors that do tasks by ``prepare(*arguments)``, started when the pool first runs.

        Args:
            prepare: a module's function, called once an actor.
            threads: of torch in each, and cores that it takes.
        """
        return ActorPool(self.ray, self.address, self.callback, prepare, arguments, threads)


def connected(address: str | None, callback: Callable[[str], None]) -> AbstractContextManager[Cluster | None]:
    """A connection to the cluster at ``address``; nothing where None."""
    return nullcontext() if address is None else Cluster(address, callback)


def _running() -> str | None:
    """The address of the cluster that this machine belongs to, where there is one and it answers."""
    try:
        return _checked_address(import_module("ray._private.services").get_ray_address_from_environment(AUTO, None))
    except (ConnectionError, ValueError, OSError):  # what Ray remembers may be long gone
        return None


def _checked_address(address: str) -> str:
    """``HOST:PORT`` or ``ray://HOST:PORT``, where Ray answers; otherwise Ray tries for many minutes, and then ends the
    process. A child process asks, since Ray cannot be stopped in this one."""
    host, _, port = address.rpartition("//")[2].rpartition(":")
    if not host or not port.isdecimal():
        raise ValueError("no HOST:PORT")
    socket.create_connection((host, int(port)), timeout=CONNECT_TIMEOUT).close()
    if not address.startswith("ray://"):  # Ray's client has a time limit of its own
        try:
            subprocess.run([sys.executable, "-c", PROBE, address], capture_output=True, timeout=ANSWER_TIMEOUT)
        except subprocess.TimeoutExpired as error:
            raise ConnectionError(
                f"something that is not Ray listens there, no answer in {ANSWER_TIMEOUT:g} s"
            ) from error
    return address
