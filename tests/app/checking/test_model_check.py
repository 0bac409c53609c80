"""``check`` runs the program: what only running shows is a fault or a warning, also before a fit writes anything."""

from dataclasses import replace
from pathlib import Path

import pyro
import pyro.distributions as dist
import pytest
import torch

from probscene.app.checking.model_check import QUICK, check_model
from probscene.app.checking.randomness import hidden_randomness
from probscene.app.loading import load_model
from probscene.drawing import Sprites
from probscene.generator import Command
from probscene.grammar import Grammar
from probscene.model import Groups, scene_model
from probscene.renderers.sprites import SpriteRenderer
from probscene.request import Objects
from probscene.sampling import sample
from probscene.structure import StructurePrior, counts

DISCS = Path(__file__).parents[1] / "discs.py"
GOOD = DISCS.read_text(encoding="utf-8")
X = 'x = pyro.sample("x", dist.Uniform(8.0, 56.0))'
BLUE = 'Sprites.disc("blue", x, y, radius=6.0, tint=(0.2, 0.2, 1.0)),'
FAULTS = {
    "crashes": (X, "x = 1 / 0", ("ZeroDivisionError in", "m.py, line 24, 'x = 1 / 0': division by zero")),
    "negative scale": (
        X,
        'x = pyro.sample("x", dist.Normal(32.0, -1.0))',
        ("line 24", "Expected parameter scale", "GreaterThan(lower_bound=0.0), but found -1.0"),
    ),
    "inverted Uniform": (X, X.replace("8.0, 56.0", "56.0, 8.0"), ("line 24", "Expected parameter low")),
    "repeated name": (X, X.replace('"x"', '"y"'), ("line 25", "Multiple sample sites named 'y'")),
    "a class never drawn": (BLUE, "", ("Class 'blue' is never drawn", "a layer of kind 'blue'")),
    "a class off the canvas": (
        BLUE,
        BLUE.replace("x, y", "x + 100, y"),
        ("Class 'blue' can never be seen: they stand off the canvas, x from 1", "64 wide and 64 high"),
    ),
    "all off the canvas": (
        X,
        X.replace("8.0, 56.0", "1.0, 2.0").replace("x =", "x = 500 *"),
        ("Nothing that is drawn",),
    ),
    "without pixels": ("radius=6.0", "radius=1e-6", ("Nothing that is drawn can be seen", "have no pixel")),
    "covered": (
        BLUE,
        BLUE + 'Sprites.box("blue", x, y, 20.0, 20.0, labelled=False),',
        ("Class 'blue' can never be seen: something covers them", "from the back to the front"),
    ),
    "a parameter of Pyro's": (
        X,
        X + '\n            pyro.param("shift", dist.Uniform(0.0, 1.0).sample)',
        ("pyro.param('shift'), which no fit learns", "such as pyro.sample('shift',"),
    ),
    "not finite": (
        X,
        f'{X}\n            pyro.sample("z", dist.LogNormal(85.0, 5.0))',
        ("Site 'z' is NaN or infinite in",),
    ),
    "shorter inside": ("max_steps=12", "max_steps=9", ("derives with max_steps = 9", "says max_steps = 12")),
    "a negative radius": ("radius=6.0", "radius=-6.0", ("expected a positive scale", "got -")),
}


def written(folder: Path, before: str, after: str) -> Path:
    assert before in GOOD
    file = folder / "m.py"
    file.write_text(GOOD.replace(before, after), encoding="utf-8")
    return file


def one_line(result) -> str:
    (line,) = [line for line in result.err.splitlines() if line.startswith("probscene: ")]
    assert result.code == 2 and result.err.endswith(line + "\n") and "Traceback" not in result.err
    assert "A bug in probscene" not in line
    return line


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_of_the_program_is_found_before_anything_is_written(fault, call, target, tmp_path):
    before, after, parts = FAULTS[fault]
    file = written(tmp_path, before, after)
    checked = call("check", file)
    assert "1; fix them first" in one_line(checked)
    (told,) = [line for line in checked.out.splitlines() if line.startswith("Fault: ")]
    fitted = one_line(call("fit", file, "--target", target.images, "--out", tmp_path / "run"))
    assert not (tmp_path / "run").exists()
    for part in parts:
        assert part in told and part in fitted, (told, fitted)


