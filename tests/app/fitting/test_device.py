"""A fit whose networks compute on another device: nothing stands on two, and the bytes are the CPU's."""

import json
from contextlib import nullcontext
from types import SimpleNamespace

import pytest
import safetensors.torch
import torch
from second_device import SECOND, second_device

import probscene as ps
from probscene.app.fitting.config import configuration
from probscene.app.fitting.run import RunFolder
from probscene.inference.features.photographs import net
from probscene.inference.parameters import learning, reader

from ..conftest import PARAMETERS, STRUCTURE
from .test_parameters import anything_is_read

EXECUTION = ps.Execution(1, cache=False, progress=False)
SHORT = STRUCTURE | {"structure.batches": 2, "structure.num_scenes": 12, "pretrain.epochs": 1}
LEARN = PARAMETERS | {"refine.batches": 1}
GUIDE = {key: value for key, value in SHORT.items() if not key.startswith("features")}
FITS = {
    "count, parameters": ("count", "likelihood", {**SHORT, **LEARN}),
    "count=efficientnet, parameters": (
        "count=efficientnet", "likelihood",
        {**GUIDE, **LEARN, "parameters.rounds": 0, "features.pairs": 8, "features.photographs": 8,
         "features.epochs": 1},
    ),
    "presence": ("presence", "none", {**GUIDE, "features.images": 40, "features.epochs": 2}),
}  # fmt: skip


@pytest.fixture
def second(monkeypatch) -> str:
    """The word of the second device is taken."""
    for module in ("api.fit", "fitting.pipeline"):
        monkeypatch.setattr(f"probscene.app.{module}.chosen_device", torch.device)
    return str(SECOND)


@pytest.mark.parametrize("name", FITS)
def test_a_fit_there_has_the_bytes_of_one_on_the_cpu(name, second, discs, target, tmp_path, monkeypatch):
    anything_is_read(monkeypatch)
    monkeypatch.setattr(reader, "MAX_OBJECTS", 3)
    for renders in ("CALIBRATION_RENDERS", "MISSED_RENDERS"):
        monkeypatch.setattr(learning, renders, 12)
    monkeypatch.setattr(net, "HEADS", 2)
    monkeypatch.setattr(net.PretrainedCountNet.__init__, "__defaults__", ((), 30, (96, 96)))
    features, parameters, settings = FITS[name]
    config, runs = configuration(ps.preset("quick"), features, parameters=parameters, settings=settings), []
    for device in ("cpu", second):
        execution = ps.Execution(1, cache=False, progress=False, device=device)
        with second_device() if device == second else nullcontext():
            run = ps.fit(discs.file, target.images, config, out=tmp_path / device, execution=execution)
        assert run.record["devices"] == [device]
        runs.append(run)
    files = sorted(file.name for file in runs[0].path.glob("*.safetensors"))
    assert {"features.safetensors", "guide.safetensors"} <= set(files)
    for file in files:
        one, other = (safetensors.torch.load_file(run.path / file) for run in runs)
        assert one.keys() == other.keys() and all(torch.equal(one[key], other[key]) for key in one), file
    assert (runs[0].path / "log.jsonl").read_bytes() == (runs[1].path / "log.jsonl").read_bytes()


def test_a_run_goes_on_on_another_device_and_says_so(second, discs, target, tmp_path, capsys):
    config = configuration(ps.preset("quick"), "count", parameters="none", settings=STRUCTURE)
    run = ps.fit(discs.file, target.images, config, out=tmp_path / "run", execution=EXECUTION)
    (run.path / "guide.safetensors").unlink()
    execution = ps.Execution(1, cache=False, device=second)
    with second_device():
        ps.fit(out=run.path, resume=True, execution=execution)
    assert f"computed on cpu so far and continues on {second}" in " ".join(capsys.readouterr().err.split())
    assert json.loads((run.path / "run.json").read_text())["devices"] == ["cpu", second]
    assert RunFolder.at(run.path).is_finished


def test_a_resumed_run_stays_where_it_was(second):
    def run(**record):
        return SimpleNamespace(record=record)

    assert str(ps.Execution().device_for(run(devices=["cpu", second]))) == second
    assert str(ps.Execution(device="cpu").device_for(run(devices=[second]))) == "cpu"
    assert [str(ps.Execution().device_for(each)) for each in (run(), run(devices=[]))] == ["cpu", "cpu"]


def test_a_device_that_there_is_not_is_said(call, discs, target, tmp_path):
    done = call("fit", discs.file, "--target", target.images, "--out", tmp_path / "run", "--device", "tpu")
    assert done.code == 2 and "a device auto, cpu, cuda, cuda:1 or mps" in done.err and not (tmp_path / "run").exists()


def test_a_finished_run_opens_where_its_device_is_missing(discs, target, tmp_path):
    config = configuration(ps.preset("quick"), "count", parameters="none", settings=SHORT)
    run = ps.fit(discs.file, target.images, config, out=tmp_path / "run", execution=EXECUTION)
    record = json.loads((run.path / "run.json").read_text())
    (run.path / "run.json").write_text(json.dumps(record | {"devices": ["cuda:99"]}))
    assert ps.fit(out=run.path, resume=True, execution=EXECUTION).is_finished
