"""Worker processes of a script: what it lacks for them to start is said, and not that the machine lacks memory."""

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from probscene.app.workers.processes import spread
from probscene.errors import MachineError

SPREAD = """
from operator import neg
from probscene.app.workers.processes import spread

def prepare():
    return neg

def main():
    spread(prepare, (), 1, [1, 2], print)
"""
GUARDED = SPREAD + '\nif __name__ == "__main__":\n    main()\n'
ONCE = "import os\nos.mkdir('made')\n" + SPREAD + "\nmain()\n"


NO_GUARD = "expected a script with a main guard, .*, got one without; put the calls .* under 'if __name__ == "


def run(folder: Path, text: str, *words: object, stdin: bool = False) -> subprocess.CompletedProcess:
    (folder / "script.py").write_text(text)
    command = [sys.executable, "-" if stdin else "script.py", *map(str, words)]
    given = text if stdin else None
    return subprocess.run(command, cwd=folder, input=given, capture_output=True, text=True, timeout=120)


def check_ends_with(done: subprocess.CompletedProcess, error: str, words: str) -> None:
    """In one traceback, which is the script's own."""
    assert done.returncode == 1 and done.stderr.count("Traceback") == 1 + ("above exception" in done.stderr)
    assert re.match(f"probscene.errors.{error}: {words}", done.stderr.splitlines()[-1]), done.stderr


def test_with_a_guard_they_work(tmp_path):
    done = run(tmp_path, GUARDED)
    assert done.returncode == 0 and sorted(done.stdout.split()) == ["-1", "-2"], done.stderr


def test_a_missing_guard_is_named(tmp_path):
    check_ends_with(run(tmp_path, SPREAD + "\nmain()\n"), "ProbsceneError", NO_GUARD)


def test_a_script_from_stdin_is_named(tmp_path):
    done = run(tmp_path, GUARDED, stdin=True)
    check_ends_with(done, "ProbsceneError", "expected a script in a file, .*, got one from <stdin>; save it in a file")


def test_a_script_that_breaks_in_a_worker_is_named(tmp_path):
    done = run(tmp_path, ONCE)
    assert "FileExistsError" in done.stderr
    assert re.search("expected a worker process to start, got .* code 1 while .* under 'if __name__", done.stderr)


def test_no_file_is_needed_where_there_is_no_script(tmp_path):
    """As in a notebook."""
    line = (
        "from operator import neg; from functools import partial; from probscene.app.workers.processes import spread; "
    )
    done = subprocess.run([sys.executable, "-c", line + "spread(partial(partial, neg), (), 1, [1, 2], print)"],
                          capture_output=True, text=True, timeout=120)  # fmt: skip
    assert done.returncode == 0 and sorted(done.stdout.split()) == ["-1", "-2"], done.stderr


def ends(how):
    def work(task):
        os.kill(os.getpid(), signal.SIGKILL) if how == "killed" else os._exit(int(how))

    return work


@pytest.mark.parametrize(
    "how, said", [("killed", "was killed, most often for lack of memory"), ("3", "ended with code 3")]
)
def test_a_worker_that_ends_at_work_is_no_fault_of_the_script(how, said):
    with pytest.raises(MachineError, match=f"A worker process {said}"):
        spread(ends, (how,), 1, [1, 2], print)
