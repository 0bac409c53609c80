"""``--assets DIR``: a model is drawn with what is in a folder, and a run remembers which."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from probscene.app.fitting.run import RunFolder
from probscene.app.loading import folder_digest, load_model, same_assets
from probscene.errors import DataError, ModelError, RunError
from probscene.models.assets.things.catalogue import street
from probscene.sampling import sample

SLAB = "".join(f"v {x} {y} {z}\n" for x in (-0.9, 0.9) for y in (0, 1.5) for z in (-2.2, 2.2)) + (
    "f 1 2 4 3\nf 5 7 8 6\nf 1 5 6 2\nf 3 4 8 7\nf 1 3 7 5\nf 2 6 8 4\n"
)


@pytest.fixture(autouse=True)
def _own_assets(monkeypatch):
    monkeypatch.delenv("PROBSCENE_ASSETS", raising=False)
    monkeypatch.delenv("PROBSCENE_SPRITES", raising=False)
    monkeypatch.delenv("PROBSCENE_MNIST", raising=False)


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


def pictures(folder: Path) -> Path:
    for kind, size in (("car", (40, 20)), ("tree", (30, 30)), ("house", (50, 40))):
        (folder / kind).mkdir(parents=True)
        Image.fromarray(np.full((*size[::-1], 4), 255, np.uint8)).save(folder / kind / "a.png")
    return folder


def test_aerial_pictures(tmp_path):
    model = load_model("aerial2d", pictures(tmp_path))
    assert model.assets == f"pictures in {tmp_path}" and model.target(0).assets == model.assets
    assert model.with_assets(str(tmp_path))(2).kinds == model.grammar.kinds


def test_digits_of_a_folder(idx_folder, tmp_path):
    model = load_model("multi_mnist", idx_folder)
    assert model.assets == model.target(0).assets == f"IDX digits in {idx_folder}"
    atlases = [sample(m, m.prior, 8).drawing.layers[0].atlas for m in (model, model.target(0))]
    assert [len(atlas) for atlas in atlases] == [20, 20] and atlases[0] is not atlases[1]
    with pytest.raises(DataError, match=f"in {tmp_path}, got none"):
        load_model("multi_mnist", tmp_path)


VARIABLES = {"aerial2d": "PROBSCENE_SPRITES", "driving:city": "PROBSCENE_ASSETS", "driving": "PROBSCENE_ASSETS",
             "multi_mnist": "PROBSCENE_MNIST"}  # fmt: skip


@pytest.mark.parametrize("reference", VARIABLES)
def test_a_variable_names_the_folder_where_no_option_does(reference, tmp_path, monkeypatch, idx_folder):
    variable, own = VARIABLES[reference], load_model(reference)
    folder = {"aerial2d": pictures, "multi_mnist": lambda _: idx_folder}.get(reference, meshes)(tmp_path)
    named = load_model(reference, folder)
    monkeypatch.setenv(variable, "relative/" * 3)
    assert load_model(reference, folder).assets == named.assets
    with pytest.raises(DataError, match=f"The variable {variable} names relative/"):
        load_model(reference)
    monkeypatch.chdir(folder.parent)
    monkeypatch.setenv(variable, folder.name)
    model = load_model(reference)
    assert model.assets == f"{named.assets} ({variable})" and same_assets(model.assets, named.assets)
    assert same_assets(f"{named.assets} of {variable}", model.assets) and not same_assets(own.assets, model.assets)
    assert (model.name, model.assets_variable) == (own.name, variable)
    monkeypatch.setenv(variable, "")
    assert load_model(reference).assets == own.assets


def test_the_environment_is_not_read_when_a_model_is_imported(tmp_path):
    program = (
        "from probscene.models import aerial2d, driving, driving_simple, multi_mnist\n"
        "for module in (aerial2d, driving, multi_mnist, driving_simple):\n"
        "    models = [module.MODEL] if hasattr(module, 'MODEL') else list(module.SCENARIOS.values())\n"
        "    assert all(model.assets in ('', 'digits of the install') for model in models), module\n"
        "    models[0](1)\n"
    )
    root = Path(__file__).resolve().parents[2]
    environment = {**os.environ, **dict.fromkeys(VARIABLES.values(), str(tmp_path)), "PYTHONPATH": str(root)}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_a_run_begun_with_a_variable_opens_with_it(tmp_path, monkeypatch, idx_folder):
    monkeypatch.setenv("PROBSCENE_MNIST", str(idx_folder))
    RunFolder.create(tmp_path / "run", "multi_mnist", {})
    assert RunFolder.at(tmp_path / "run").model.assets == f"IDX digits in {idx_folder} (PROBSCENE_MNIST)"


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
    with pytest.raises(RunError, match="expected the assets of .* in .*mine, got nothing there. .*--assets"):
        RunFolder.at(tmp_path / "run").model.program  # noqa: B018


def test_a_run_is_bound_to_what_is_in_the_folder(tmp_path, fresh_folders):
    folder = meshes(tmp_path / "mine")
    RunFolder.create(tmp_path / "run", "driving:city", {}, folder)
    meshes(folder, SLAB.replace("2.2", "2.3"))
    fresh_folders()
    with pytest.raises(RunError, match="to draw with meshes in .*, as when the run .* was begun, got meshes in"):
        RunFolder.at(tmp_path / "run").model.program  # noqa: B018


def test_so_it_is_where_words_do_not_say_what_a_folder_holds(tmp_path):
    folder = pictures(tmp_path / "mine")
    RunFolder.create(tmp_path / "run", "aerial2d", {}, folder)
    assert RunFolder.at(tmp_path / "run").model.assets == f"pictures in {folder}"
    Image.new("RGBA", (40, 20)).save(folder / "car" / "b.png")
    with pytest.raises(RunError, match=f"got pictures in {folder}, changed since; put them back, or fit again.$"):
        RunFolder.at(tmp_path / "run").model.program  # noqa: B018


def test_assets_may_be_a_file(tmp_path):
    file, digests = tmp_path / "ink", []
    for content in ("blue", "red", "blue"):
        file.write_text(content)
        digests.append(folder_digest(str(file)))
    assert digests[0] == digests[2] != digests[1]


def test_hidden_files_are_no_assets(tmp_path):
    pictures(tmp_path / "mine")
    before = folder_digest(str(tmp_path / "mine"))
    (tmp_path / "mine" / "car" / ".DS_Store").write_bytes(b"left by a file manager")
    assert folder_digest(str(tmp_path / "mine")) == before


def test_a_variable_may_name_another_folder_that_holds_the_same(tmp_path, monkeypatch):
    folder = pictures(tmp_path / "mine")
    monkeypatch.setenv("PROBSCENE_SPRITES", str(folder))
    RunFolder.create(tmp_path / "run", "aerial2d", {})
    shutil.move(folder, tmp_path / "moved")
    monkeypatch.setenv("PROBSCENE_SPRITES", str(tmp_path / "moved"))
    assert RunFolder.at(tmp_path / "run").model.assets == f"pictures in {tmp_path / 'moved'} (PROBSCENE_SPRITES)"
    monkeypatch.delenv("PROBSCENE_SPRITES")
    with pytest.raises(RunError, match="to draw with pictures in .*, as when .* was begun, got no assets; put them"):
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
    assert done.code == 2 and "got 440 m in" in done.err and "slab.obj" in done.err
    assert done.err.count("\n") == 1 and "Traceback" not in done.err and not (tmp_path / "out").exists()


def test_a_run_takes_no_other_assets(tmp_path, call, fitted):
    done = call("preview", fitted, "--assets", tmp_path, "--out", tmp_path / "a.png")
    assert done.code == 2 and "expected a model with --assets, got the run" in done.err
    again = call("fit", "--resume", "--out", fitted, "--assets", tmp_path)
    assert again.code == 2 and "expected the assets_folder that the run" in again.err
