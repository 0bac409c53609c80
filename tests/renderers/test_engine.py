"""Which engine there is, and how it starts: in silence, beside a user's own, and where nothing can be written."""

import os
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

from probscene.errors import MachineError, ProbsceneError
from probscene.renderers.engine_choice import engine_name, engine_version

ENGINE = """
import os, torch
from probscene.drawing import Drawing, Sprites, resolve
from probscene.errors import ProbsceneError
from probscene.renderers import engine
from probscene.renderers.sprites import SpriteRenderer
one = torch.ones(1, 1)
layer = resolve(Sprites.disc("a", 9 * one, 9 * one, 5 * one), one > 0)
drawing = Drawing(torch.zeros(1, 1, dtype=torch.int64), ("a",), (layer,))
renderer = SpriteRenderer((20, 20))
assert not engine.started()
def child(expected):
    pid = os.fork()
    if pid == 0:
        try:
            os._exit(0 if (renderer(drawing).pixels.item() > 0) is expected else 1)
        except ProbsceneError as error:
            os._exit(0 if not expected and "spawn" in str(error) else 1)
    assert os.waitpid(pid, 0)[1] == 0
"""

QUICK = {f"{prefix}_{option}": "0" for prefix in ("TI", "QD") for option in ("ADVANCED_OPTIMIZATION", "OPT_LEVEL")}
"""To compile, which is most of what some tests do."""


def _run(code, **environment):
    command = [sys.executable, "-W", "error", "-c", ENGINE + code]
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, **environment})
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture
def installed(monkeypatch):
    """Has no other engines installed than those named."""

    def only(*names):
        for name in {"taichi", "quadrants"} - {*names}:
            monkeypatch.setitem(sys.modules, name, None)

    monkeypatch.delenv("PROBSCENE_ENGINE", raising=False)
    return only


@pytest.mark.parametrize(
    ("named", "names", "expected"),
    [
        ("", ("taichi", "quadrants"), "taichi"),
        ("", ("quadrants",), "quadrants"),
        ("quadrants", ("taichi", "quadrants"), "quadrants"),
        ("taichi", ("taichi", "quadrants"), "taichi"),
    ],
)
def test_the_variable_chooses_or_what_is_installed(named, names, expected, installed, monkeypatch):
    installed(*names)
    monkeypatch.setenv("PROBSCENE_ENGINE", named)
    assert engine_name() == expected and engine_version() == f"{expected} {version(expected)}"


@pytest.mark.parametrize(
    ("named", "names", "kind", "message"),
    [
        ("Taichi", ("taichi",), ProbsceneError, "expected taichi or quadrants in the variable .*, got 'Taichi'; corr"),
        ("quadrants", ("taichi",), MachineError, "got none; pip install quadrants, or unset PROBSCENE_ENGINE."),
        ("", (), MachineError, "expected the package taichi or quadrants, .* got none; pip install taichi.$"),
    ],
)
def test_an_engine_that_is_not_there_is_named(named, names, kind, message, installed, monkeypatch):
    installed(*names)
    monkeypatch.setenv("PROBSCENE_ENGINE", named)
    with pytest.raises(kind, match=message):
        engine_name()


def test_it_starts_in_silence_in_the_process_that_renders():
    assert _run("child(True)\nrenderer(drawing)\nassert engine.started()\nchild(False)") == ""


def test_a_users_own_is_left_alone():
    code = """
engine.ti.init(arch=engine.ti.cpu, default_ip=engine.ti.i64, default_fp=engine.ti.f64, offline_cache=False)
field = engine.ti.field(engine.ti.i32, shape=3)
field[1] = 7
assert renderer(drawing).pixels.item() > 0 and field[1] == 7
"""
    assert "Starting" in _run(code)


def test_it_works_where_no_cache_can_be_written(tmp_path):
    (tmp_path / "file").touch()
    _run("renderer(drawing)", XDG_CACHE_HOME=str(tmp_path / "file"))


RENDERERS = Path(__file__).resolve().parents[2] / "renderers"
KERNELS = [path for path in RENDERERS.rglob("*.py") for _ in range(path.read_text().count("@ti.kernel"))]
EVERY_KERNEL = Path(__file__).with_name("every_kernel.py").read_text()


def test_a_second_process_compiles_nothing(tmp_path):
    """The engine finds a kernel of two real functions only where they happen to have the same order of addresses."""
    folder, compiled = tmp_path / engine_name(), []
    for _ in range(2):
        called = _run(EVERY_KERNEL, PROBSCENE_CACHE=str(tmp_path), **QUICK).strip().split(",")
        compiled.append(sorted(path.name for path in folder.rglob("T*.*")))
        assert all(" " not in names for names in called), called
    assert len(compiled[0]) == len(set(compiled[0])) >= len(KERNELS) and compiled[0] == compiled[1]