TWICE, RECORDED = "got other ones where it runs twice with the same seed", "where its sites have the recorded values"
RANDOM = {  # beside pyro.sample: how far a disc is moved, what says so, and whether one seed still gives one drawing
    "torch": ("torch.rand(x.shape)", False),
    "torch's own generator": ("torch.rand(x.shape, generator=OWN)", True),
    "a distribution": ("dist.Uniform(0.0, 1.0).sample(x.shape)", False),
    "random": ("random.random()", False),
    "random of the system": ("random.SystemRandom().random()", True),
    "numpy": ("np.random.rand()", False),
    "numpy, fresh": ("torch.tensor(np.random.default_rng().random(x.shape), dtype=x.dtype)", True),
    "numpy, kept": ("RNG.random()", True),
    "kept from call to call": ("len(CALLS.append(0) or CALLS) % 7 / 7", True),
    "the clock": ("time.perf_counter() % 1e-3 * 1e3", True),
}
HEAD = """import random, time
import numpy as np
import torch
OWN, RNG, CALLS = torch.Generator(), np.random.default_rng(0), []
"""


@pytest.mark.parametrize("how", RANDOM)
def test_what_is_random_beside_sites_is_a_fault(how, tmp_path):
    moved, twice = RANDOM[how]
    file = written(tmp_path, 'Sprites.disc("red", x,', f'Sprites.disc("red", x + 20 * {moved},')
    file.write_text(HEAD + file.read_text())
    faults = check_model(load_model(str(file)), *QUICK).faults
    (fault,) = [fault for fault in faults if "something random is no site" in fault]
    assert (TWICE in fault) == twice and RECORDED in fault and "pyro.sample('shift'" in fault


@pytest.mark.parametrize("seed", ["", "0"])
def test_so_is_what_is_drawn_when_the_file_is_imported(seed, tmp_path, call):
    """Each process would have its own."""
    file = written(tmp_path, 'Sprites.disc("red", x,', 'Sprites.disc("red", x + 20 * SHIFT,')
    file.write_text(f"import random\nSHIFT = random.Random({seed}).random()\n" + file.read_text())
    done = call("check", file)
    assert ("got other ones where its file is imported again:" in done.out) == (not seed) == (done.code != 0)


def noisy(canvas, threads):
    inner = SpriteRenderer(canvas, threads)

    def render(drawing):
        batch = inner(drawing)
        return batch._replace(image=batch.image + torch.randint_like(batch.image, 3))

    return render


def asks_for(chance):
    grammar = Grammar("Scene -> plate")

    @scene_model(grammar, StructurePrior(grammar), canvas=(32, 32), max_steps=3, classes=("plate",),
                 generator=Command(["nothing"]))  # fmt: skip
    def model(scene):
        return scene.request(Objects("plate", x=torch.rand(scene.kind.shape) if chance else 0.5))

    return model


@pytest.mark.parametrize("random", [False, True])
@pytest.mark.parametrize("who", ["renderer", "request"])
def test_so_is_what_a_renderer_draws_and_what_a_generator_is_asked_for(who, random):
    model = asks_for(random) if who == "request" else load_model(str(DISCS))
    render = noisy(model.canvas, 1) if random else SpriteRenderer(model.canvas, 1)
    faults = hidden_randomness(model, sample(model, model.prior, 4).derivation, render)
    assert [RECORDED in fault for fault in faults] == [True] * random
    assert [TWICE in fault for fault in faults] == [who == "renderer"] * random


