"""``fit --readings``: detections count in the place of a network, in every command."""

import json
from pathlib import Path
from types import SimpleNamespace

import pytest

import probscene as ps
from probscene.app.datasets.generate import generate_scenes
from probscene.app.fitting import parameter_stage
from probscene.app.fitting.given_boxes import given_boxes
from probscene.app.fitting.pipeline import open_target
from probscene.app.fitting.run import RunFolder
from probscene.app.labels.detections import read_detections
from probscene.app.loading import load_model
from probscene.app.progress import silent
from probscene.errors import DataError

QUICK = ("--learn", "structure", "--set", "structure.batches=6", "--set", "structure.num_scenes=40")
QUICK += ("--set", "pretrain.derivations=100", "--set", "pretrain.epochs=2", "--threads", "1", "--no-verdict")


@pytest.fixture(scope="module")
def found(tmp_path_factory, discs) -> SimpleNamespace:
    """80 images of the target, all their objects detected, and ten of them labelled."""
    folder = tmp_path_factory.mktemp("found")
    model = load_model(str(discs.file)).target(0)
    generate_scenes(model, model.prior, 80, folder / "drawn", seed=3)
    whole = json.loads((folder / "drawn" / "annotations.json").read_text())
    scored = [{**one, "score": 0.9} for one in whole["annotations"]]
    some = {image["id"] for image in whole["images"][:10]}
    few = {**whole, "images": [image for image in whole["images"] if image["id"] in some]}
    few["annotations"] = [one for one in whole["annotations"] if one["image_id"] in some]
    files = SimpleNamespace(images=folder / "drawn" / "images", all=whole, folder=folder)
    for name, content in (("found", {**whole, "annotations": scored}), ("few", few), ("labels", whole)):
        (folder / f"{name}.json").write_text(json.dumps(content))
        setattr(files, name, folder / f"{name}.json")
    return files


@pytest.fixture(scope="module")
def fitted(tmp_path_factory, call, discs, found) -> Path:
    out = tmp_path_factory.mktemp("readings") / "run"
    words = ("--readings", found.found, "--labels", found.few)
    done = call("fit", discs.file, "--target", found.images, "--out", out, *words, *QUICK)
    assert done.code == 0, done.err
    assert "red: readable by 10 labels" in done.err and "100% of the objects are found" in done.err
    return out


def test_the_target_is_counted_by_its_detections(fitted, found):
    run = RunFolder.at(fitted)
    assert run.features.name == "detections" and run.feature_names == ("red", "blue", "total")
    names = {one["id"]: one["name"] for one in found.all["categories"]}
    features = run.read_tensors("real")["features"]
    for number, image in enumerate(found.all["images"]):
        own = [names[one["category_id"]] for one in found.all["annotations"] if one["image_id"] == image["id"]]
        assert features[number].tolist() == [own.count("red"), own.count("blue"), len(own)]
    assert run.record["readings"]["path"] == str(found.found.resolve())


def test_every_command_takes_the_run(fitted, call, found, tmp_path):
    done = call("evaluate", fitted, "--target", found.images, "--labels", found.labels, "--scenes", 60)
    assert done.code == 0 and "Verdict" in done.out, done.err
    assert call("report", fitted, "--scenes", 60).code == 0
    assert call("generate", fitted, "--num", 4, "--out", tmp_path / "set").code == 0
    others = tmp_path / "others"
    others.mkdir()
    for file in sorted(found.images.iterdir())[:50]:
        (others / file.name).write_bytes(file.read_bytes())
    done = call("evaluate", fitted, "--target", others, "--scenes", 0)
    assert done.code == 2 and "expected the images that the run's detections are of, got others" in done.err


def test_sizes_are_judged_by_the_boxes_that_were_found(fitted):
    run = RunFolder.at(fitted)
    target = open_target(run, silent)
    del run.record["labels"]
    boxes = given_boxes(run, target)
    assert len(boxes.boxes) == len(target) and boxes.counts.sum() == run.read_tensors("real")["features"][:, 2].sum()


