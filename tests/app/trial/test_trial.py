"""Trials: that a detector learns, that the same call goes on where it stopped, and what is refused."""

import json
import shutil
from pathlib import Path

import pytest
import torch

from probscene.app.datasets.generate import DatasetOptions, generate_scenes
from probscene.app.fitting.run import RunFolder
from probscene.app.loading import load_model
from probscene.app.trial.trial import TrainingBudget, TrialOptions, trial
from probscene.errors import DataError, ProbsceneError, RunError
from probscene.inference.guides.lstm import LSTMGuide

from .conftest import change, draw_set

SMALL = {"budget": TrainingBudget(iterations=2), "seeds": 2, "resamples": 20, "size": (64, 64)}


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


class Stop(Exception):
    pass


def stopping(after: int):
    """A progress that stops the work in its training of that number, once some of it is done."""

    def show(name, done, total, note="", unit=""):
        if name == "training" and done > 8 * after + 4:
            raise Stop

    return show


@pytest.fixture
def sets(drawn) -> dict:
    train = str(drawn / "train")
    return {"four": f"{train}:4", "then": f"four,{train}"}


@pytest.fixture(scope="module")
def undisturbed(drawn, tmp_path_factory) -> Path:
    train, out = str(drawn / "train"), tmp_path_factory.mktemp("trial") / "out"
    trial(drawn / "test", out, {"four": f"{train}:4", "then": f"four,{train}"}, TrialOptions(**SMALL))
    return out


def test_the_folder_holds_all(undisturbed):
    there = set(contents(undisturbed))
    names = {f"trainings/{name}-{s}.safetensors" for name in ("four", "then") for s in (0, 1)}
    assert there == names | {"trial.json", "results.json", "results.png", "table.txt"}
    record = json.loads((undisturbed / "results.json").read_text())
    assert record["baselines"] == ["four"] and record["test_images"] == 6
    assert set(record["rows"]["then"]["difference"]) == {"four"}
    table = (undisturbed / "table.txt").read_text()
    assert "Points more than 'four'" in table and "6 test images, 2 seeds" in table


def test_an_interrupted_trial_goes_on_to_the_same_bytes(undisturbed, drawn, sets, tmp_path):
    out = tmp_path / "out"
    for after in (1, 3):
        with pytest.raises(Stop):
            trial(drawn / "test", out, sets, TrialOptions(**SMALL), show=stopping(after))
        assert len(list((out / "trainings").iterdir())) == after
    trial(drawn / "test", out, sets, TrialOptions(**SMALL))
    assert contents(out) == contents(undisturbed)


def test_sets_can_be_added_and_not_changed(undisturbed, drawn, sets, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(undisturbed, out)
    found = trial(drawn / "test", out, {**sets, "mixed": f"four+{drawn / 'train'}"}, TrialOptions(**SMALL))
    assert found.rows == ("four", "then", "mixed")
    before = contents(out)
    with pytest.raises(RunError, match="'four' as .* was trained on"):
        trial(drawn / "test", out, {**sets, "four": f"{drawn / 'train'}:3"}, TrialOptions(**SMALL))
    with pytest.raises(RunError, match=r"was begun with \(recipe"):
        trial(drawn / "test", out, sets, TrialOptions(**{**SMALL, "budget": TrainingBudget(iterations=4)}))
    assert contents(out) == before
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "x").touch()
    with pytest.raises(DataError, match="new or empty folder"):
        trial(drawn / "test", tmp_path / "full", sets, TrialOptions(**SMALL))


def test_a_chain_goes_on_from_the_row_before(drawn, sets, tmp_path):
    warm_start = {**SMALL, "budget": TrainingBudget(iterations=2, warm_start=True), "seeds": 1}
    trial(drawn / "test", tmp_path / "whole", sets, TrialOptions(**warm_start))
    with pytest.raises(Stop):
        trial(drawn / "test", tmp_path / "parts", sets, TrialOptions(**warm_start), show=stopping(1))
    trial(drawn / "test", tmp_path / "parts", sets, TrialOptions(**warm_start))
    assert contents(tmp_path / "whole") == contents(tmp_path / "parts")
    assert not list((tmp_path / "whole" / "trainings").glob("*.weights"))


@pytest.fixture(scope="module")
def run(discs, tmp_path_factory) -> RunFolder:
    torch.manual_seed(0)
    made = RunFolder.create(tmp_path_factory.mktemp("run") / "run", str(discs.file), {"guide": {"hidden": 8}})
    guide = LSTMGuide(made.model.grammar, made.model.max_steps, hidden=8)
    made.write_tensors("guide", guide.state_dict())
    return made


