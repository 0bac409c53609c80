"""Detectors that are kept: that a training goes on to the same bytes, what it is shown, and what is refused."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import probscene as ps
from probscene.app.detectors.folder import RECORD, WEIGHTS, TrainedDetector
from probscene.app.detectors.train import CHECKPOINT, train
from probscene.app.fitting.run import RunFolder
from probscene.app.trial.begun_photographs import model_file
from probscene.app.trial.sets import read_set
from probscene.app.trial.trial import GeneratedSets, TrainingBudget, TrialOptions, trial
from probscene.decoding import read_rgb
from probscene.errors import DataError, ProbsceneError, RunError
from probscene.inference.guides.lstm import LSTMGuide

from .conftest import change, small_options


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


class Stop(Exception):
    pass


class Heard:
    """A progress that keeps how many images are said to be shown, and stops the work from one number on."""

    def __init__(self, last: int = 10**9):
        self.last, self.shown, self.names = last, [], set()

    def __call__(self, name, done, total, note="", unit=""):
        self.names.add(name)
        if name == "detector":
            self.shown.append(done)
            if done >= self.last:
                raise Stop


def test_the_folder_holds_the_detector_and_what_it_is(trained, photographs):
    assert set(contents(trained.path)) == {RECORD, WEIGHTS}
    record = json.loads((trained.path / RECORD).read_text())
    assert record["classes"] == ["blue", "red"] and record["recipe"]["iterations"] == 4
    assert [each["name"] for each in record["photographs"]] == [f"{i:03d}.png" for i in range(8)]
    held_out = read_set(photographs / "test")
    assert [each["digest"] for each in record["held_out"]] == [e.digest for e in held_out.examples]
    assert record["scores"]["images"] == 6
    assert sum(record["scores"]["objects"].values()) == sum(len(e.boxes) for e in held_out.examples)


@pytest.mark.parametrize("last", [(2, 6), (4,)], ids=["in each stage", "between stages"])
def test_an_interrupted_training_goes_on_to_the_same_bytes(trained, discs, photographs, tmp_path, monkeypatch, last):
    monkeypatch.setattr("probscene.app.detectors.train.CHECKPOINT_SECONDS", 0.0)
    out, options, before = tmp_path / "out", small_options(test=photographs / "test"), 0
    for number in (*last, None):
        heard = Heard() if number is None else Heard(number)
        if number is None:
            train(discs.file, photographs / "train", None, out, options, show=heard)
        else:
            with pytest.raises(Stop):
                train(discs.file, photographs / "train", None, out, options, show=heard)
            assert (out / CHECKPOINT).is_file() and not (out / RECORD).exists()
            with pytest.raises(DataError, match="not finished; give its command again"):
                TrainedDetector.at(out)
        assert heard.shown[0] == (before or 2)
        before = number
    assert contents(out) == contents(trained.path)


def test_a_second_call_does_nothing_and_other_settings_are_an_error(trained, discs, photographs, tmp_path):
    out, heard = tmp_path / "out", Heard()
    shutil.copytree(trained.path, out)
    times = {file: file.stat().st_mtime_ns for file in out.iterdir()}
    test = {"test": photographs / "test"}
    again = train(discs.file, photographs / "train", None, out, small_options(**test), show=heard)
    assert again.record == trained.record and heard.names == {"labels"}
    for more in ({"seed": 1}, {"size": (96, 64)}, {"generate": 5}, {"budget": TrainingBudget(iterations=5)}):
        with pytest.raises(RunError, match=r"settings that the detector in .* was begun with \("):
            train(discs.file, photographs / "train", None, out, small_options(**test, **more))
    with pytest.raises(RunError, match="photographs_sha256"):
        train(discs.file, None, None, out, small_options(**test))
    assert {file: file.stat().st_mtime_ns for file in out.iterdir()} == times


def test_a_detector_is_that_of_a_trial(discs, photographs, tmp_path):
    """Generated images of a run, then photographs, some held out: the trial's row, and its detections."""
    torch.manual_seed(0)
    run = RunFolder.create(tmp_path / "run", str(discs.file), {"guide": {"hidden": 8}})
    run.write_tensors("guide", LSTMGuide(run.model.grammar, run.model.max_steps, hidden=8).state_dict())
    options = small_options(hold_out=3, seed=5)
    kept = train(run, photographs / "train", None, tmp_path / "kept", options)
    shared = {"hold_out": 3, "seed": 5, "size": (64, 64), "budget": options.budget, "resamples": 10, "seeds": 1}
    made = GeneratedSets(run, ("learnt",), 4)
    trial(
        photographs / "train", tmp_path / "trial", {"then": "learnt,real"},
        TrialOptions(**shared, generated=made, numbers=[]),
    )  # fmt: skip
    results = json.loads((tmp_path / "trial" / "results.json").read_text())
    figures = results["rows"]["then"]["precision"]["AP50"]
    for name, figure in kept.record["scores"]["precision"]["AP50"].items():
        assert figure["value"] == figures[name]["value"]
    from safetensors.numpy import load_file

    found = load_file(tmp_path / "trial" / "trainings" / "then-0.safetensors")
    held_out = {each["name"] for each in kept.record["held_out"]}
    files = [photographs / "train" / "images" / name for name in sorted(held_out)]
    assert len(files) == 3 and {each["name"] for each in kept.record["photographs"]}.isdisjoint(held_out)
    boxes = np.concatenate([kept(read_rgb(file)).boxes for file in files])
    np.testing.assert_array_equal(boxes, found["boxes"])


