"""Work that is interrupted, and folders that are damaged: nothing is lost, and the bytes are the same."""

import errno
import multiprocessing
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

import probscene
from probscene.app.datasets import coco
from probscene.app.datasets.generate import generate
from probscene.app.files import write_json
from probscene.app.fitting.run import RunFolder
from probscene.errors import DataError, MachineError, SamplingError

from .conftest import a_run, contents


class Cut(KeyboardInterrupt):
    """An interrupt at a chosen moment."""


@pytest.mark.parametrize("after", [False, True])
def test_interrupted_at_every_step_it_goes_on(run, tmp_path, monkeypatch, after):
    generate(run, 3, tmp_path / "whole", seed=3)
    whole = contents(tmp_path / "whole")
    rename = os.replace
    for step in range(20):
        left = step
        out = tmp_path / f"cut{step}"

        def replace_once(source, target):
            nonlocal left
            left -= 1
            if left == -1 and not after:
                raise Cut
            rename(source, target)
            if left == -1:
                raise Cut

        monkeypatch.setattr(os, "replace", replace_once)
        try:
            generate(run, 3, out, seed=3)
        except Cut:
            shown = {name: data for name, data in contents(out).items() if not name.startswith(".")}
            assert shown.items() <= whole.items()  # whole or absent
            monkeypatch.setattr(os, "replace", rename)
            generate(run, 3, out, seed=3)
            assert contents(out) == whole
        else:
            assert step == 9 and contents(out) == whole  # settings, 3 images, a record, 2 labels written and 2 moved
            return
    pytest.fail("the work never ended")


