"""What only some systems have is never taken for granted: without it the library does the same work, to the byte."""

import ast
import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest

import probscene
from probscene.app.datasets.generate import generate_scenes
from probscene.app.files import machine_error
from probscene.app.loading import load_model
from probscene.cache import cache_folder
from probscene.dataset import ImageFolder
from probscene.threads import cores, default_threads

ROOT = Path(__file__).resolve().parents[2]
LIBRARY = [
    file for folder in ("probscene", "models", "renderers", "inference") for file in (ROOT / folder).rglob("*.py")
]
ABSENT = {  # on Windows or on macOS
    "os": (
        "sched_getaffinity", "link", "symlink", "fork", "forkpty", "register_at_fork", "fchmod", "fchown", "chown",
        "killpg", "getuid", "geteuid", "getpgid", "setsid", "sysconf", "statvfs", "getloadavg", "mkfifo", "nice",
        "sync", "fdatasync", "posix_fallocate", "wait3", "wait4",
    ),
    "signal": (
        "pthread_sigmask", "sigwait", "sigtimedwait", "alarm", "setitimer", "SIGKILL", "SIGHUP", "SIGQUIT", "SIGUSR1",
        "SIGUSR2", "SIGALRM", "SIGCHLD", "SIGPIPE",
    ),
    "errno": ("EDQUOT",),
}  # fmt: skip
MODULES = {"fcntl", "resource", "pwd", "grp", "termios", "tty", "pty", "posix", "syslog"}

SCRIPT = """
import errno, os, signal, sys

import cv2, rich.progress, torch
from multiprocessing import resource_tracker

resource_tracker.ensure_running()  # Python's own on this system needs some of the names

for module, names in ABSENT.items():
    for name in names:
        delattr(globals()[module], name)

from pathlib import Path

from probscene.app.datasets.generate import generate_scenes
from probscene.app.workers.processes import spread
from probscene.app.files import machine_error
from probscene.app.loading import load_model
from probscene.dataset import ImageFolder

def prepare(factor):
    return lambda task: factor * task

if __name__ == "__main__":
    model, out = load_model(sys.argv[1]), Path(sys.argv[2])
    generate_scenes(model, model.prior, 5, out, format="coco,yolo,kitti")
    folder = ImageFolder(out / "images", model.canvas, model.channels)
    print(len(folder), folder.fingerprint, folder.load(0).sum().item())
    done = []
    spread(prepare, (3,), 1, [1, 2], done.append)
    print(sorted(done), machine_error(OSError(errno.ENOSPC, ""), Path("out")))
"""


def test_the_same_bytes_where_names_are_absent(tmp_path):
    """As here, where they are not."""
    here, there, script = tmp_path / "here", tmp_path / "there", tmp_path / "script.py"
    script.write_text(f"ABSENT = {ABSENT!r}\n{SCRIPT}", encoding="utf-8")
    discs = ROOT / "tests" / "app" / "discs.py"
    run = subprocess.run(
        [sys.executable, script, discs, there],
        env={**os.environ, "PYTHONPATH": str(Path(probscene.__file__).parents[1])}, capture_output=True, text=True,
    )  # fmt: skip
    assert run.returncode == 0, run.stderr
    model = load_model(str(discs))
    generate_scenes(model, model.prior, 5, here, format="coco,yolo,kitti")
    names = [{file.relative_to(out) for file in out.rglob("*") if file.is_file()} for out in (here, there)]
    assert names[0] == names[1] and len(names[0]) > 5
    assert all((here / name).read_bytes() == (there / name).read_bytes() for name in names[0])
    folder = ImageFolder(here / "images", model.canvas, model.channels)
    first, second = run.stdout.splitlines()
    assert first == f"{len(folder)} {folder.fingerprint} {folder.load(0).sum().item()}"
    assert second.startswith(f"[3, 6] {machine_error(OSError(errno.ENOSPC, ''), Path('out'))}")
    assert "The disk is full" in second and (here / "images").stat().st_mode == (there / "images").stat().st_mode


def asks(node: ast.AST, name: str) -> bool:
    """Whether a statement is ``if hasattr(module, name)``, or ``if not``."""
    return isinstance(node, ast.If) and f", '{name}')" in ast.unparse(node.test)