def test_labels_may_be_of_some_photographs_in_a_folder(discs, photographs, tmp_path):
    labels = tmp_path / "three.json"
    record = json.loads((photographs / "train" / "annotations.json").read_text())
    record["images"] = record["images"][2:5]
    record["annotations"] = [each for each in record["annotations"] if each["image_id"] in (2, 3, 4)]
    labels.write_text(json.dumps(record))
    kept = train(discs.file, photographs / "train" / "images", labels, tmp_path / "out", small_options())
    assert [each["name"] for each in kept.record["photographs"]] == ["002.png", "003.png", "004.png"]
    assert kept.scores is None and kept.min_score is None
    with pytest.raises(DataError, match="got .*three.json with none of them, but of 002.png"):
        shutil.copytree(photographs / "test" / "images", tmp_path / "others")
        for file in (tmp_path / "others").iterdir():
            file.rename(file.with_name(f"x{file.name}"))
        train(discs.file, tmp_path / "others", labels, tmp_path / "new", small_options())


def test_the_command_line_and_the_call_give_the_same_bytes(discs, tmp_path, call):
    """Of generated images alone."""
    words = ["--generate", 4, "--iterations", 2, "--batch", 2, "--size", "64x64", "--seed", 3, "--classes", "red"]
    done = call("train", discs.file, "--out", tmp_path / "one", *words)
    assert done.code == 0, done.err
    assert "Training: 4 images" in done.err and "probscene predict" in done.out
    options = small_options(budget=TrainingBudget(iterations=2, batch_size=2), seed=3, classes=["red"])
    ps.train(ps.load_model(str(discs.file)), None, None, tmp_path / "two", options, progress=False)
    one, two = (contents(tmp_path / name) for name in ("one", "two"))
    assert one[WEIGHTS] == two[WEIGHTS]
    ps.train(str(discs.file), None, None, tmp_path / "three", options, progress=False)
    assert one == contents(tmp_path / "three")


def test_test_photographs_are_never_trained_on(discs, photographs, tmp_path):
    """Under another name, and saved as another file."""
    shutil.copytree(photographs / "train", tmp_path / "set")
    found = Image.open(photographs / "test" / "images" / "002.png")
    found.save(tmp_path / "set" / "images" / "005.png", compress_level=1)
    change(tmp_path / "set", lambda record: record.update(annotations=[]))
    with pytest.raises(DataError, match=r"got 1 in 'photographs': .*set/images/005\.png is .*test/images/002\.png"):
        train(discs.file, tmp_path / "set", None, tmp_path / "out", small_options(test=photographs / "test"))
    assert not (tmp_path / "out").exists()


