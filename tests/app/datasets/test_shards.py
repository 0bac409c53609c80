"""Shards: several calls, of several machines, make one dataset; its bytes are those of one process."""

import signal
import time

import pytest

from probscene.app.datasets.generate import DatasetOptions, generate
from probscene.app.datasets.places import LocalPlace
from probscene.errors import DataError, ProbsceneError

from .conftest import contents


@pytest.mark.parametrize("shards", [1, 2, 5])
@pytest.mark.parametrize("format", ["coco,kitti", "webdataset"])
def test_shards_make_what_one_process_makes(run, tmp_path, shards, format):
    generate(run, 130, tmp_path / "whole", seed=3, format=format)
    out, made = tmp_path / "out", []
    for number in reversed(range(shards)):
        found = generate(run, 130, out, seed=3, format=format, options=DatasetOptions(shard=f"{number}/{shards}"))
        made.append(found.made)
        assert found.num == found.made and found.finished == (shards == 1)
        assert (
            generate(run, 130, out, seed=3, format=format, options=DatasetOptions(shard=f"{number}/{shards}")).made == 0
        )
    assert sum(made) == 130
    assert (out / "provenance.jsonl").exists() == (shards == 1)
    last = generate(run, 130, out, seed=3, format=format)
    assert last.made == 0 and last.finished
    assert contents(out) == contents(tmp_path / "whole")


def test_the_whole_makes_what_shards_lack(run, undisturbed, tmp_path):
    generate(run, 130, tmp_path / "out", seed=3, options=DatasetOptions(shard="1/3"))
    told = []
    assert generate(run, 130, tmp_path / "out", seed=3, progress=lambda *now: told.append(now)).made == 66
    assert told[0] == (64, 130) and told[-1] == (130, 130)
    assert contents(tmp_path / "out") == contents(undisturbed)


def test_shards_at_once_one_of_them_killed_and_run_again(run, command, tmp_path):
    out, num, shards = tmp_path / "out", 390, 3

    def start(number):
        shard = ("--seed", "3", "--shard", f"{number}/{shards}")
        return command("generate", run.path, "--num", num, "--out", out, *shard)

    crew = [start(number) for number in range(shards)]
    killed, waiting = (1,), {1}
    while waiting:
        for number in sorted(waiting):
            if not crew[number].process.is_alive() or list(out.glob(f"images/{64 * number:06d}.png")):
                crew[number].process.kill()
                waiting.remove(number)
        time.sleep(0.01)
    for number, shard in enumerate(crew):
        shard.ended()  # on a busy machine one may do so before it is killed
        assert shard.code == 0 or (number in killed and shard.code == -signal.SIGKILL), shard.err
    again = [start(number) for number in killed]
    for shard in again:
        assert shard.ended().code == 0 and "without --shard" in shard.out + shard.err
    assert generate(run, num, out, seed=3).made == 0
    generate(run, num, tmp_path / "whole", seed=3)
    assert contents(out) == contents(tmp_path / "whole")


def test_a_dataset_may_be_finished_while_a_shard_is_at_work(run, undisturbed, tmp_path):
    out = tmp_path / "out"

    def finish(done, num):
        if done:
            generate(run, 130, out, seed=3)

    assert generate(run, 130, out, seed=3, progress=finish, options=DatasetOptions(shard="0/2")).finished
    assert contents(out) == contents(undisturbed)
    assert generate(run, 130, out, seed=3, options=DatasetOptions(shard="1/2")).made == 0


def test_files_that_another_shard_writes_are_not_foreign(run, undisturbed, tmp_path, monkeypatch):
    """The folder is empty when a shard looks, and another one has begun when it looks for settings."""
    out, names = tmp_path / "out", LocalPlace.names

    def other_after(place):
        found = names(place)
        monkeypatch.setattr(LocalPlace, "names", names)
        generate(run, 130, out, seed=3, options=DatasetOptions(shard="1/2"))
        return found

    monkeypatch.setattr(LocalPlace, "names", other_after)
    assert generate(run, 130, out, seed=3, options=DatasetOptions(shard="0/2")).made == 66
    generate(run, 130, out, seed=3)
    assert contents(out) == contents(undisturbed)


def test_shards_have_the_same_settings(run, tmp_path):
    generate(run, 130, tmp_path / "out", seed=3, options=DatasetOptions(shard="0/2"))
    with pytest.raises(DataError, match=r"begun with \(seed 3\), got seed 4; give the same"):
        generate(run, 130, tmp_path / "out", seed=4, options=DatasetOptions(shard="1/2"))


def test_a_shard_that_no_chunk_is_left_for(run, undisturbed, tmp_path):
    told = []
    found = generate(
        run, 130, tmp_path / "out", seed=3, options=DatasetOptions(shard="7/8"), progress=lambda *now: told.append(now)
    )
    assert found.made == found.num == 0 and told == [(0, 0)]
    assert generate(run, 130, tmp_path / "out", seed=3).made == 130
    assert contents(tmp_path / "out") == contents(undisturbed)


@pytest.mark.parametrize("text", ["8/8", "-1/8", "1", "", "a/b", "1/0", "1/2/3", "1 / 2"])
def test_what_is_no_shard_is_refused(run, tmp_path, text):
    with pytest.raises(
        ProbsceneError, match="expected a shard I/N with I from 0 to N - 1, such as 0/8 to 7/8"
    ) as error:
        generate(run, 130, tmp_path / "out", options=DatasetOptions(shard=text))
    assert error.value.exit_code == 2 and not (tmp_path / "out").exists()
