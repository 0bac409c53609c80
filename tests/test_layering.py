"""The layers: who imports whom, what is installed, what no file may name."""

import ast
import importlib
import json
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest
from packaging.requirements import Requirement

import probscene

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = {
    "probscene": ROOT / "probscene",
    "probscene.models": ROOT / "models",
    "probscene.renderers": ROOT / "renderers",
    "probscene.inference": ROOT / "inference",
}
ENGINE = "probscene.renderers.engine"
PAIR = {"torch": "2.14.1", "torchvision": "0.29.1"}


def library() -> dict[str, Path]:
    """Every module of the library by its installed name."""
    modules = {}
    for package, folder in PACKAGES.items():
        for path in folder.rglob("*.py"):
            parts = [p for p in path.relative_to(folder).with_suffix("").parts if p != "__init__"]
            modules[".".join([package, *parts])] = path
    return modules


def imported(path: Path, package: str = "", type_checking: bool = False) -> set[str]:
    """Dotted names that a file imports anywhere in it; ``from a import b`` counts as ``a.b``.

    Args:
        package: the installed name of the package that the file is in, from which its relative imports count.
        type_checking: whether imports for type checkers alone count, too.
    """
    names, todo = set(), [ast.parse(path.read_text(encoding="utf-8"))]
    while todo:
        node = todo.pop()
        if isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING"):
            todo += ast.iter_child_nodes(node) if type_checking else node.orelse
        elif isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                stem = ".".join(package.split(".")[: len(package.split(".")) - node.level + 1])
                base = f"{stem}.{base}".rstrip(".")
            names |= {f"{base}.{alias.name}" for alias in node.names}
        else:
            todo += ast.iter_child_nodes(node)
    return names


def graph(type_checking: bool = False) -> dict[str, set[str]]:
    """The library's modules, each with those that it imports; see ``imported``."""
    modules = library()

    def module(name):
        while name and name not in modules:
            name = name.rpartition(".")[0]
        return name

    return {
        name: {module(x) for x in imported(path, package_of(name, path), type_checking)} - {"", name}
        for name, path in modules.items()
    }


def package_of(module: str, path: Path) -> str:
    """The package that a module's relative imports count from."""
    return module if path.name == "__init__.py" else module.rpartition(".")[0]


def layer(module: str) -> str:
    """The package that a module belongs to: the application, models, renderers, inference, or the core."""
    packages = [package for package in ("probscene.app", *PACKAGES) if f"{module}.".startswith(f"{package}.")]
    return max(packages, key=len)


def circle(graph: dict[str, set[str]]) -> list[str]:
    """A circle of a graph; empty where there is none."""
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return error.args[1]
    return []


def without_entry_points(graph: dict[str, set[str]]) -> dict[str, set[str]]:
    """Without the public API, which names all layers, and the start of the command line."""
    entry_points = {"probscene", "probscene.__main__"}
    return {name: used - entry_points for name, used in graph.items() if name not in entry_points}


def test_no_circle_of_files():
    assert not circle(graph())
    assert not circle(without_entry_points(graph(type_checking=True)))


def test_no_circle_of_folders():
    """A folder and its subfolders are two."""
    modules, folders = library(), {}
    for name, used in without_entry_points(graph()).items():
        folder = modules[name].parent
        folders.setdefault(folder, set()).update({modules[one].parent for one in used} - {folder})
    assert not circle(folders)


def test_imports_only_go_down():
    for module, uses in graph().items():
        is_top = layer(module) == "probscene.app" or module == "probscene.__main__"  # which starts the command line
        allowed = {"probscene.app", *PACKAGES} if is_top else {"probscene", layer(module)}
        assert {layer(used) for used in uses} <= allowed, module


def test_imports_inside_a_folder_are_relative_and_all_others_are_not():
    """So an editor follows them, though the folders are installed under another name than they have here."""
    for module, path in library().items():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.level:
                stem = package_of(module, path).split(".")
                assert layer(".".join(stem[: len(stem) - node.level + 1])) == layer(module), (module, ast.unparse(node))
            elif isinstance(node, ast.ImportFrom) and node.module.split(".")[0] == "probscene":
                names = {f"{node.module}.{alias.name}" for alias in node.names} - {"probscene.__version__"}
                assert layer(module) not in {layer(name) for name in names}, (module, ast.unparse(node))
            elif isinstance(node, ast.Import | ast.ImportFrom):
                first = {alias.name for alias in node.names} if isinstance(node, ast.Import) else {node.module}
                assert not {name.split(".")[0] for name in first} & {"models", "renderers", "inference"}, module