def test_photographs_that_a_model_was_begun_from_do_not_test_it(discs, photographs, tmp_path):
    shutil.copy(discs.file, tmp_path / "model.py")
    cut = read_set(photographs / "test").examples[3]
    begun = {"photographs": [{"name": "mine.png", "digest": cut.digest}]}
    (tmp_path / "begun.json").write_text(json.dumps(begun))
    options = small_options(test=photographs / "test")
    with pytest.raises(DataError, match=r"got 1 that its pictures were cut out of: .*003\.png is mine\.png; test on"):
        train(tmp_path / "model.py", photographs / "train", None, tmp_path / "out", options)
    (tmp_path / "begun.json").write_text("{")
    with pytest.raises(DataError, match=r"begun\.json, got a damaged file"):
        train(tmp_path / "model.py", photographs / "train", None, tmp_path / "out", options)
    assert not (tmp_path / "out").exists()


def test_nor_does_a_trial_test_on_them(fitted, photographs, tmp_path):
    run = RunFolder.at(fitted)
    beside = model_file(run).with_name("begun.json")
    cut = read_set(photographs / "test").examples[3]
    beside.write_text(json.dumps({"photographs": [{"name": "mine.png", "digest": cut.digest}]}))
    try:
        with pytest.raises(DataError, match=r"got 1 that its pictures were cut out of: .*003\.png is mine\.png"):
            trial(photographs / "test", tmp_path / "out", {}, TrialOptions(generated=GeneratedSets(run, ("prior",))))
    finally:
        beside.unlink()
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ({"generate": 0}, "positive number of images to generate"),
        ({"size": (60, 64)}, "multiples of 32, got 64x60"),
        ({"hold_out": 2, "test": "x"}, "got both"),
        ({"hold_out": 8}, "hold out 1 to 7"),
        ({"classes": ["red", "cross"]}, r"classes of model 'discs' \(red, blue\), got cross"),
        ({"budget": TrainingBudget(warm_start=True)}, "without warm_start"),
        ({"detector": "yolo"}, "efficientnet or maskrcnn=FILE"),
        ({"box_margin": "disc=2"}, r"box_margin of classes of model 'discs' \(red, blue\), got disc"),
        ({"box_margin": "two"}, "whole number of pixels, 0 or more, got two"),
        ({"source": "best"}, "a source of a run among prior, .*, got 'best'"),
        ({"source": "prior"}, "a run for the source 'prior', got model 'discs'"),
        ({"detector": "maskrcnn=x", "onnx": True}, "file of weights|efficientnet for --onnx"),
    ],
)
def test_settings_that_make_no_sense(discs, photographs, tmp_path, more, said):
    with pytest.raises(ProbsceneError, match=said):
        train(discs.file, photographs / "train", None, tmp_path / "out", small_options(**more))
    assert not (tmp_path / "out").exists()


def test_what_cannot_be_trained_is_one_line(discs, photographs, tmp_path, call):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "x").touch()
    small = ["--generate", 4, "--iterations", 2, "--size", "64x64"]
    for words, said in (
        ([discs.file, "--out", tmp_path / "full"], "new or empty folder for the detector"),
        ([tmp_path / "full", "--out", tmp_path / "out"], "expected a run"),
        ([discs.file, "--hold-out", 2, "--out", tmp_path / "out"], "--real or --labels, for --hold-out"),
        ([discs.file, "--real", tmp_path / "none", "--out", tmp_path / "out"], "got none"),
    ):
        done = call("train", *words, *small)
        (line,) = [line for line in done.err.splitlines() if line.startswith("probscene: ")]
        assert done.code == 2 and said in line, done.err
