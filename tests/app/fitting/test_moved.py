"""Runs whose model, images or labels lie elsewhere by now."""

import json
import shutil
from pathlib import Path

import pytest

from probscene.app.fitting.run import RunFolder


@pytest.fixture
def moved(discs, target, fitted, tmp_path):
    """An unfinished run, all of whose files were moved: where they lie now, and the run."""
    out, here = tmp_path / "run", tmp_path / "here"
    shutil.copytree(fitted, out)
    (out / "guide.safetensors").unlink()
    shutil.copytree(target.images, here / "images")
    shutil.copy(discs.file, here / "model.py")
    record = json.loads((out / "run.json").read_text())
    record |= {"model": str(tmp_path / "gone" / "model.py"), "target": str(tmp_path / "gone" / "images")}
    (out / "run.json").write_text(json.dumps(record))
    return here, out


def recorded(out: Path) -> tuple[str, str]:
    record = json.loads((out / "run.json").read_text())
    return record["model"], record["target"]


def test_a_run_goes_on_with_files_that_lie_elsewhere(call, fitted, moved):
    here, out = moved
    files = here / "model.py", here / "images"
    done = call("fit", files[0], "--target", files[1], "--out", out, "--resume")
    assert done.code == 0, done.err
    assert recorded(out) == tuple(map(str, files))
    assert (out / "guide.safetensors").read_bytes() == (fitted / "guide.safetensors").read_bytes()
    done = call("report", out, "--out", here / "report")
    assert done.code == 0, done.err


@pytest.mark.parametrize("ink", ["blue", "red"])
def test_a_folder_of_assets_may_lie_elsewhere_if_it_holds_the_same(call, fitted, moved, tmp_path, ink, inked):
    here, out = moved
    (here / "model.py").write_text((here / "model.py").read_text() + inked)
    for folder, content in (("begun", "blue"), ("inks", ink)):
        (here / folder).mkdir()
        (here / folder / "ink").write_text(content)
    made = RunFolder.create(tmp_path / "other", f"{here / 'model.py'}", {}, here / "begun").record
    keys = ("model", "model_sha256", "assets", "assets_folder", "assets_sha256")
    record = json.loads((out / "run.json").read_text()) | {key: made[key] for key in keys}
    (out / "run.json").write_text(json.dumps(record | {"target": str(here / "images")}))
    shutil.rmtree(here / "begun")
    done = call("fit", "--out", out, "--resume")
    assert done.code == 2 and f"probscene fit --assets FOLDER --out {out} --resume" in done.err
    done = call("fit", "--out", out, "--resume", "--assets", here / "inks")
    if ink == "red":
        assert done.code == 2 and "expected the assets_folder that the run" in done.err
        return
    assert done.code == 0, done.err
    record = json.loads((out / "run.json").read_text())
    assert (record["assets"], record["assets_folder"]) == (f"inks in {here / 'inks'}", str(here / "inks"))
    assert (out / "guide.safetensors").read_bytes() == (fitted / "guide.safetensors").read_bytes()


def test_it_says_what_to_name(call, moved):
    here, out = moved
    before = recorded(out)
    done = call("fit", "--out", out, "--resume")
    assert done.code == 2 and "expected the images of the run" in done.err and "--target" in done.err
    done = call("fit", "--target", here / "images", "--out", out, "--resume")
    assert done.code == 2 and f"probscene fit FILE --out {out} --resume" in done.err
    assert recorded(out) == before


@pytest.mark.parametrize("other", ["model", "target"])
def test_other_files_are_refused(call, moved, other):
    here, out = moved
    before = recorded(out)
    if other == "model":
        (here / "model.py").write_text((here / "model.py").read_text() + "\n")
    else:
        next((here / "images").glob("*.png")).unlink()
    done = call("fit", here / "model.py", "--target", here / "images", "--out", out, "--resume")
    assert done.code == 2 and f"expected the {other} that the run in {out} was begun with" in done.err
    assert recorded(out) == before


def test_a_finished_run_learns_where_its_images_are(call, fitted, moved):
    here, out = moved
    shutil.copy(fitted / "guide.safetensors", out)
    done = call("fit", here / "model.py", "--target", here / "images", "--out", out, "--resume")
    assert done.code == 0, done.err
    assert recorded(out) == (str(here / "model.py"), str(here / "images"))