def test_benchmarks_import_what_there_is():
    modules = library()
    for path in (ROOT / "benchmarks").glob("*.py"):
        for name in imported(path):
            package, _, member = name.rpartition(".")
            if name.split(".")[0] == "probscene" and name not in modules:
                found = package in modules and hasattr(importlib.import_module(package), member)
                assert found, f"{path.name} imports {name}"


def test_only_the_engine_imports_taichi_or_quadrants():
    files = [
        path
        for folder in (*PACKAGES.values(), ROOT / "tests", ROOT / "examples", ROOT / "benchmarks")
        for path in folder.rglob("*.py")
    ]
    engines = {"taichi", "quadrants"}
    importers = {path for path in files if any(name.split(".")[0] in engines for name in imported(path))}
    assert importers <= {library().get(ENGINE)}


def tidy_codes(filename: str, source: str) -> set[str]:
    """Which of ruff's import rules (TID) a source breaks as if it stood in that file."""
    run = subprocess.run(
        [sys.executable, "-m", "ruff", "check", "--output-format", "json", "--stdin-filename", filename, "-"],
        cwd=ROOT, input=source, capture_output=True, text=True,
    )  # fmt: skip
    assert run.returncode in (0, 1), run.stderr
    return {fault["code"] for fault in json.loads(run.stdout) if fault["code"].startswith("TID")}


WRONG = {
    "probscene/x.py": [
        "import taichi as ti", "import quadrants as ti", "import torchvision",
        "from torchvision.models import resnet18", "import probscene.models.multi_mnist",
        "from probscene.renderers.engine import render",
        "from probscene.inference import features", "from probscene import models",
        "from probscene.app.cli import main", "from probscene import app", "def f():\n    import probscene.app.cli",
    ],
    "models/x.py": [
        "import taichi", "import quadrants", "from probscene.renderers.engine import render",
        "import probscene.inference.lstm", "from probscene import renderers", "from probscene.app.cli import main",
    ],
    "renderers/x.py": [
        "import taichi", "from taichi import kernel", "import quadrants", "import pyro\n\npyro.sample('x', None)",
        "from pyro import sample", "from probscene.models.multi_mnist import MODEL", "import probscene.inference.lstm",
        "from probscene.app.cli import main",
    ],
    "inference/x.py": [
        "import taichi", "import quadrants", "from probscene.models.multi_mnist import MODEL",
        "import probscene.renderers.engine", "from probscene.app.cli import main",
    ],
    "probscene/app/x.py": ["import taichi", "import quadrants"],
    "tests/x.py": ["import taichi", "import quadrants"],
    "examples/x.py": ["import taichi", "import quadrants"],
    "benchmarks/x.py": ["import taichi", "import quadrants"],
}  # fmt: skip
EVERYWHERE = ["import models.multi_mnist", "from renderers.engine import render", "from inference import lstm",
              "import examples.tabletop", "from tests.reference import parse", "import benchmarks.render"]  # fmt: skip

RIGHT = {
    "probscene/x.py": "import pyro\nimport torch\n\nfrom probscene.grammar import Grammar\n\npyro.sample('x', None)\n",
    "models/x.py": "import pyro\n\nfrom probscene.grammar import Grammar\nfrom probscene.models.y import z\n",
    "renderers/x.py": "import numpy\n\nfrom probscene.drawing import Drawing\nimport probscene.renderers.engine\n",
    "renderers/engine.py": "import quadrants\nimport taichi as ti\n\nfrom probscene.drawing import Drawing\n",
    "inference/x.py": "import torchvision\n\nfrom probscene.policy import Policy\nimport probscene.inference.y\n",
    "probscene/app/x.py": "import probscene.inference.y\nimport probscene.models.y\nimport probscene.renderers.y\n",
    "tests/x.py": "import probscene.app.cli\nimport probscene.inference.y\nimport probscene.renderers.engine\n",
    "examples/x.py": "import probscene.inference.y\nimport probscene.models.y\nimport probscene.renderers.engine\n",
}


