"""The command line: what it does, and that whatever goes wrong says so in one line and leaves nothing half-written."""

import errno
import itertools
import json
import os
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import typer
from PIL import Image

import probscene
from probscene.app.cli.options import PresetName
from probscene.app.fitting import pipeline as fit
from probscene.app.fitting.config import DIVERGENCES
from probscene.app.fitting.presets import PRESETS, QUICK
from probscene.app.versions import versions_record
from probscene.errors import ProbsceneError
from probscene.inference.guides.lstm import GUIDES

from .conftest import COMMANDS, check_fault, copied

ROOT = Path(__file__).resolve().parents[2]


def test_help_is_quick_because_it_imports_nothing_heavy():
    program = (
        "import sys\nfrom probscene.app.cli import main\nsys.argv = ['probscene', 'fit', '--help']\n"
        "try:\n    main()\nexcept SystemExit:\n    pass\n"
        "heavy = {'torch', 'pyro', 'taichi', 'quadrants', 'numpy', 'cv2', 'scipy', 'matplotlib'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    run = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    assert "--skip-bad" in run.stdout


def test_it_can_be_called_as_a_module():
    run = subprocess.run([sys.executable, "-m", "probscene", "version"], cwd=ROOT, capture_output=True, text=True)
    assert (run.returncode, run.stdout.strip()) == (0, f"probscene {probscene.__version__}"), run.stderr


def test_an_unknown_engine_is_named_in_one_line():
    command, environment = [sys.executable, "-m", "probscene", "check"], {**os.environ, "PROBSCENE_ENGINE": "warp"}
    run = subprocess.run([*command, "multi_mnist"], cwd=ROOT, capture_output=True, text=True, env=environment)
    check_fault(SimpleNamespace(code=run.returncode, err=run.stderr), 2, "expected taichi or quadrants", "got 'warp'")


def test_version_and_help(call):
    assert call("version").out == f"probscene {probscene.__version__}\n"
    commands = ("check", "preview", "fit", "generate", "evaluate", "report", "compare", "demo", "version")
    assert all(f"\n  {command} " in call("--help").out for command in commands)


@pytest.mark.parametrize("name", COMMANDS)
def test_help_fits_two_screens_and_options_two_lines(name):
    lines = COMMANDS[name].get_help(typer.Context(COMMANDS[name], terminal_width=100)).splitlines()
    assert len(lines) <= 80 and all(len(line) <= 100 for line in lines)
    beginnings = [i for i, line in enumerate(lines) if not line.startswith("   ")]  # a third line is indented, too
    assert max(after - before for before, after in itertools.pairwise([*beginnings, len(lines)])) <= 2


def test_many_options_stand_under_headings_and_few_under_one(call):
    found = {name: re.findall(r"^(\w[\w ]*):$", call(name, "--help").out, re.MULTILINE) for name in ("fit", "preview")}
    assert found == {
        "fit": ["Arguments", "Options", "Method", "Images", "Computing"],
        "preview": ["Arguments", "Options"],
    }


def test_commands_name_the_next_one(call, discs, fitted, target, tmp_path):
    for words, after in (
        (["check", discs.file], "preview"),
        (["preview", discs.file, "--out", tmp_path / "p.png", "--num", 1], "fit"),
        (["preview", fitted, "--out", tmp_path / "p.png", "--num", 1], "generate"),
        (["fit", "--resume", "--out", fitted], "report"),
        (["generate", fitted, "--num", 1, "--out", tmp_path / "d"], "train"),
        (["generate", fitted, "--num", 2, "--out", tmp_path / "e", "--shard", "0/2"], "the same command without"),
        (["evaluate", fitted, "--target", target.images, "--labels", target.labels, "--scenes", 0], "report"),
    ):
        said = call(*words).out.splitlines()[-1]
        assert said.removeprefix("Next: ").removeprefix("probscene ").startswith(after)


def test_presets_are_those_of_the_library():
    assert [str(name) for name in PresetName] == list(PRESETS)
    assert {QUICK.set(f"divergence={name}").divergence_name for name in DIVERGENCES} == set(DIVERGENCES)
    assert {QUICK.set(f"guide={name}").guide.kind for name in GUIDES} == set(GUIDES)


def test_check_says_what_a_person_should_know(call, discs):
    result = call("check", discs.file)
    assert result.code == 0 and "Every derivation ends" in result.out


def test_preview_of_a_prior_and_of_a_run(call, discs, fitted, tmp_path):
    for what in (discs.file, fitted):
        out = tmp_path / "new" / f"{what.stem}.png"
        assert call("preview", what, "--out", out, "--num", 5, "--boxes").code == 0
        first = out.read_bytes()
        with Image.open(out) as picture:
            assert picture.size == (3 * 66 + 2, 2 * 66 + 2)
        call("preview", what, "--out", out, "--num", 5, "--boxes")
        assert out.read_bytes() == first
        call("preview", what, "--out", out, "--num", 5, "--boxes", "--seed", 1)
        assert out.read_bytes() != first


def test_a_fit_leaves_a_run_that_says_how_it_was_made(fitted, discs, target, call):
    record = json.loads((fitted / "run.json").read_text())
    features = record["config"]["features"]
    assert features["schedule"]["steps"] == 48 and features["width"] == [4, 8, 8]
    assert record["seed"] == 0 and record["target"] == str(target.images) and record["model"] == str(discs.file)
    assert record == record | versions_record()
    log = [json.loads(line) for line in (fitted / "log.jsonl").read_text().splitlines()]
    assert [line.get("step", line.get("batch")) for line in log] == [16, 32, 48, 1, 2, 3, 4]
    assert set(json.loads((fitted / "timing.json").read_text())) >= {"reading", "features", "target", "structure"}
    again = call("fit", "--resume", "--out", fitted)
    assert again.code == 0 and again.err == ""


def test_generate_and_its_refusal_of_another_seed(call, fitted, tmp_path):
    first = call("generate", fitted, "--num", 3, "--out", tmp_path / "d")
    assert first.code == 0 and "3 images" in first.out
    assert len(list((tmp_path / "d" / "images").iterdir())) == 3
    check_fault(call("generate", fitted, "--num", 3, "--out", tmp_path / "d", "--seed", 1), 2, "seed 0", "seed 1")


# What is wrong with the model.

GOOD = (Path(__file__).with_name("discs.py")).read_text(encoding="utf-8")
MODELS = {
    "syntax": ("def f(:\n", "does not import: SyntaxError"),
    "import": ("import nothing_of_this_name\n", "ModuleNotFoundError"),
    "raises": ("1 / 0\n", "ZeroDivisionError"),
    "none": ("x = 1\n", "got none"),
    "two": (GOOD + "\nOTHER = target(1)\nMODEL2 = MODEL\ndel MODEL\n", "to export one SceneModel"),
    "undefined": (GOOD.replace("red | blue\n", "red | Blue\n"), "Undefined nonterminal: Blue"),
    "unreachable": (GOOD.replace("| blue\n", "| blue\n    Lost -> lost\n", 1), "Unreachable nonterminal: Lost"),
    "duplicate": (GOOD.replace("red | blue\n", "red | blue | red\n"), "Duplicate production"),
    "never ends": (GOOD.replace("Disc Discs | ε", "Disc Discs"), "can never end"),
    "need not end": (GOOD.replace("Discs=counts(*discs)", "Discs=weights(1, 0)"), "need not terminate"),
    "too long": (GOOD.replace("(64, 64), 12,", "(64, 64), 1,"), "max_steps = 1 is too short"),
}


@pytest.mark.parametrize("fault", MODELS)
def test_bad_models(fault, call, target, tmp_path):
    text, part = MODELS[fault]
    (tmp_path / "m.py").write_text(text, encoding="utf-8")
    check_fault(call("fit", tmp_path / "m.py", "--target", target.images, "--out", tmp_path / "run"), 2, part)
    assert not (tmp_path / "run").exists()
    checked = call("check", tmp_path / "m.py")
    check_fault(checked, 2)
    assert part in checked.out + checked.err


def test_a_model_that_is_not_there(call, tmp_path):
    check_fault(call("check", "nothing"), 2, "multi_mnist", "'nothing'")
    check_fault(call("preview", tmp_path / "m.py", "--out", tmp_path / "g.png"), 2, "which is not there")
    assert not (tmp_path / "g.png").exists()


# What is wrong with the run.


def test_runs_that_cannot_be_read(call, fitted, target, tmp_path):
    def commands(run):
        yield "preview", run, "--out", tmp_path / "out"
        yield "generate", run, "--num", 1, "--out", tmp_path / "out"
        yield "evaluate", run, "--target", target.images, "--json", tmp_path / "out"
        yield "report", run, "--out", tmp_path / "out"
        yield "fit", "--resume", "--out", run

    record = json.loads((fitted / "run.json").read_text())
    runs = {
        "other": (json.dumps(record | {"format": 0, "version": "0.0.1"}), "another version of probscene (0.0.1)"),
        "damaged": ("{", "got something else"),
    }
    for name, (text, part) in runs.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "run.json").write_text(text)
        for words in commands(tmp_path / name):
            check_fault(call(*words), 2, part)
    unfinished = tmp_path / "unfinished"
    unfinished.mkdir()
    (unfinished / "run.json").write_text(json.dumps(record))
    for words in list(commands(unfinished))[:-1]:
        check_fault(call(*words), 2, "--resume")
    for words in list(commands(tmp_path / "gone"))[1:]:
        check_fault(call(*words), 2, "run.json")
    assert not (tmp_path / "out").exists()


