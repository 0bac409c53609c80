"""``probscene``: the command line. Commands import what they need when they run, so that ``--help`` is quick.

Exit codes: 0; 2 where the input is at fault; 1 where the machine is, where the work was interrupted, and for a bug.
"""

import io
import os
import sys

from ..memory import keep_freed_memory
from . import fit_commands, model_commands, run_commands, trial_command
from .application import app, explained

__all__ = ["app", "explained", "fit_commands", "main", "model_commands", "run_commands", "trial_command"]


def main() -> None:
    """The console script."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # a grammar's ε on a terminal that has none
    # Torch's threads wait for one another spinning, which on a machine that has other work takes six times as long.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    keep_freed_memory()
    try:
        app(prog_name="probscene")
    except KeyboardInterrupt:  # before or after a command's work
        code, text = explained(KeyboardInterrupt(), sys.argv[1:])
        print(text, file=sys.stderr)
        sys.exit(code)