@pytest.mark.parametrize("filename", WRONG)
def test_lint_catches_a_wrong_import(filename):
    own = filename.split("/")[0]  # ruff takes "from .y import z" for that; see the test of relative imports
    for source in WRONG[filename] + [source for source in EVERYWHERE if own not in source]:
        assert tidy_codes(filename, source + "\n") == {"TID251"}, source


@pytest.mark.parametrize("filename", RIGHT)
def test_lint_lets_a_right_import_pass(filename):
    assert tidy_codes(filename, RIGHT[filename]) == set()


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """The wheel, built by way of the sdist from a copy of the sources, without the network."""
    tmp = tmp_path_factory.mktemp("wheel")
    for folder in PACKAGES.values():
        shutil.copytree(folder, tmp / "src" / folder.name, ignore=shutil.ignore_patterns("__pycache__", ".*"))
    for name in ("pyproject.toml", "MANIFEST.in", "README.md", "LICENSE"):
        if (ROOT / name).exists():
            shutil.copy(ROOT / name, tmp / "src")
    subprocess.run(
        [sys.executable, "-m", "build", "--no-isolation", "--outdir", tmp / "dist", tmp / "src"],
        check=True, capture_output=True, text=True,
    )  # fmt: skip
    (built,) = (tmp / "dist").glob("*.whl")
    return built


def test_wheel_holds_the_whole_library_under_one_name(wheel):
    assert wheel.name == f"probscene-{probscene.__version__}-py3-none-any.whl"
    names = zipfile.ZipFile(wheel).namelist()
    info = f"probscene-{probscene.__version__}.dist-info"
    assert {name.split("/")[0] for name in names} == {"probscene", info}
    expected = set()
    for package, folder in PACKAGES.items():
        files = [p.relative_to(folder) for p in folder.rglob("*") if p.is_file() and p.name != "ruff.toml"]
        kept = [p for p in files if "__pycache__" not in p.parts and not p.parts[0].startswith(".")]
        expected |= {f"{package.replace('.', '/')}/{p.as_posix()}" for p in kept}
    assert {name for name in names if not name.startswith(info)} == expected


def test_installed_wheel_imports_away_from_the_checkout(wheel, tmp_path):
    site = tmp_path / "site"
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--disable-pip-version-check"]
    subprocess.run([*pip, "--target", site, wheel], check=True, capture_output=True)
    program = (
        "import importlib, sys\n"
        "sys.path.insert(0, sys.argv[1])\n"
        "for name in sys.argv[2:]:\n"
        "    assert importlib.import_module(name).__file__.startswith(sys.argv[1]), name\n"
    )
    run = subprocess.run([sys.executable, "-I", "-c", program, site, "probscene.app", *PACKAGES], cwd="/",
                         capture_output=True, text=True)  # fmt: skip
    assert run.returncode == 0, run.stderr


def tracked() -> list[Path]:
    run = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True)
    if run.returncode:
        pytest.skip("not a git checkout")
    return [path for name in run.stdout.split("\0") if name and (path := ROOT / name).is_file()]


def test_no_tracked_file_names_a_registry_or_a_home():
    named = re.compile(
        rb"pypi\.org|python[h]osted|download\.pytorch\.org|npmjs\.|anaconda\.org|crates\.io|deb\.debian\.|--(extra-)?index-url"
        rb"|(?<![\w.])/(root|home|Users)/\w"
    )
    for path in tracked():
        assert not (found := named.search(path.read_bytes())), f"{path.relative_to(ROOT)} names {found[0]!r}"


def test_builds_for_the_cpu_alone_satisfy_requirements_and_pins():
    required = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["dependencies"]
    for line in [*required, *(ROOT / "constraints.txt").read_text().splitlines()[1:]]:
        one = Requirement(line)
        if one.name in PAIR:
            assert one.specifier.contains(f"{PAIR[one.name]}+cpu"), line
    command = " ".join(["pip install", *(f"{name}=={version}+cpu" for name, version in PAIR.items())])
    assert all(command in (ROOT / file).read_text(encoding="utf-8") for file in ("README.md", "docs/start/install.md"))


def test_constraints_only_pin():
    lines = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if not line.startswith("#")]
    assert all(re.fullmatch(r"[\w.-]+==[\w.]+", line) for line in lines)
    assert {f"{name}=={version}" for name, version in PAIR.items()} <= set(lines)
