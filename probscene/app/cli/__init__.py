"""``probscene``: the command line. Commands import what they need when they run, so that ``--help`` is quick.

Exit codes: 0; 2 where the input is at fault; 1 where the machine is, where the work was interrupted, and for a bug.
"""

import io
import os
import signal
import sys
from types import FrameType

from ..memory import tune_malloc
from . import detector_commands, fit_commands, model_commands, run_commands, trial_command
from .application import app, explained

__all__ = [
    "app", "detector_commands", "explained", "fit_commands", "main", "model_commands", "run_commands", "trial_command",
]  # fmt: skip


def main() -> None:
    """The console script."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # a grammar's ε on a terminal that has none
    # Torch's threads wait for one another spinning, which on a machine that has other work takes six times as long.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    tune_malloc()
    _end_when_asked()
    try:
        app(prog_name="probscene")
    except KeyboardInterrupt:  # before or after a command's work
        code, text = explained(KeyboardInterrupt(), sys.argv[1:])
        print(text, file=sys.stderr)
        sys.exit(code)


def _end_when_asked() -> None:
    """Take the wish of a scheduler or of ``kill`` as Ctrl-C: what was begun is saved, and what runs is ended."""
    process = os.getpid()

    def end(number: int, _: FrameType | None) -> None:
        if os.getpid() != process:  # a fork, which whoever started it ends
            signal.signal(number, signal.SIG_DFL)
            signal.raise_signal(number)
        signal.signal(number, signal.SIG_IGN)  # it may be sent more than once
        raise KeyboardInterrupt

    signal.signal(signal.SIGTERM, end)
