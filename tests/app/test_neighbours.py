"""A model's file, and a part's, may import modules that lie beside it."""

import importlib
import pickle
import subprocess
import sys
from pathlib import Path

import pytest
from rich.console import Console

from probscene.app.fitting import begin
from probscene.app.fitting.run import RunFolder
from probscene.app.loading import load_model
from probscene.app.modules import import_file
from probscene.app.neighbours import neighbours
from probscene.app.progress import Display
from probscene.errors import ModelError, RunError

SCENE = """
import pyro
import pyro.distributions as dist

import probscene as ps
from helper import RADIUS

GRAMMAR = ps.Grammar("Scene -> Plates\\nPlates -> plate Plates | ε")
PRIOR = ps.StructurePrior(GRAMMAR, Plates=ps.counts(0, 1, 1))


@ps.scene_model(GRAMMAR, PRIOR, canvas=(32, 32), max_steps=12, classes=("plate",))
def plates(scene):
    from looks.tints import tint

    with scene.nodes("plate"):
        x = pyro.sample("x", dist.Uniform(8.0, 24.0))
    return scene.draw(ps.Sprites.disc("plate", x, 16.0, radius=RADIUS, tint=tint()))
"""
TINTS = "from . import colours\nimport helper\ndef tint():\n    return (*colours.RG, helper.BLUE)\n"


def folder(place: Path, radius: float = 5.0, blue: float = 0.5) -> Path:
    """A model, with a module and a package beside it; returns its file."""
    (place / "looks").mkdir(parents=True, exist_ok=True)
    (place / "scene.py").write_text(SCENE)
    (place / "helper.py").write_text(f"RADIUS = {radius}\nBLUE = {blue}\n")
    (place / "looks" / "__init__.py").write_text("")
    (place / "looks" / "tints.py").write_text(TINTS)
    (place / "looks" / "colours.py").write_text("RG = (1.0, 0.5)\n")
    (place / "other.py").write_text("raise ValueError('nobody imports this')\n")
    return place / "scene.py"


BESIDE = ["helper.py", "looks/__init__.py", "looks/colours.py", "looks/tints.py"]


def drawn(model) -> tuple[float, list[float]]:
    layer = model(4).layers[0]
    return float(layer.scale_x.max()), [round(float(t), 3) for t in layer.tint.reshape(-1, 3)[0]]


def test_two_folders_have_each_their_own(tmp_path):
    """Also what is imported when the program is called, after both were loaded."""
    before = dict(sys.modules), list(sys.path)
    one, two = load_model(str(folder(tmp_path / "one"))), load_model(str(folder(tmp_path / "two", 8.0, 0.25)))
    (a, tint_a), (b, tint_b) = drawn(one), drawn(two)
    assert b == pytest.approx(1.6 * a) and (tint_a, tint_b) == ([1.0, 0.5, 0.5], [1.0, 0.5, 0.25])
    assert sys.path == before[1] and not {"helper", "looks"} & (set(sys.modules) - set(before[0]))


def test_a_module_that_was_changed_is_read_again(tmp_path):
    file = folder(tmp_path)
    first = drawn(load_model(str(file)))
    folder(tmp_path, 4.0, 0.75)
    second = drawn(load_model(str(file)))
    assert second[0] == pytest.approx(0.8 * first[0]) and second[1] == [1.0, 0.5, 0.75]


@pytest.mark.parametrize("name", ["json", "numpy", "probscene"])
def test_what_is_installed_goes_before(tmp_path, name):
    (tmp_path / f"{name}.py").write_text("raise ValueError('a folder beside a model shadows nothing')\n")
    (tmp_path / "scene.py").write_text(f"import {name}\nfound = {name}.__file__\n")
    assert Path(import_file(tmp_path / "scene.py").found) == Path(importlib.import_module(name).__file__)
    assert neighbours(tmp_path / "scene.py") == {}


def test_only_what_is_imported_is_a_neighbour(tmp_path):
    file = folder(tmp_path)
    assert neighbours(file) == {name: tmp_path / name for name in BESIDE}
    assert neighbours(tmp_path / "looks" / "colours.py") == neighbours(tmp_path / "missing.py") == {}


IMPORTS = {
    "import helper": "helper.BLUE",
    "import helper as h": "h.BLUE",
    "from helper import *": "BLUE",
    "import looks.colours": "looks.colours.RG",
    "import looks.colours as c": "c.RG",
    "from looks import colours": "colours.RG",
    "from looks.colours import RG as rg": "rg",
    "from plain import inner": "inner.X",
    "import plain.inner": "plain.inner.X",
    "h = __import__('helper')": "h.BLUE",
    "import importlib; h = importlib.import_module('helper')": "h.BLUE",
    "import importlib.util; c = importlib.import_module('looks.colours')": "c.RG",
    "from importlib import import_module, util; c = import_module('looks.colours')": "c.RG",
}