def test_a_fit_takes_no_folder_that_holds_something(call, discs, fitted, target, tmp_path):
    words = ["fit", discs.file, "--target", target.images, "--out"]
    check_fault(call(*words, fitted), 2, "--resume")
    (tmp_path / "kept.txt").write_text("mine")
    check_fault(call(*words, tmp_path), 2, "other files")
    check_fault(call(*words, tmp_path / "kept.txt"), 2, "is a file")
    check_fault(call(*words, tmp_path / "kept.txt" / "run"), 2, "a file in the way")
    assert [file.name for file in tmp_path.iterdir()] == ["kept.txt"]


def test_resume_takes_the_settings_of_the_run_or_none(call, discs, fitted, target, tmp_path):
    words = ["fit", "--resume", "--out", fitted]
    same = [discs.file, "--target", target.images, *discs.settings, "--seed", 0]
    assert call(*words, *same).code == 0
    for other, *parts in (
        (["multi_mnist"], "expected the model"),
        (["--target", tmp_path], "expected PNG, JPEG or TIFF images in", "an empty folder"),
        (["--seed", 1], "(0), got 1"),
        (["--threads", 7], "threads"),
        (["--skip-bad"], "skip_bad"),
        ([*discs.settings, "--set", "structure.batches=5"], "batches", "(4), got 5"),
        ([*discs.settings, "--divergence", "mmd"], "the divergence.kind", "(KDELogRatio), got MMD"),
        ([*discs.settings, "--guide", "pcfg"], "the guide.kind", "(LSTMConfig), got PCFGConfig"),
    ):
        check_fault(call(*words, *other), 2, *parts)