IMPORTS = {
    "raises": ("x = 1\ny = [][3]\n", "IndexError: list index out of range (m.py, line 2: 'y = [][3]')"),
    "raises inside torch": (
        "import torch\ntorch.zeros(2) @ torch.zeros(3)\n",
        "line 2: 'torch.zeros(2) @ torch.zeros(3)'",
    ),
    "syntax": ("x = 1\ndef f(:\n", "SyntaxError: invalid syntax (m.py, line 2: 'def f(:')"),
    "exits": ("import sys\nsys.exit(3)\n", "SystemExit: 3 (m.py, line 2: 'sys.exit(3)')"),
    "a distribution": (
        "import pyro.distributions as dist\nD = dist.Normal(0.0, -1.0)\n",
        "GreaterThan(lower_bound=0.0), but found -1.0 (m.py, line 2: 'D = dist.Normal(0.0, -1.0)')",
    ),
}


@pytest.mark.parametrize("fault", IMPORTS)
def test_a_file_that_does_not_import_is_told_with_its_line(fault, call, tmp_path):
    text, part = IMPORTS[fault]
    (tmp_path / "m.py").write_text(text)
    assert part in one_line(call("check", tmp_path / "m.py"))


def test_debug_shows_the_users_traceback(call, tmp_path):
    result = call("--debug", "preview", written(tmp_path, X, "x = 1 / 0"), "--out", tmp_path / "grid.png")
    assert result.code == 1 and "probscene: " not in result.err


WARNINGS = {
    "seldom seen": (
        BLUE,
        BLUE.replace("x, y", "x + 300 * (torch.arange(num_scenes).unsqueeze(1) > 0), y"),
        ("Class 'blue' can be seen in ", "fewer than 5 %"),
    ),
    "small": ("radius=6.0", "radius=2.0", ("Objects are small, in pixels: 'red' 4, 'blue' 4; below 6",)),
    "longer inside": ("max_steps=12", "max_steps=20", ("derives with max_steps = 20", "say it once with scene_model")),
}


@pytest.mark.parametrize("warning", WARNINGS)
def test_what_works_badly_is_a_warning(warning, call, tmp_path):
    before, after, parts = WARNINGS[warning]
    file = written(tmp_path, before, after)
    file.write_text("import torch\n" + file.read_text().replace("(1, 1, 1, 1), (1, 1)", "(0, 0, 0, 1), (1, 9)"))
    result = call("check", file)
    assert result.code == 0, result.err
    (told,) = [line for line in result.out.splitlines() if line.startswith("Warning: ")]
    for part in parts:
        assert part in told


def tabletop(scene: str, grouped: bool = False, asks: bool = True):
    """Plates on a table, with or without brackets."""
    grammar = Grammar(f"Scene -> {scene}\nPlates -> Plate Plates | ε\nPlate -> plate(Mugs)\nMugs -> mug Mugs | ε")
    prior = StructurePrior(grammar, Plates=counts(1, 2, 1), Mugs=counts(1, 1))
    groups = Groups("table") if grouped else None

    @scene_model(grammar, prior, canvas=(64, 64), max_steps=30, classes=("table", "plate", "mug"), groups=groups)
    def model(scene):
        with scene.nodes("table"):
            left = pyro.sample("table.x", dist.Uniform(20.0, 30.0))
        with scene.nodes("plate", "mug"):
            x = pyro.sample("x", dist.Uniform(0.0, 30.0))
        x = x + scene.of_parent(left, default=20.0) if asks else x + 20.0
        return scene.draw(
            Sprites.box("table", 32.0, 32.0, 64.0, 64.0),
            Sprites.disc("plate", x, 20.0, 8.0),
            Sprites.disc("mug", x, 50.0, 6.0),
        )

    return model


@pytest.mark.parametrize(
    ("model", "warns"),
    [
        (tabletop("table(Plates)"), False),
        (tabletop("table Plates"), True),
        (tabletop("table Plates", asks=False), False),
        (tabletop("table Plates", grouped=True, asks=False), True),
    ],
)
def test_missing_brackets_are_named_with_the_production_that_has_them(model, warns):
    report = check_model(model)
    assert not report.faults
    brackets = [text for text in report.warnings if "'Scene -> table Plates'" in text]
    assert len(brackets) == warns == len(report.warnings)
    assert all("write 'Scene -> table(Plates)'" in text for text in brackets)


