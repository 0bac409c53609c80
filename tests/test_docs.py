"""The documentation's Python runs and prints what the pages say, and the options that it lists are those there are."""

import ast
import inspect
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import typer

import probscene
from probscene.app.cli import app

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted((ROOT / "docs").rglob("*.md"))
RUN = [page for page in PAGES if "```python" in page.read_text(encoding="utf-8")]
COMMANDS = typer.main.get_command(app).commands


def text(name: str) -> str:
    return (ROOT / "docs" / name).read_text(encoding="utf-8")


@pytest.mark.parametrize(
    "page", [page for page in PAGES if "```python" in page.read_text()], ids=lambda page: page.stem
)
def test_python_prints_what_the_page_says(page):
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    run = subprocess.run([sys.executable, ROOT / "docs" / "run_page.py", page, "--check"],
                         env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True)  # fmt: skip
    assert run.returncode == 0, run.stderr


def test_every_command_has_a_section():
    assert set(re.findall(r"^## (\w+)$", text("command_line.md"), re.MULTILINE)) == set(COMMANDS)


@pytest.mark.parametrize("name", COMMANDS)
def test_every_option_of_a_command_is_listed(name):
    section = re.search(rf"^## {name}$(.*?)(?=^## |\Z)", text("command_line.md"), re.MULTILINE | re.DOTALL)[1]
    listed = set(re.findall(r"^\| `(--[\w-]+)", section, re.MULTILINE)) - {"--objective", "--guide"}
    there = {option for parameter in COMMANDS[name].params for option in parameter.opts if option.startswith("--")}
    assert listed == there - {"--help", "--objective", "--guide"}


def test_the_public_api_is_listed_whole():
    tables = re.findall(r"^\|.*\|$", text("api/public.md"), re.MULTILINE)
    assert set(re.findall(r"`(\w+)`", " ".join(tables))) == set(probscene.__all__)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_files_that_pages_name_are_there(page):
    found = page.read_text(encoding="utf-8")
    named = re.findall(r"\b(?:examples|benchmarks|inference|models|renderers|tests)/[\w/]+\.\w+", found)
    for name in [*named, *re.findall(r"\]\(\.\./([^)#]+)", found)]:
        assert (ROOT / name).is_file() or (ROOT / "docs" / name).is_file(), name


def test_tables_say_what_their_result_files_say():
    found = subprocess.run(
        [sys.executable, ROOT / "benchmarks" / "tables.py", "--check"], capture_output=True, text=True
    )
    assert found.returncode == 0, found.stdout + found.stderr


def test_the_page_on_extending_names_what_there_is():
    page = text("extending.md")
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
