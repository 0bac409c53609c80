"""A model file with several scenarios, through the command line."""

import csv
import json
from pathlib import Path

import pytest
import torch

from probscene.app.datasets.generate import generate_scenes
from probscene.app.datasets.provenance import remake
from probscene.app.evaluation.labels import counts_of_dataset
from probscene.app.fitting.run import RunFolder
from probscene.app.labels.counts import write_counts
from probscene.app.loading import load_model
from probscene.errors import ModelError
from probscene.inference.guides.scenario import ScenarioGuide

STREETS = Path(__file__).parents[1] / "streets.py"


@pytest.fixture(scope="module")
def joint_target(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("joint")
    model = load_model(str(STREETS))
    generate_scenes(model, model.prior, 40, folder / "drawn", format="images")
    names, counts = counts_of_dataset(model, folder / "drawn")
    write_counts(folder / "counts.csv", names, counts, model.classes)
    return folder


@pytest.fixture(scope="module")
def joint_run(tmp_path_factory, call, discs, joint_target) -> Path:
    out = tmp_path_factory.mktemp("run") / "run"
    target = joint_target / "drawn" / "images"
    done = call("fit", STREETS, "--scenarios", "row,yard", "--target", target, "--out", out, *discs.settings)
    assert done.code == 0, done.err
    return out


def test_a_reference_names_all_scenarios_some_or_one():
    assert [name for name, _ in load_model(str(STREETS)).scenarios] == ["row", "yard"]
    both = load_model(f"{STREETS}:yard,row")
    assert [name for name, _ in both.scenarios] == ["yard", "row"] and both.name == "streets-yard-row"
    assert load_model(f"{STREETS}:yard").name == "yard" and not load_model(f"{STREETS}:yard").scenarios
    with pytest.raises(ModelError, match="among row, yard, each once, got row,lawn; name them"):
        load_model(f"{STREETS}:row,lawn")
    with pytest.raises(ModelError, match="each once"):
        load_model(f"{STREETS}:row,row")
    with pytest.raises(ModelError, match="SCENARIOS in multi_mnist, from which a are chosen, got none; name no"):
        load_model("multi_mnist:a")
    for names, said in (("", "''"), ("row,", "row,''"), ("row;yard", "'row;yard'")):
        with pytest.raises(ModelError, match=f"each once, got {said}; name them with commas"):
            load_model(f"{STREETS}:{names}")


def test_one_guide_a_scenario_is_learnt(joint_run):
    run = RunFolder.at(joint_run)
    guide = run.guide
    assert isinstance(guide, ScenarioGuide) and len(guide.guides) == 2
    assert run.record["model"] == f"{STREETS.resolve()}:row,yard"


def test_a_run_goes_on_to_the_same_bits(tmp_path, call, discs, joint_target, joint_run):
    target = joint_target / "drawn" / "images"
    words = ("fit", STREETS, "--target", target, "--out", tmp_path / "run", "--scenarios", "row,yard", *discs.settings)
    assert call(*words).code == 0
    wrong = call(*words[:-1], words[-1], "--resume", "--seed", "3")
    assert wrong.code == 2
    one, other = (RunFolder.at(path).guide.state_dict() for path in (joint_run, tmp_path / "run"))
    assert all(torch.equal(one[key], other[key]) for key in one)
    another = call("fit", STREETS, "--scenarios", "row", "--out", tmp_path / "run", "--resume")
    assert another.code == 2 and "streets.py:row,yard), got" in another.err


def test_datasets_hold_scenes_of_every_scenario(tmp_path, call, joint_run):
    done = call("generate", joint_run, "--num", 40, "--out", tmp_path / "data")
    assert done.code == 0, done.err
    model = RunFolder.at(joint_run).model
    lines = [json.loads(line) for line in (tmp_path / "data" / "provenance.jsonl").read_text().splitlines()]
    first = [line["derivation"].split(";")[0] for line in lines]
    assert set(first) == {"Scenario -> Scene-row", "Scenario -> Scene-yard"}
    names = {
        category["name"] for category in json.loads((tmp_path / "data" / "annotations.json").read_text())["categories"]
    }
    assert names == {"disc", "box"}
    for line in (lines[first.index(name)] for name in sorted(set(first))):
        image, _ = remake(model, line)
        assert image.shape == (3, 64, 64)
    assert call("preview", joint_run, "--out", tmp_path / "preview.png").code == 0


def test_the_counts_of_all_scenarios_are_judged_together(tmp_path, call, joint_run, joint_target):
    target, labels = joint_target / "drawn" / "images", joint_target / "counts.csv"
    with open(labels, newline="") as file:
        assert next(csv.reader(file)) == ["image", "disc", "box"]
    words = ("--target", target, "--labels", labels, "--num", 300, "--scenes", 0, "--json", tmp_path / "found.json")
    done = call("evaluate", joint_run, *words)
    assert done.code == 0, done.err
    assert "box" in (tmp_path / "found.json").read_text()


def test_scenarios_that_there_are_not(tmp_path, call, joint_target):
    target = joint_target / "drawn" / "images"
    done = call("fit", STREETS, "--scenarios", "row,lawn", "--target", target, "--out", tmp_path / "run")
    assert done.code == 2 and "among row, yard" in done.err and not (tmp_path / "run").exists()
    twice = call("fit", f"{STREETS}:row", "--scenarios", "yard", "--target", target, "--out", tmp_path / "run")
    assert twice.code == 2 and "expected scenarios once" in twice.err and not (tmp_path / "run").exists()
