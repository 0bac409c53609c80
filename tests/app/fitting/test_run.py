"""The run folder keeps what it has, whatever happens while it is written."""

import resource
import shutil
from pathlib import Path

import pytest
import torch

from probscene.app.fitting.presets import QUICK
from probscene.app.fitting.run import RunFolder
from probscene.app.fitting.store import check_free
from probscene.errors import DataError, MachineError, RunError
from probscene.inference.guides.lstm import GUIDES, make_guide

DISCS = Path(__file__).parents[1] / "discs.py"


def test_tensors_that_do_not_fit_on_the_disk_leave_the_old_ones(tmp_path):
    run = RunFolder(tmp_path, {})
    run.write_tensors("x", {"a": torch.zeros(10)})
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10000, limits[1]))
    try:
        with pytest.raises(MachineError, match="x.safetensors"):
            run.write_tensors("x", {"a": torch.zeros(10000)})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert len(run.read_tensors("x")["a"]) == 10 and len(list(tmp_path.iterdir())) == 1


def test_a_free_folder_is_new_or_empty_but_for_hidden_files(tmp_path):
    check_free(tmp_path / "new")
    check_free(tmp_path)
    (tmp_path / ".run.json.x1").touch()  # what a kill while writing leaves
    check_free(tmp_path)
    (tmp_path / "model.py").touch()  # may be the user's own
    with pytest.raises(RunError, match="other files"):
        check_free(tmp_path)
    with pytest.raises(DataError, match="is a file"):
        check_free(tmp_path / "model.py")


def test_a_run_whose_making_was_interrupted_can_be_resumed(tmp_path, monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(shutil, "copyfile", interrupt)
        with pytest.raises(KeyboardInterrupt):
            RunFolder.create(tmp_path / "run", str(DISCS), {"seed": 3})
    run = RunFolder.at(tmp_path / "run")
    assert run.record["seed"] == 3 and run.model.name == "discs"
    assert [file.name for file in run.path.iterdir()] == ["run.json"]


def test_a_run_is_bound_to_the_digits_it_was_begun_with(tmp_path, monkeypatch, idx_folder):
    monkeypatch.delenv("PROBSCENE_MNIST", raising=False)
    run = RunFolder.create(tmp_path / "run", "multi_mnist", {})
    assert RunFolder.at(run.path).model.name == "multi_mnist"
    monkeypatch.setenv("PROBSCENE_MNIST", str(idx_folder))
    with pytest.raises(RunError, match="PROBSCENE_MNIST"):
        _ = RunFolder.at(run.path).model


@pytest.mark.parametrize("kind", [*GUIDES, None])
def test_the_guide_is_rebuilt_from_the_record(tmp_path, kind):
    """A record that names no kind is of a version that had LSTMs alone."""
    settings = QUICK.with_guide(kind or "lstm").guide_record()
    if kind is None:
        del settings["kind"]
    run = RunFolder.create(tmp_path / "run", str(DISCS), {"guide": settings})
    made = make_guide(**{"kind": "lstm", **settings}, grammar=run.model.grammar, max_steps=run.model.max_steps)
    run.write_tensors("guide", made.state_dict())
    again = RunFolder.at(run.path).guide
    assert type(again) is type(made)
    assert all(torch.equal(a, b) for a, b in zip(again.state_dict().values(), made.state_dict().values(), strict=True))
    other = RunFolder(run.path, run.record | {"guide": {"kind": "pcfg" if kind != "pcfg" else "lstm"}})
    with pytest.raises(RunError, match="expected a guide for model discs"):
        _ = other.guide
