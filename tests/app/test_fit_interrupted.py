"""Fits that are interrupted or killed, and go on."""

import os
import shlex
import signal

import pytest

from probscene.app.fitting import store as checkpoints


def send_in_the_middle(kind: signal.Signals, stage: str, number: int) -> None:
    """To this process, in the middle of a stage of its fit."""
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


@pytest.fixture
def child(command):
    """``child(kind, stage, number, words)``: the command line in a process that gets a signal amid a stage."""

    def run(kind, stage, number, words):
        return command(*words, first=(send_in_the_middle, getattr(signal, kind), stage, number)).ended()

    return run


def test_killed_twice_it_goes_on_to_the_same_guide(call, child, discs, target, fitted, tmp_path):
    out = tmp_path / "run"
    first = child("SIGKILL", "features", 32, ["fit", discs.file, "--target", target.images, "--out", out,
                                              *discs.settings])  # fmt: skip
    assert first.code == -signal.SIGKILL, first.err
    assert (out / "features-checkpoint.safetensors").exists() and not (out / "features.safetensors").exists()
    second = child("SIGKILL", "structure", 3, ["fit", "--resume", "--out", out])
    assert second.code == -signal.SIGKILL, second.err
    assert (out / "guide-checkpoint.safetensors").exists() and not (out / "guide.safetensors").exists()
    assert call("fit", "--resume", "--out", out).code == 0
    for name in ("features.safetensors", "guide.safetensors", "log.jsonl"):
        assert (out / name).read_bytes() == (fitted / name).read_bytes(), name


@pytest.mark.parametrize("kind", ["SIGINT", "SIGTERM"])
def test_interrupted_it_says_how_to_go_on_and_does(call, child, discs, target, fitted, tmp_path, kind):
    out = tmp_path / "a run"
    words = ["fit", discs.file, "--target", target.images, "--out", out, *discs.settings]
    interrupted = child(kind, "structure", 2, words)
    assert interrupted.code == 1 and "Traceback" not in interrupted.err
    last = interrupted.err.splitlines()[-1]
    assert last == f"Interrupted; continue with: {shlex.join(['probscene', *map(str, words), '--resume'])}"
    assert call(*shlex.split(last.partition("probscene ")[2])).code == 0
    assert (out / "guide.safetensors").read_bytes() == (fitted / "guide.safetensors").read_bytes()


def test_interrupted_before_the_run_exists_the_same_command_is_named(call, discs, target, tmp_path, monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("probscene.app.targets.ImageFolder", interrupt)
    words = ["fit", discs.file, "--target", target.images, "--out", tmp_path / "run"]
    result = call(*words)
    assert result.code == 1 and not (tmp_path / "run").exists()
    assert result.err == f"Interrupted; continue with: {shlex.join(['probscene', *map(str, words)])}\n"
