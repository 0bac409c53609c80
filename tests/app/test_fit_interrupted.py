"""Fits that are interrupted or killed, and go on."""

import shlex
import signal
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]

CHILD = """
import os, signal, sys
from probscene.app import cli, files
from probscene.app.fitting import store as checkpoints

signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job ignores it, and so its children
kind, stage, number = getattr(signal, sys.argv[1]), sys.argv[2], int(sys.argv[3])
checkpoints.SAVE_EVERY = 0.0
line, replace = [{}], os.replace

def at_once():
    if line[0].get("stage") == stage and line[0].get("step", line[0].get("batch")) >= number:
        os.kill(os.getpid(), kind)

keep = checkpoints.Checkpointer.__call__
def keeping(self, said):
    line[0] = said
    keep(self, said)
    if kind != signal.SIGKILL:
        at_once()

def replacing(source, path):  # the worst moment: the log is ahead, the checkpoint written and not yet in its place
    if str(path).endswith("checkpoint.safetensors"):
        at_once()
    replace(source, path)

checkpoints.Checkpointer.__call__, os.replace = keeping, replacing
del sys.argv[1:4]
cli.main()
"""


def child(kind: str, stage: str, number: int, words) -> subprocess.CompletedProcess:
    """The command line in a process of its own that gets a signal in the middle of a stage."""
    command = [sys.executable, "-c", CHILD, kind, stage, str(number), *map(str, words)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True)


def test_killed_twice_it_goes_on_to_the_same_guide(call, discs, target, fitted, tmp_path):
    out = tmp_path / "run"
    first = child("SIGKILL", "features", 32, ["fit", discs.file, "--target", target.images, "--out", out,
                                              *discs.settings])  # fmt: skip
    assert first.returncode == -signal.SIGKILL, first.stderr
    assert (out / "features-checkpoint.safetensors").exists() and not (out / "features.safetensors").exists()
    second = child("SIGKILL", "structure", 3, ["fit", "--resume", "--out", out])
    assert second.returncode == -signal.SIGKILL, second.stderr
    assert (out / "guide-checkpoint.safetensors").exists() and not (out / "guide.safetensors").exists()
    assert call("fit", "--resume", "--out", out).code == 0
    for name in ("features.safetensors", "guide.safetensors", "log.jsonl"):
        assert (out / name).read_bytes() == (fitted / name).read_bytes(), name


@pytest.mark.parametrize("kind", ["SIGINT", "SIGTERM"])
def test_interrupted_it_says_how_to_go_on_and_does(call, discs, target, fitted, tmp_path, kind):
    out = tmp_path / "a run"
    words = ["fit", discs.file, "--target", target.images, "--out", out, *discs.settings]
    interrupted = child(kind, "structure", 2, words)
    assert interrupted.returncode == 1 and "Traceback" not in interrupted.stderr
    last = interrupted.stderr.splitlines()[-1]
    assert last == f"Interrupted; go on with: {shlex.join(['probscene', *map(str, words), '--resume'])}"
    assert call(*shlex.split(last.partition("probscene ")[2])).code == 0
    assert (out / "guide.safetensors").read_bytes() == (fitted / "guide.safetensors").read_bytes()


def test_interrupted_before_the_run_exists_the_same_command_is_named(call, discs, target, tmp_path, monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("probscene.app.targets.ImageFolder", interrupt)
    words = ["fit", discs.file, "--target", target.images, "--out", tmp_path / "run"]
    result = call(*words)
    assert result.code == 1 and not (tmp_path / "run").exists()
    assert result.err == f"Interrupted; go on with: {shlex.join(['probscene', *map(str, words)])}\n"