@pytest.mark.parametrize("line", IMPORTS)
@pytest.mark.parametrize("late", [False, True])
def test_every_form_of_import(tmp_path, line, late):
    """At the top, and in a function, where there is no star."""
    folder(tmp_path)
    (tmp_path / "plain").mkdir()
    (tmp_path / "plain" / "inner.py").write_text("X = 3\n")
    late = late and "*" not in line
    text = (
        f"def found():\n    {line}\n    return {IMPORTS[line]}\n"
        if late
        else f"{line}\nfound = lambda: {IMPORTS[line]}\n"
    )
    (tmp_path / "part.py").write_text(text)
    assert import_file(tmp_path / "part.py").found() in (0.5, (1.0, 0.5), 3)
    (name,) = {name for name in neighbours(tmp_path / "part.py") if "__init__" not in name}
    assert name in ("helper.py", "looks/colours.py", "plain/inner.py")


def test_their_objects_are_pickled(tmp_path):
    (tmp_path / "shapes.py").write_text("class Shape:\n    pass\n")
    (tmp_path / "part.py").write_text("import shapes\nmade = shapes.Shape()\n")
    made = import_file(tmp_path / "part.py").made
    assert type(pickle.loads(pickle.dumps(made))) is type(made)


def test_an_error_in_one_is_named(tmp_path):
    folder(tmp_path)
    (tmp_path / "helper.py").write_text("RADIUS = 1 / 0\n")
    with pytest.raises(ModelError, match="does not import: ZeroDivisionError: .*'RADIUS = 1 / 0'"):
        load_model(str(tmp_path / "scene.py"))
    (tmp_path / "scene.py").write_text("import nowhere\n")
    with pytest.raises(ModelError, match="ModuleNotFoundError: No module named 'nowhere'"):
        load_model(str(tmp_path / "scene.py"))


def test_a_run_has_them_whole(tmp_path):
    file = folder(tmp_path / "mine")
    made = RunFolder.create(tmp_path / "run", str(file), {})
    assert sorted(made.record["modules"]) == BESIDE
    copies = {each.relative_to(made.path / "model").as_posix() for each in (made.path / "model").rglob("*.py")}
    assert copies == {"scene.py", *BESIDE}
    assert drawn(RunFolder.at(tmp_path / "run").model) == drawn(load_model(str(made.path / "model" / "scene.py")))


@pytest.mark.parametrize("name", BESIDE[:1] + BESIDE[2:])
@pytest.mark.parametrize("how", ["changed", "gone"])
def test_a_run_knows_that_one_has_changed(tmp_path, name, how):
    file = folder(tmp_path / "mine")
    RunFolder.create(tmp_path / "run", str(file), {})
    if how == "gone":
        (file.parent / name).unlink()
    else:
        (file.parent / name).write_text((file.parent / name).read_text() + "\n")
    with pytest.raises(
        RunError, match=f"the model's file .*{name} as it was when .* A copy is in .*model: put it back"
    ):
        RunFolder.at(tmp_path / "run").model.program  # noqa: B018


@pytest.mark.parametrize("changed", [False, True])
def test_a_run_takes_the_same_files_elsewhere(tmp_path, changed):
    run = RunFolder.create(tmp_path / "run", str(folder(tmp_path / "mine")), {})
    before, copy = run.record["model"], tmp_path / "run" / "model" / "scene.py"
    if changed:
        (copy.parent / "looks" / "colours.py").write_text("RG = (1, 1)")
    begin._relocate(run, begin.FitRequest(begin.ModelFile(str(copy))), Display(Console(quiet=True)))
    assert run.record["model"] == (before if changed else str(copy))


def test_a_model_without_leaves_no_more_than_its_file(tmp_path):
    (tmp_path / "scene.py").write_text(SCENE.replace("from helper import RADIUS", "RADIUS = 5").replace(
        "    from looks.tints import tint\n", "    tint = lambda: (1.0, 1.0, 1.0)\n"))  # fmt: skip
    made = RunFolder.create(tmp_path / "run", str(tmp_path / "scene.py"), {})
    assert "modules" not in made.record and not (made.path / "model").exists()


def test_check_finds_nothing_to_mend(tmp_path, call):
    done = call("check", folder(tmp_path))
    assert done.code == 0 and "Nothing to fix" in done.out, done.err


def test_another_process_finds_them(tmp_path):
    """As a worker does, which is given the model's file."""
    line = f"from probscene import load_model; load_model({str(folder(tmp_path))!r})(2)"
    done = subprocess.run([sys.executable, "-c", line], cwd="/", capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
