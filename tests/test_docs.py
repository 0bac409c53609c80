"""The documentation's Python runs and prints what the pages say, and the options that it lists are those there are."""

import ast
import inspect
import json
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import typer

import probscene
from probscene.app.cli import app
from probscene.app.modules import import_file

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted((ROOT / "docs").rglob("*.md"))
RUN = [page for page in PAGES if "```python" in page.read_text(encoding="utf-8")]
COMMANDS = typer.main.get_command(app).commands


def text(name: str) -> str:
    return (ROOT / "docs" / name).read_text(encoding="utf-8")


# Numbers may differ from the page's, so that tests take fewer images and steps than a reader does.
FEWER = {
    "own_model.md": {
        '400, "hidden"': '60, "hidden"',
        '"features": "count"': '"features": "count", "features.width": "4,8,8", "pretrain.derivations": 100',
        '"features.schedule.steps": 300': '"features.schedule.steps": 16',
        '"structure.batches": 20': '"structure.batches": 2',
        '"structure.num_scenes": 100': '"structure.num_scenes": 20',
        "fit.generate(200,": "fit.generate(20,",
    },
    "own_generator.md": {
        '400, "hidden"': '60, "hidden"',
        '"features.schedule.steps": 300': '"features.schedule.steps": 16, "features.width": "4,8,8"',
        '"structure.batches": 20, "structure.num_scenes": 100': '"structure.batches": 2, "structure.num_scenes": 20',
        '"parameters=none", small': '"parameters=none", "pretrain.derivations=100", small',
        "fit.generate(200,": "fit.generate(20,",
        "evaluate(": "evaluate(num=100, ",
    },
    "first_fit.md": {
        '400, "hidden"': '60, "hidden"',
        '"features.schedule.steps": 300': '"features.schedule.steps": 8, "features.width": "4,8,8"',
        '"structure.batches": 20, "structure.num_scenes": 100': '"structure.batches": 1, "structure.num_scenes": 20',
        '"parameters=none", "struct': '"parameters=none", "pretrain.derivations=100", "struct',
        "num=500, scenes=100": "num=40, scenes=40",
        "fit.generate(100,": "fit.generate(10,",
    },
    "photographs_to_detector.md": {
        "range(200)}": "range(42)}",
        "in range(20)}": "in range(8)}",
        'ps.predict(detector, "photos"': 'ps.predict(detector, "photos/010.png"',
        "drawn/100.png": "drawn/010.png",
        '"features.schedule.steps": 300': '"features.schedule.steps": 8, "features.width": "4,8,8"',
        '"structure.batches": 20': '"pretrain.derivations": 100, "structure.batches": 1',
        '"structure.num_scenes": 100': '"structure.num_scenes": 20',
        "evaluate(": "evaluate(num=100, ",
        "generate=200, budget=ps.TrainingBudget(iterations=120)": (
            "generate=8, size=(64, 96), budget=ps.TrainingBudget(iterations=2)"
        ),
    },
    "streets.md": {
        "for model in streets.values()": 'for model in [streets["rural"]]',
        'streets["city"]': 'streets["rural"]',
        "model.prior, 500": "model.prior, 20",
    },
    "pyro.md": {
        "num_samples=500": "num_samples=50",
        "num_samples=40, warmup_steps=40": "num_samples=8, warmup_steps=8",
    },
}


@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize("page", RUN, ids=lambda page: page.stem)
def test_python_prints_what_the_page_says(page, tmp_path, monkeypatch, capsys, few_and_small_images):
    shorter = page.read_text(encoding="utf-8")
    for words, fewer in FEWER.get(page.name, {}).items():
        assert words in shorter
        shorter = shorter.replace(words, fewer)
    (tmp_path / page.name).write_text(shorter, encoding="utf-8")
    monkeypatch.setenv("PROBSCENE_CACHE", "")  # the script sets it
    monkeypatch.setattr(sys, "argv", ["run_page.py", str(tmp_path / page.name), "--check"])
    assert import_file(ROOT / "docs" / "run_page.py").main() == 0, capsys.readouterr().err


def test_the_script_that_does_so_says_where_they_differ(tmp_path):
    (tmp_path / "page.md").write_text('```python\nprint("one", 1)\n```\n\n```text\ntwo 2\n```\n')
    words = [sys.executable, ROOT / "docs" / "run_page.py", tmp_path / "page.md"]
    run = subprocess.run([*words, "--check"], capture_output=True, text=True)
    assert run.returncode == 1 and "-two #" in run.stderr and "+one #" in run.stderr
    assert subprocess.run(words).returncode == 0
    assert "```text\none 1\n```" in (tmp_path / "page.md").read_text()