def test_numbers_out_of_range(call, discs, fitted, target, tmp_path):
    out = tmp_path / "out"
    for number in (0, -1):
        check_fault(call("generate", fitted, "--num", number, "--out", out), 2, "positive number of images")
        check_fault(call("generate", fitted, "--num", 1, "--workers", number, "--out", out), 2, "workers")
        check_fault(call("preview", discs.file, "--num", number, "--out", out), 2, "positive number of images")
        check_fault(
            call("evaluate", fitted, "--target", target.images, "--num", number), 2, "positive number of scenes"
        )
        fitting = ["fit", discs.file, "--target", target.images, "--out", out]
        check_fault(call(*fitting, "--threads", number), 2, "threads")
    check_fault(call(*fitting, "--seed", -1), 2, "seed of 0 or more")
    check_fault(call("generate", fitted, "--num", 1, "--out", out, "--format", "voc"), 2, "'voc'")
    check_fault(call("fit", "--out", out), 2, "expected a model and target images (MODEL and --target DIR)")
    assert not out.exists()


def test_what_typer_refuses_exits_with_2(call, discs, tmp_path):
    for words in (["fit", discs.file], ["nothing"], ["generate", "r", "--num", "many", "--out", "d"],
                  ["fit", discs.file, "--target", "t", "--out", "r", "--preset", "slow"]):  # fmt: skip
        result = call(*words)
        assert result.code == 2 and "Usage" in result.err and "Traceback" not in result.err