def test_parameters_are_learnt_from_the_boxes_that_were_found(call, discs, found, tmp_path, monkeypatch):
    measured, seen = parameter_stage.labelled_objects, []
    monkeypatch.setattr(parameter_stage, "labelled_objects", lambda *a: seen.append(measured(*a)) or seen[-1])
    small = [
        word for key in ("rounds=1", "first=50", "scenes=20", "steps=2") for word in ("--set", f"parameters.{key}")
    ]
    words = ("--readings", found.found, "--learn", "structure,parameters", "--parameters", "tilting", *small)
    done = call("fit", discs.file, "--target", found.images, "--out", tmp_path / "run", *words, *QUICK[2:])
    assert done.code == 0, done.err
    (objects,) = seen
    assert objects.images == 80 and len(objects.label) == len(found.all["annotations"])


def test_a_run_goes_on_with_the_same_readings_alone(fitted, call, found, tmp_path):
    moved = tmp_path / "moved.json"
    moved.write_bytes(found.found.read_bytes())
    assert call("fit", "--resume", "--out", fitted, "--readings", moved).code == 0
    changed = tmp_path / "changed.json"
    changed.write_text(found.found.read_text().replace("0.9", "0.8"))
    done = call("fit", "--resume", "--out", fitted, "--readings", changed)
    assert done.code == 2 and "expected the readings that the run" in done.err


def test_from_python_too(discs, found, tmp_path):
    target = ps.TargetImages(found.images, readings=found.found)
    small = {"structure.batches": 1, "structure.num_scenes": 20, "pretrain.derivations": 100, "pretrain.epochs": 1}
    config = ps.preset("quick").set("parameters=none", small)
    fit = ps.fit(discs.file, target, config, out=tmp_path / "run", execution=ps.Execution(progress=False))
    assert fit.features.name == "detections"


def test_results_by_names_are_the_same_detections(discs, found, tmp_path):
    model = load_model(str(discs.file))
    target = ps.ImageFolder(found.images, model.canvas, model.channels)
    names = {one["id"]: one["name"] for one in found.all["categories"]}
    files = {one["id"]: one["file_name"] for one in found.all["images"]}
    results = json.loads(found.found.read_text())["annotations"]
    by_name = [
        {**one, "image_id": Path(files[one["image_id"]]).name, "category_id": names[one["category_id"]]}
        for one in results
    ]
    (tmp_path / "results.json").write_text(json.dumps(by_name))
    one, other = (read_detections(file, model, target).found for file in (found.found, tmp_path / "results.json"))
    for part, same in zip(one[:4], other[:4], strict=True):
        assert (part == same).all()
    (tmp_path / "numbers.json").write_text(json.dumps(results))
    with pytest.raises(DataError, match="expected lists of images and categories beside the detections"):
        read_detections(tmp_path / "numbers.json", model, target)


def test_what_cannot_be_used_is_refused_before_a_run_begins(call, discs, found, tmp_path):
    fit = ("fit", discs.file, "--target", found.images, "--out", tmp_path / "run", *QUICK)
    done = call(*fit, "--readings", found.labels)
    assert done.code == 2 and "expected COCO's results with a score for each box" in done.err
    done = call(*fit, "--readings", found.found, "--features", "count")
    assert done.code == 2 and "expected no other features with --readings, got --features count" in done.err
    done = call(*fit, "--features", "detections")
    assert done.code == 2 and "expected --readings FILE for features 'detections', got none" in done.err
    wrong = json.loads(found.found.read_text())
    (tmp_path / "wrong.json").write_text(
        json.dumps({**wrong, "categories": [{**one, "name": f"not {one['name']}"} for one in wrong["categories"]]})
    )
    done = call(*fit, "--readings", tmp_path / "wrong.json")
    assert done.code == 2 and "expected categories among the classes of model" in done.err
    wrong["annotations"][0]["score"] = 7
    (tmp_path / "wrong.json").write_text(json.dumps(wrong))
    done = call(*fit, "--readings", tmp_path / "wrong.json")
    assert done.code == 2 and "expected a score from 0 to 1 in annotations[0]" in done.err
    assert not (tmp_path / "run").exists()


def test_photographs_without_detections_are_said(call, discs, found, tmp_path):
    half = json.loads(found.found.read_text())
    kept = {image["id"] for image in half["images"][::2]}
    half["annotations"] = [one for one in half["annotations"] if one["image_id"] in kept]
    (tmp_path / "half.json").write_text(json.dumps(half))
    done = call(
        "fit",
        discs.file,
        "--target",
        found.images,
        "--out",
        tmp_path / "r",
        "--readings",
        tmp_path / "half.json",
        *QUICK,
    )
    assert done.code == 0 and "of 80 images have no detection in" in done.err and "they count as empty" in done.err