def test_the_notebook_is_the_page():
    page, file = ROOT / "docs" / "tutorials" / "own_model.md", ROOT / "docs" / "tutorials" / "own_model.ipynb"
    made = import_file(ROOT / "docs" / "run_page.py").notebook(page)
    found = json.loads(file.read_text(encoding="utf-8"))
    assert found == made, "write it again: python docs/run_page.py docs/tutorials/own_model.md --notebook"
    code = ["".join(cell["source"]) for cell in found["cells"] if cell["cell_type"] == "code"]
    fences = re.findall(r"^```python(?: \S+)?\n(.*?)\n```$", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    opened = [source for source in code if source.startswith("from PIL import Image")]
    assert [
        source.partition("%%writefile tabletop.py\n")[2] or source for source in code if source not in opened
    ] == fences
    outputs = [output for cell in found["cells"] for output in cell.get("outputs", [])]
    assert sum("image/png" in output.get("data", {}) for output in outputs) == len(opened) == 2
    assert sum(output["output_type"] == "stream" for output in outputs) == page.read_text().count("```text")
    assert file.stat().st_size < 400_000


def test_every_command_has_a_section():
    assert set(re.findall(r"^## (\w+)$", text("reference/command_line.md"), re.MULTILINE)) == set(COMMANDS)


@pytest.mark.parametrize("name", COMMANDS)
def test_every_option_of_a_command_is_listed(name):
    section = re.search(rf"^## {name}$(.*?)(?=^## |\Z)", text("reference/command_line.md"), re.MULTILINE | re.DOTALL)[1]
    listed = set(re.findall(r"^\| `(--[\w-]+)", section, re.MULTILINE)) - {"--divergence", "--guide"}
    there = {option for parameter in COMMANDS[name].params for option in parameter.opts if option.startswith("--")}
    assert listed == there - {"--help", "--divergence", "--guide"}


def test_the_public_api_is_listed_whole():
    tables = re.findall(r"^\|.*\|$", text("reference/api/public.md"), re.MULTILINE)
    assert set(re.findall(r"`(\w+)`", " ".join(tables))) == set(probscene.__all__)


SHOWN = re.compile(r'^(?:srun |[ ]{4,}(?:.*--wrap ")?)probscene +(\w+ (?:[^"\n]|"[^"\n]*")*)', re.MULTILINE)


@pytest.mark.parametrize("page", [ROOT / "README.md", *PAGES], ids=lambda page: page.stem)
def test_commands_that_pages_show_have_these_options(page):
    shown = re.sub(r"\\\n\s*", "", page.read_text(encoding="utf-8"))
    for line in SHOWN.findall(shown):
        name, *words = shlex.split(line, comments=True)
        command = COMMANDS[name]
        command.make_parser(typer.Context(command)).parse_args(words)  # an option that is not there is an error


def test_no_python_is_only_shown():
    for page in PAGES:
        assert set(re.findall(r"^```(py\w*)", page.read_text(encoding="utf-8"), re.MULTILINE)) <= {"python"}, page


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_files_that_pages_name_are_there(page):
    found = page.read_text(encoding="utf-8")
    named = re.findall(r"\b(?:examples|benchmarks|inference|models|renderers|tests)/[\w/]+\.\w+", found)
    for name in named:
        assert (ROOT / name).is_file() or (ROOT / "docs" / name).is_file(), name
    for link in re.findall(r"\]\((?!https?:|#)([^)#\s]+)", found):
        assert (page.parent / link).is_file(), link


def test_tables_say_what_their_result_files_say():
    found = subprocess.run(
        [sys.executable, ROOT / "benchmarks" / "tables.py", "--check"], capture_output=True, text=True
    )
    assert found.returncode == 0, found.stdout + found.stderr


def test_the_page_on_extending_names_what_there_is():
    page = text("how_to/own_parts.md")
    named = dict(re.findall(r"`(own_\w+\.py):(\w+)`", page))
    assert {"own_renderer.py", *named} == {path.name for path in (ROOT / "examples").glob("own_*.py")}
    for file, name in named.items():
        tree = ast.parse((ROOT / "examples" / file).read_text(encoding="utf-8"))
        assert name in {node.name for node in tree.body if isinstance(node, ast.ClassDef | ast.FunctionDef)}, file
        assert f"examples/{file}:{name}" in ast.get_docstring(tree)
    rows = re.findall(r"^\| `(\w+)(?:\(([\w, ]+)\))?` \|", page.partition("| method | says |")[2], re.MULTILINE)
    for name, arguments in rows:
        there = getattr(probscene.Features, name)
        assert not arguments or list(inspect.signature(there).parameters) == ["self", *arguments.split(", ")]
    own = {name for name in vars(probscene.Features) if not name.startswith("_")}
    assert {name for name, _ in rows} == own