def guarded(node: ast.AST, above: dict[ast.AST, ast.AST], name: str) -> bool:
    """Whether a statement that asks for the name encloses a node, or returns before it."""
    while node in above:
        node, child = above[node], node
        body = getattr(node, "body", [])
        before = body[: body.index(child)] if isinstance(body, list) and child in body else []
        if asks(node, name) or any(asks(one, name) and isinstance(one.body[-1], ast.Return) for one in before):
            return True
    return False


@pytest.mark.parametrize("file", LIBRARY, ids=lambda file: file.relative_to(ROOT).as_posix())
def test_names_that_some_systems_lack_stand_under_a_guard(file):
    tree = ast.parse(file.read_text(encoding="utf-8"))
    above = {child: node for node in ast.walk(tree) for child in ast.iter_child_nodes(node)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            if node.attr in ABSENT.get(node.value.id, ()):
                assert guarded(node, above, node.attr), ast.unparse(node)
        elif isinstance(node, ast.ImportFrom):
            assert not {alias.name for alias in node.names} & set(ABSENT.get(node.module or "", ())), ast.unparse(node)
            assert node.module not in MODULES, ast.unparse(node)
        elif isinstance(node, ast.Import):
            assert not {alias.name for alias in node.names} & MODULES, ast.unparse(node)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            assert not node.value.startswith(("/proc/", "/dev/", "/tmp/", "/sys/")), node.value


@pytest.mark.parametrize("file", LIBRARY, ids=lambda file: file.relative_to(ROOT).as_posix())
def test_text_is_read_and_written_the_same_everywhere(file):
    """The platform's own encoding and line ends are never left to apply."""
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if not isinstance(node, ast.Call):
            continue
        called = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        given = {keyword.arg for keyword in node.keywords}
        if called == "read_text" or (called == "write_text" and "newline" in given):
            assert "encoding" in given, ast.unparse(node)
        elif called == "write_text" and isinstance(node.func, ast.Attribute):
            raise AssertionError(f"{ast.unparse(node)} writes the platform's line ends")
        elif called == "open" and isinstance(node.func, ast.Name):
            mode = ast.literal_eval(node.args[1]) if len(node.args) > 1 else "r"
            assert "b" in mode or "encoding" in given, ast.unparse(node)
            assert "w" not in mode or "b" in mode or "newline" in given, ast.unparse(node)


def test_only_one_module_sets_how_many_threads_torch_has():
    setters = [file for file in LIBRARY if "set_num_threads" in file.read_text(encoding="utf-8")]
    assert setters == [ROOT / "probscene" / "threads.py"]


@pytest.mark.parametrize("said", ["3", " 3 ", "3,1", "", "0", "many", None])
def test_threads_are_as_many_as_the_environment_says_or_as_cores(monkeypatch, said):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    if said is not None:
        monkeypatch.setenv("OMP_NUM_THREADS", said)
    assert default_threads() == (3 if "3" in (said or "") else cores())


@pytest.mark.parametrize(
    ("platform", "variables", "expected"),
    [
        ("linux", {}, ".cache/probscene"),
        ("linux", {"XDG_CACHE_HOME": "xdg"}, "xdg/probscene"),
        ("darwin", {"XDG_CACHE_HOME": "xdg"}, "Library/Caches/probscene"),
        ("win32", {}, "AppData/Local/probscene"),
        ("win32", {"LOCALAPPDATA": "local"}, "local/probscene"),
        ("win32", {"LOCALAPPDATA": "local", "PROBSCENE_CACHE": "own"}, "own"),
    ],
)
def test_the_cache_folder_is_the_platforms(monkeypatch, tmp_path, platform, variables, expected):
    for name in ("PROBSCENE_CACHE", "XDG_CACHE_HOME", "LOCALAPPDATA"):
        monkeypatch.delenv(name, raising=False)
    for name, folder in variables.items():
        monkeypatch.setenv(name, str(tmp_path / folder))
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("USERPROFILE", str(tmp_path))
    monkeypatch.setattr(sys, "platform", platform)
    assert cache_folder() == tmp_path / expected
