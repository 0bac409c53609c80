"""``--assets DIR``: a model is drawn with what is in a folder, and a run remembers which."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from probscene.app.fitting.run import RunFolder
from probscene.app.loading import load_model
from probscene.errors import DataError, ModelError, RunError
from probscene.models.assets.catalogue import street

SLAB = "".join(f"v {x} {y} {z}\n" for x in (-0.9, 0.9) for y in (0, 1.5) for z in (-2.2, 2.2)) + (
    "f 1 2 4 3\nf 5 7 8 6\nf 1 5 6 2\nf 3 4 8 7\nf 1 3 7 5\nf 2 6 8 4\n"
)


@pytest.fixture(autouse=True)
def _own_assets(monkeypatch):
    monkeypatch.delenv("PROBSCENE_ASSETS", raising=False)
    monkeypatch.delenv("PROBSCENE_SPRITES", raising=False)


def meshes(folder: Path, text: str = SLAB) -> Path:
    (folder / "car").mkdir(parents=True, exist_ok=True)
    (folder / "car" / "slab.obj").write_text(text)
    return folder


def cars(model) -> list[bool]:
    """Of the meshes that a model draws with and that may be cars, whether they are of the file above."""
    own = {id(mesh) for mesh in street()["car"]}
    drawn = [mesh for layer in model(8).layers for mesh in layer.meshes]
    slab = [len(mesh.triangles) == 12 and mesh.size.tolist() == pytest.approx([4.4, 1.8, 1.5]) for mesh in drawn]
    return [is_slab for is_slab, mesh in zip(slab, drawn, strict=True) if is_slab or id(mesh) in own]


@pytest.mark.parametrize("reference", ["driving:city", "driving", "driving_simple:city,rural"])
def test_every_scenario_is_drawn_with_the_folder(tmp_path, reference):
    own, other = load_model(reference), load_model(reference, meshes(tmp_path))
    assert any(cars(other)) and all(cars(other)) and not any(cars(own))
    assert own.assets == "" and str(tmp_path) in other.assets and other.name == own.name
    assert [name for name, _ in other.scenarios] == [name for name, _ in own.scenarios]
    assert other.target(0).assets == other.assets and all(cars(other.target(0)))


def test_aerial_pictures(tmp_path):
    for kind, size in (("car", (40, 20)), ("tree", (30, 30)), ("house", (50, 40))):
        (tmp_path / kind).mkdir()
        Image.fromarray(np.full((*size[::-1], 4), 255, np.uint8)).save(tmp_path / kind / "a.png")
    model = load_model("aerial2d", tmp_path)
    assert model.assets == f"pictures in {tmp_path}" and model.target(0).assets == model.assets
    assert model.with_assets(str(tmp_path))(2).kinds == model.grammar.kinds


def test_a_model_without_assets_says_so(tmp_path, discs):
    with pytest.raises(ModelError, match="which has no with_assets; leave --assets out"):
        load_model(str(discs.file), tmp_path)


def test_a_run_remembers_its_folder(tmp_path, monkeypatch, fresh_folders):
    folder = meshes(tmp_path / "mine")
    monkeypatch.chdir(tmp_path)
    made = RunFolder.create(tmp_path / "run", "driving:city", {}, Path("mine"))
    monkeypatch.chdir("/")
    run = RunFolder.at(tmp_path / "run")
    assert run.model.assets == made.record["assets"] and str(folder) in run.model.assets
    assert json.loads((tmp_path / "run" / "run.json").read_text())["assets_folder"] == str(folder)
    shutil.move(folder, tmp_path / "moved")
    fresh_folders()
    with pytest.raises(DataError, match="Expected a folder of meshes, actual .*mine"):
        RunFolder.at(tmp_path / "run").model.program  # noqa: B018


def test_a_run_is_bound_to_what_is_in_the_folder(tmp_path, fresh_folders):
    folder = meshes(tmp_path / "mine")
    RunFolder.create(tmp_path / "run", "driving:city", {}, folder)
    meshes(folder, SLAB.replace("2.2", "2.3"))
    fresh_folders()
    with pytest.raises(RunError, match="to draw with meshes in .*, as when the run .* was begun, actual meshes in"):
        RunFolder.at(tmp_path / "run").model.program  # noqa: B018


@pytest.fixture
def fresh_folders():
    """What a new process has: no folder read yet."""
    from probscene.models.assets.meshes.folder import described, folder

    def forget():
        folder.cache_clear()
        described.cache_clear()

    yield forget
    forget()


@pytest.mark.parametrize("command", ["check", "preview", "view", "fit"])
def test_a_folder_that_cannot_be_used_leaves_nothing_behind(tmp_path, call, target, command):
    folder = meshes(tmp_path / "mine", SLAB.replace("2.2", "220"))
    out = {"check": [], "preview": ["--out", tmp_path / "out" / "a.png"], "view": ["--out", tmp_path / "out" / "a.glb"],
           "fit": ["--target", target.images, "--out", tmp_path / "out"]}[command]  # fmt: skip
    done = call(command, "driving", "--assets", folder, *out)
    assert done.code == 2 and "actual 440 m in" in done.err and "slab.obj" in done.err
    assert done.err.count("\n") == 1 and "Traceback" not in done.err and not (tmp_path / "out").exists()


def test_a_run_takes_no_other_assets(tmp_path, call, fitted):
    done = call("preview", fitted, "--assets", tmp_path, "--out", tmp_path / "a.png")
    assert done.code == 2 and "Expected a model with --assets, actual the run" in done.err
    again = call("fit", "--resume", "--out", fitted, "--assets", tmp_path)
    assert again.code == 2 and "Expected the assets_folder that the run" in again.err