@pytest.mark.parametrize(
    "setting, part",
    [
        ("batches", "key=value"),
        ("structure.batches=x", "structure.batches=<int>"),
        ("speed=1", "among features,"),
        ("features.width=1,2", "features.width="),
        ("features=count=3", "among count,"),
        ("features.schedule.speed=1", "CountSchedule) among steps"),
        ("structure.batches.x=1", "no setting of structure.batches"),
        ("structure.cosine=5", "structure.cosine=<bool>"),
        ("features.schedule.steps=1.5", "features.schedule.steps=<int>"),
        ("structure.num_scenes=1", "at least 2"),
        ("structure.batches=-1", "at least 0"),
        ("structure.learning_rate=0", "above 0"),
        ("features.schedule.whole=-1", "at least 0"),
        ("divergence.variance=nan", "above 0"),
        ("divergence=kl", "kde, js"),
        ("guide=hmm", "lstm, pcfg"),
        ("structure.num_scenes=none", "structure.num_scenes=<int>"),
    ],
)
def test_wrong_settings(setting, part, call, discs, target, tmp_path):
    words = ["fit", discs.file, "--target", target.images, "--out", tmp_path / "run", "--set", setting]
    check_fault(call(*words), 2, part)
    assert not (tmp_path / "run").exists()


def test_settings_change_what_they_name_and_nothing_else():
    before = QUICK.for_renders()
    settings = {
        "structure.batches": 2,
        "features.schedule.steps": 32,
        "features.width": (8, 16, 32),
        "divergence.variance": None,
        "structure.cosine": False,
        "structure.learning_rate": 1e-3,
    }
    changed = before.set(settings)
    found = changed.flat()
    assert {key: tuple(found[key]) if isinstance(found[key], list) else found[key] for key in settings} == settings
    assert changed.set({key: before.flat()[key] for key in settings}) == before
    with pytest.raises(ProbsceneError):
        QUICK.set("=1")


def test_another_target_is_refused_on_resuming(call, discs, target, tmp_path, monkeypatch):
    folder, out = copied(target, tmp_path / "images", 40), tmp_path / "run"

    def interrupt(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(fit, "learn_structure", interrupt)
        call("fit", discs.file, "--target", folder, "--out", out, *discs.settings)
    (folder / "000000.png").unlink()
    check_fault(call("fit", "--resume", "--out", out), 2, "as they were when the run began")


# What is wrong with the machine.


def test_a_full_disk(call, discs, fitted, target, tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    before = {file: file.read_bytes() for file in fitted.iterdir()}
    monkeypatch.setattr(os, "fsync", full)
    out = tmp_path / "out"
    for words in (
        ("preview", discs.file, "--out", out),
        ("evaluate", fitted, "--target", target.images, "--num", 100, "--json", out),
        ("report", fitted, "--num", 100),
        ("fit", discs.file, "--target", target.images, "--out", tmp_path / "run", *discs.settings),
    ):
        check_fault(call(*words), 1, "The disk is full")
        assert not out.exists()
    assert list((tmp_path / "run").iterdir()) == []
    assert {file: file.read_bytes() for file in fitted.iterdir()} == before


def test_an_output_that_cannot_be_written(call, discs, fitted, target, tmp_path):
    nowhere = Path("/proc/nowhere")
    check_fault(call("fit", discs.file, "--target", target.images, "--out", nowhere, *discs.settings), 1, str(nowhere))
    check_fault(call("generate", fitted, "--num", 1, "--out", nowhere), 1, str(nowhere))
    check_fault(call("preview", discs.file, "--out", nowhere / "g.png"), 1, str(nowhere))
    check_fault(call("preview", discs.file, "--out", tmp_path), 2, "name a file in it")


def test_a_bug_is_one_line_and_a_traceback_on_demand(call, discs, tmp_path, monkeypatch):
    monkeypatch.delenv("PROBSCENE_DEBUG", raising=False)
    monkeypatch.setattr("probscene.app.views.preview.grid", lambda images: 1 / 0)
    words = ["preview", discs.file, "--out", tmp_path / "g.png"]
    check_fault(call(*words), 1, "A bug in probscene: ZeroDivisionError: division by zero", "--debug preview")
    for debugging in (["--debug", *words], words):
        result = call(*debugging)
        assert result.code == 1 and "probscene: " not in result.err
        monkeypatch.setenv("PROBSCENE_DEBUG", "1")