def half(write):
    """A write that fills the disk half-way."""

    def fill(path, data, *args, **kwargs):
        write(path, data[: len(data) // 2], *args, **kwargs)
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    return fill


def half_labels(path, *args):
    path.write_text('{"info": ')
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize(
    "where, name, call, full",
    [
        (Path, "write_bytes", 70, half(Path.write_bytes)),  # an image of the second chunk
        (Path, "write_bytes", 1, half(Path.write_bytes)),  # the settings
        (Path, "write_bytes", 131, half(Path.write_bytes)),  # the second chunk's record
        (coco, "write", 1, half_labels),
    ],
)
def test_a_full_disk_leaves_nothing_half_written(run, undisturbed, tmp_path, monkeypatch, where, name, call, full):
    out, writes = tmp_path / "out", getattr(where, name)
    calls = 0

    def fills(*args, **kwargs):
        nonlocal calls
        calls += 1
        return (full if calls == call else writes)(*args, **kwargs)

    monkeypatch.setattr(where, name, fills)
    with pytest.raises(MachineError, match="The disk is full") as error:
        generate(run, 130, out, seed=3)
    assert error.value.exit_code == 1
    monkeypatch.setattr(where, name, writes)
    shown = {name: data for name, data in contents(out).items() if not name.startswith(".")}
    assert shown.items() <= contents(undisturbed).items() and not (out / "annotations.json").exists()
    generate(run, 130, out, seed=3)
    assert contents(out) == contents(undisturbed)


PROGRAM = """
import multiprocessing, signal, sys, time
from pathlib import Path
from probscene.app.datasets.generate import generate
from probscene.app.fitting.run import RunFolder

def progress(done, num):
    if 0 < done < num:
        print(*(process.pid for process in multiprocessing.active_children()), flush=True)
        time.sleep(300)

if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job ignores it, and so its children
    generate(RunFolder.at(Path(sys.argv[1])), 130, Path(sys.argv[2]), seed=3, workers=2, progress=progress)
"""


def gone(pid: int) -> bool:
    """Whether a process has ended; one that nobody has waited for counts."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except (FileNotFoundError, ProcessLookupError):
        return True


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
def test_killed_in_mid_run_it_goes_on_to_the_same_bytes(run, undisturbed, tmp_path, how):
    script, out = tmp_path / "script.py", tmp_path / "out"
    script.write_text(PROGRAM)
    environment = {**os.environ, "PYTHONPATH": str(Path(probscene.__file__).parents[1])}
    with subprocess.Popen(
        [sys.executable, script, run.path, out],
        env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
    ) as process:  # fmt: skip
        workers = [int(pid) for pid in process.stdout.readline().split()]
        if how == signal.SIGINT:
            os.killpg(process.pid, how)  # as a terminal does: to every process of the group
        else:
            process.send_signal(how)
        _, said = process.communicate(timeout=300)
    assert process.returncode == -how and "in a worker" not in said
    assert said.count("Traceback") == (how == signal.SIGINT)  # of the parent's KeyboardInterrupt alone
    assert workers and not (out / "provenance.jsonl").exists()
    for pid in workers:
        for _ in range(600):
            if gone(pid):
                break
            signal.sigtimedwait([], 0.1)
        assert gone(pid)
    told = []
    made = generate(run, 130, out, seed=3, progress=lambda *now: told.append(now)).made
    assert 0 < told[0][0] == 130 - made
    assert contents(out) == contents(undisturbed)


def test_a_killed_worker_is_one_clear_message(run, undisturbed, tmp_path, ready_workers):
    def kill(done, num):
        for process in multiprocessing.active_children() if done else ():
            process.kill()

    with pytest.raises(MachineError, match="A worker process was killed.*same command again"):
        generate(run, 300, tmp_path / "out", seed=3, workers=2, progress=kill)
    assert not multiprocessing.active_children()
    made = generate(run, 300, tmp_path / "out", seed=3).made
    assert 0 < made < 300
    assert contents(undisturbed)["images/000129.png"] == contents(tmp_path / "out")["images/000129.png"]


def test_a_workers_error_is_the_same_as_without_workers(tmp_path, ready_workers):
    endless = a_run(tmp_path / "run", 50.0)
    write_json(endless.path / "run.json", endless.record | {"within_support": False})
    endless = RunFolder.at(endless.path)
    messages = []
    for workers in (1, 2):
        with pytest.raises(SamplingError, match="max_steps = 40") as error:
            generate(endless, 2, tmp_path / f"out{workers}", workers=workers)
        messages.append(str(error.value))
    assert messages[0] == messages[1]


def test_a_finished_dataset_is_left_alone(run, undisturbed):
    before = {path: path.stat().st_mtime_ns for path in undisturbed.rglob("*")}
    assert generate(run, 130, undisturbed, seed=3).made == 0
    assert {path: path.stat().st_mtime_ns for path in undisturbed.rglob("*")} == before
    for settings in ({"seed": 4}, {"num": 131}, {"num": 64}, {"format": "images"}):
        with pytest.raises(DataError, match="settings that the dataset .* was begun with"):
            generate(run, **{"num": 130, "seed": 3, **settings}, out=undisturbed)
    (undisturbed / ".parts").mkdir()  # interrupted while it tidied up
    assert generate(run, 130, undisturbed, seed=3).made == 0
    assert not (undisturbed / ".parts").exists()


def test_an_unfinished_dataset_is_of_its_own_settings(run, tmp_path, monkeypatch):
    def cut(path, *args):
        raise Cut

    monkeypatch.setattr(coco, "write", cut)
    with pytest.raises(Cut):
        generate(run, 3, tmp_path / "out", seed=3)
    with pytest.raises(DataError, match=r"begun with \(seed 3, num 3\), got seed 4, num 5; give the same"):
        generate(run, 5, tmp_path / "out", seed=4)
    other = a_run(tmp_path / "other", 0.2)
    with pytest.raises(DataError, match=r"begun with \(guide "):
        generate(other, 3, tmp_path / "out", seed=3)


def test_damaged_parts_are_made_again(run, tmp_path, monkeypatch):
    write = coco.write

    def cut(path, *args):
        raise Cut

    generate(run, 130, tmp_path / "whole", seed=3)
    monkeypatch.setattr(coco, "write", cut)
    out = tmp_path / "out"
    with pytest.raises(Cut):
        generate(run, 130, out, seed=3)
    image = out / "images" / "000001.png"
    image.write_bytes(bytes(len(image.read_bytes())))  # as a crash of the machine may leave it
    (out / ".parts" / "000001.json").write_text("{")
    monkeypatch.setattr(coco, "write", write)
    assert generate(run, 130, out, seed=3).made == 128
    assert contents(out) == contents(tmp_path / "whole")
