"""The demo: everything is there, nothing is done twice, and an interruption loses nothing."""

import json
from pathlib import Path

import pytest
from PIL import Image

from probscene.app.api import demo as module
from probscene.app.api.demo import DemoSize, demo
from probscene.app.evaluation import source_features
from probscene.app.fitting import pipeline as fit
from probscene.app.fitting.pipeline import Execution
from probscene.app.fitting.presets import QUICK
from probscene.app.fitting.run import RunFolder
from probscene.errors import DataError, ModelError

SHORT = QUICK.set(
    {
        "features.schedule.steps": 16,
        "features.schedule.images": 4,
        "features.schedule.crops": 4,
        "features.width": (4, 8, 8),
        "structure.batches": 2,
        "structure.num_scenes": 20,
        "refine.batches": 2,
        "pretrain.derivations": 50,
        "pretrain.epochs": 1,
        "parameters.reader_steps": 4,
        "parameters.rounds": 1,
        "parameters.steps": 2,
        "parameters.round_reader_steps": 2,
        "parameters.recalibration_renders": 100,
        "parameters.round_steps": 2,
    }
)
ONE_THREAD = Execution(threads=1)


def contents(folder: Path) -> dict[Path, tuple[bytes, int]]:
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {path.relative_to(folder): (path.read_bytes(), path.stat().st_mtime_ns) for path in files}


def test_the_whole_path_and_again(discs, tmp_path, capsys, monkeypatch):
    out = tmp_path / "demo"
    monkeypatch.setattr(source_features, "NUM_IMAGES", 40)

    def go():
        demo(out, 0, DemoSize(str(discs.file), SHORT, 40, 5, 60), ONE_THREAD)

    def interrupt(*_, **__):
        raise KeyboardInterrupt

    for where, name in ((fit, "learn_structure"), (module, "generate"), (module, "evaluate")):
        with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
            patch.setattr(where, name, interrupt)
            go()
    go()
    assert {path.name for path in out.iterdir()} == {
        "target", "truth.csv", "run", "dataset", "evaluation.json", "grid.png"
    }  # fmt: skip
    assert {path.suffix for path in (out / "target" / "images").iterdir()} == {".png"}
    assert len(list((out / "target" / "images").iterdir())) == 40
    assert len(json.loads((out / "dataset" / "annotations.json").read_text())["images"]) == 5
    assert RunFolder.at(out / "run").record["target"] == str((out / "target" / "images").resolve())
    assert (out / "run" / "report.html").stat().st_size > 10000
    with Image.open(out / "grid.png") as grid:
        assert grid.width > 3 * 4 * 64 and grid.height > 4 * 64
    said = capsys.readouterr().out
    truth = json.loads((out / "evaluation.json").read_text())["distances"]["truth"]
    assert f"{truth['learnt']['number']:.3f}" in said and str(out / "grid.png") in said
    judged = json.loads((out / "evaluation.json").read_text())["trust"]
    assert f"Verdict: {judged['verdict']}." in said and set(judged["parts"]) == {"structure", "layout", "looks"}
    assert all(name in said for name in ("Structure, layout and looks", "layout", "looks"))
    before = contents(out)
    go()
    assert contents(out) == before
    assert capsys.readouterr().out == said[said.index("Distance to the truth") :]


def test_a_folder_of_another_seed_and_a_model_without_a_target(discs, tmp_path):
    module.generate_scenes(module.load_model(str(discs.file)).target(0), module.load_model(str(discs.file)).prior, 40,
                           tmp_path / "demo" / "target", 0, "images")  # fmt: skip
    with pytest.raises(DataError, match="seed 0.*seed 1"):
        demo(tmp_path / "demo", 1, DemoSize(str(discs.file), SHORT, 40, 5, 60), ONE_THREAD)
    plates = Path(__file__).with_name("plates.py")
    with pytest.raises(ModelError, match="has none"):
        demo(tmp_path / "other", 0, DemoSize(str(plates), SHORT, 40, 5, 60))
    assert not (tmp_path / "other").exists()