def test_a_run_is_generated_beside_photographs_on_the_command_line(run, discs, tmp_path, call):
    model = load_model(str(discs.file))
    generate_scenes(model, model.prior, 60, tmp_path / "real", seed=9, options=DatasetOptions(box_margin=5))
    words = ["trial", "--test", tmp_path / "real", "--hold-out", 8, "--real-numbers", "4,all", "--run", run.path]
    words += [
        "--generate",
        60,
        "--set",
        "learnt then 4=learnt,real:4",
        "--out",
        tmp_path / "out",
        "--baseline",
        "prior",
    ]
    words += ["--seeds", 1, "--iterations", 2, "--resamples", 10, "--size", "64x64", "--box-margin", 2]
    done = call(*words)
    assert done.code == 0, done.err
    lines = (tmp_path / "out" / "sets" / "learnt" / "provenance.jsonl").read_text().splitlines()
    assert {json.loads(line)["box_margin"] for line in lines} == {2}
    assert "leave more room around objects" in done.err and "use --box-margin" in done.err
    assert "Points more than 'prior'" in done.out and "results.png" in done.out and "Detectors: 40 images" in done.err
    record = json.loads((tmp_path / "out" / "results.json").read_text())
    rows = record["rows"]
    assert record["order"] == ["real 4", "real all", "prior", "learnt", "learnt then 4"]
    assert [rows[name]["photographs"] for name in ("real 4", "real all", "learnt")] == [4, 52, None]
    assert rows["prior"]["precision"]["AP50"]["mean"]["worth"]["number"]
    assert {path.name for path in (tmp_path / "out" / "sets").iterdir()} == {"prior", "learnt"}


def test_test_images_in_a_set_are_named(drawn, tmp_path):
    """Under another name, in another folder, and saved as another file."""
    folder = tmp_path / "set"
    shutil.copytree(drawn / "train", folder)
    from PIL import Image

    Image.open(drawn / "test" / "images" / "002.png").save(folder / "images" / "005.png", compress_level=1)
    change(folder, lambda record: record.update(annotations=[]))
    with pytest.raises(DataError, match=r"got 1 in .*set/images/005\.png is .*test/images/002\.png\. Take them out"):
        trial(drawn / "test", tmp_path / "out", {"set": folder}, TrialOptions(**SMALL))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"baselines": ["none"]}, "baseline among"),
        ({"seeds": 0}, "positive number of seeds"),
        ({"workers": 0}, "positive number of workers"),
        ({"size": (60, 64)}, "multiples of 32, got 64x60"),
        ({"detector": "yolo"}, "efficientnet or maskrcnn=FILE"),
        ({"detector": "maskrcnn=/nowhere"}, "file of weights"),
        ({"budget": TrainingBudget(learning_rate=-1.0)}, "positive learning rate"),
        ({"budget": TrainingBudget(finetune_fraction=1.0)}, "between 0 and 1"),
        ({"numbers": [10]}, "--real-numbers, got neither"),
        ({"hold_out": 2, "real": Path("x")}, "got both"),
        ({"hold_out": 60}, "hold out 1 to 5"),
        ({"classes": ["disc", "cross"]}, "rename cross there"),
    ],
)
def test_settings_that_make_no_sense(drawn, sets, tmp_path, options, said):
    with pytest.raises(ProbsceneError, match=said):
        workers, options = options.get("workers", 1), {key: value for key, value in options.items() if key != "workers"}
        trial(drawn / "test", tmp_path / "out", sets, TrialOptions(**{**SMALL, **options}), workers=workers)
    assert not (tmp_path / "out").exists()


def test_sets_are_all_checked_before_any_is_trained(drawn, sets, tmp_path):
    other = draw_set(tmp_path / "other", 2, 3, classes=("Disc", "square"))
    more = change(draw_set(tmp_path / "more", 2, 3), lambda r: r["categories"].append({"id": 3, "name": "ring"}))
    for sets_, said in (
        ({**sets, "other": other}, r"classes disc, square in .*other, got Disc, square \('Disc' differs in case\)"),
        ({**sets, "more": more}, r"classes disc, square in .*more, got ring, too; name the classes"),
        ({**sets, "nine": f"{drawn / 'train'}:9"}, "at least 9 images .* 'nine', got 8"),
    ):
        with pytest.raises(DataError, match=said):
            trial(drawn / "test", tmp_path / "out", sets_, TrialOptions(**SMALL))
    lacking = change(draw_set(tmp_path / "test", 2, 4), lambda record: record.update(annotations=[]))
    with pytest.raises(DataError, match="objects of every class, got none of disc, square"):
        trial(lacking, tmp_path / "out", sets, TrialOptions(**SMALL))
    assert not (tmp_path / "out").exists()