def test_parents_that_nothing_has_are_said():
    grammar = Grammar("Scene -> Discs\nDiscs -> disc Discs | ε")

    @scene_model(
        grammar, StructurePrior(grammar, Discs=counts(1, 2, 1)), canvas=(64, 64), max_steps=30, classes=("disc",)
    )
    def model(scene):
        with scene.nodes("disc"):
            x = pyro.sample("x", dist.Uniform(8.0, 56.0))
        return scene.draw(Sprites.disc("disc", 0.5 * x + scene.of_parent(x), 32.0, 6.0))

    (warning,) = check_model(model).warnings
    assert "no object has a parent" in warning and "brackets" in warning


def test_the_policy_of_pretraining_is_run_too(discs):
    model = load_model(str(discs.file))
    grammar = model.grammar

    def draws_few(num_scenes, structure):
        drawing = model.program(num_scenes, structure)
        assert drawing.kind.shape[1] <= 3, "too many"
        return drawing

    few = replace(model, program=draws_few)
    assert not check_model(few).faults
    (fault,) = check_model(replace(few, pretraining=StructurePrior(grammar, Discs=counts(0, 0, 0, 0, 1)))).faults
    assert "AssertionError" in fault and "too many" in fault


def test_each_scenario_is_checked_and_named(discs):
    from probscene.scenarios import join

    good = load_model(str(discs.file))
    bad = replace(good, program=lambda num_scenes, structure: good.program(num_scenes, structure) and None)
    (fault,) = check_model(join("both", {"one": good, "other": bad})).faults
    assert fault.startswith("Scenario 'other': expected the program") and "NoneType" in fault


def test_a_renderer_that_crashes_is_named(discs):
    def broken(canvas, threads):
        return lambda drawing: drawing.nothing

    (fault,) = check_model(replace(load_model(str(discs.file)), renderer=broken)).faults
    assert "the renderer of model 'discs' to run" in fault and "'return lambda drawing: drawing.nothing'" in fault


def test_it_leaves_no_trace(discs):
    """Random numbers and Pyro's parameters are what they would be without it."""
    model = load_model(str(discs.file))

    def program(num_scenes, structure):
        pyro.param("drawn", lambda: torch.rand(3))
        assert pyro.get_param_store()["kept"] == 5
        return model.program(num_scenes, structure)

    pyro.clear_param_store()
    pyro.param("kept", torch.tensor(5.0))
    before = torch.get_rng_state()
    (fault,) = check_model(replace(model, program=program)).faults
    assert "pyro.param('drawn')" in fault
    assert torch.equal(torch.get_rng_state(), before) and set(pyro.get_param_store()) == {"kept"}
    pyro.clear_param_store()


@pytest.mark.parametrize("name", ["multi_mnist", "aerial2d"])
def test_built_in_models_have_nothing_to_mend(name):
    assert str(check_model(load_model(name), 64, 16)).endswith("Nothing to fix.")


@pytest.mark.parametrize(("channels", "told"), [(1, True), (3, False)])
def test_colours_of_photos_that_are_read_as_grey(channels, told):
    grammar = Grammar("Scene -> Discs\nDiscs -> disc Discs | ε")
    prior = StructurePrior(grammar, Discs=counts(0, 1, 1))

    @scene_model(grammar, prior, canvas=(64, 64), max_steps=8, classes=("disc",), channels=channels)
    def photographed(scene):
        photo = scene.photo(exposure=(0.5, 1.0), saturation=(0.5, 1.5), blue_gain=(0.9, 1.1))
        with scene.nodes("disc"):
            x = pyro.sample("disc.x", dist.Uniform(16.0, 48.0))
        return scene.draw(Sprites.disc("disc", x, 32.0, radius=10.0), photo=photo)

    report = check_model(photographed, 64, 16)
    found = [text for text in report.warnings if "read as grey (channels=1), in which saturation, blue_gain" in text]
    assert not report.faults and len(found) == told
