"""A target folder, and a run that the command line has fitted to it in a few seconds."""

import os
import shlex
import signal
import struct
import sys
from collections.abc import Callable
from multiprocessing import forkserver
from multiprocessing.context import ForkServerContext
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from probscene.app.cli import app, main
from probscene.app.datasets.generate import generate_scenes
from probscene.app.evaluation.labels import counts_of_dataset
from probscene.app.labels.counts import write_counts
from probscene.app.loading import load_model

COMMANDS = typer.main.get_command(app).commands
DISCS = Path(__file__).with_name("discs.py")
STRUCTURE = {
    "features.schedule.steps": 48,
    "features.schedule.images": 4,
    "features.schedule.crops": 4,
    "features.width": "4,8,8",
    "pretrain.derivations": 100,
    "pretrain.epochs": 2,
    "structure.batches": 4,
    "structure.num_scenes": 30,
}
PARAMETERS = {
    "parameters.reader_steps": 6,
    "parameters.reader_images": 4,
    "parameters.steps": 4,
    "parameters.rounds": 1,
    "parameters.round_reader_steps": 2,
    "parameters.recalibration_renders": 100,
    "parameters.round_steps": 2,
}
# With the features named, a fit does not ask whether its target looks like renders: 320 images through EfficientNet.
WORDS = ["--preset", "quick", "--features", "count", "--threads", "1", "--no-cache", "--no-verdict"]


def _without(*begins: str) -> list[str]:
    left = {key: value for key, value in (STRUCTURE | PARAMETERS).items() if not key.startswith(begins)}
    return [*WORDS, *(word for key, value in left.items() for word in ("--set", f"{key}={value}"))]


SETTINGS = [*_without("parameters"), "--learn", "structure"]


@pytest.fixture(scope="session", autouse=True)
def _own_cache(tmp_path_factory):
    """Tests neither read nor write the user's cache of feature networks."""
    with pytest.MonkeyPatch.context() as patch:
        folder = tmp_path_factory.mktemp("cache")
        patch.setattr("probscene.app.fitting.cache.cache_folder", lambda: folder)
        yield


@pytest.fixture(scope="module", autouse=True)
def _quick_verdicts(few_and_small_images):
    pass


def probscene(*words) -> SimpleNamespace:
    """Call the command line in this process: ``code``, ``out`` and ``err``; what succeeds says what to do next."""
    result = CliRunner().invoke(app, [str(word) for word in words])
    if result.exit_code == 0 and words[0] in COMMANDS and words[0] != "version" and "--help" not in words:
        check_next(result.stdout)
    return SimpleNamespace(code=result.exit_code, out=result.stdout, err=result.stderr)


def check_next(out: str) -> None:
    """The last line is a sentence, or a command that there is, with its options."""
    last = out.splitlines()[-1]
    assert last.startswith("Next: ")
    if last.startswith("Next: probscene "):
        _, _, name, *arguments = shlex.split(last.partition(", ")[0])
        COMMANDS[name].make_context(name, arguments)


@pytest.fixture(scope="session")
def call() -> Callable[..., SimpleNamespace]:
    return probscene


class Ready(ForkServerContext):
    """Makes processes that have imported everything and begun nothing: they start at once, where one that is spawned
    imports for seconds first. Like such a one they have the environment of the moment."""

    def Process(self, *, target, args=(), **more):
        return super().Process(target=_with_environment, args=(dict(os.environ), target, args), **more)


def _with_environment(environment, target, args):
    os.environ.clear()
    os.environ.update(environment)
    target(*args)


@pytest.fixture(scope="session")
def ready() -> Ready:
    context = Ready()
    context.set_forkserver_preload([__name__, "probscene.app.api.fit", "probscene.app.datasets.scene_dataset"])
    forkserver.ensure_running()  # now: what starts workers holds interrupts, and all processes would hold them
    return context


class Command:
    """The command line in a process of its own: ``process``, and once it has ``ended()`` its ``code``, ``out`` and
    ``err``."""

    def __init__(self, context: Ready, folder: Path, words: list[str], first: tuple):
        self._printed = folder / "out", folder / "err"
        self.process = context.Process(target=_command, args=(self._printed, words, *first))
        self.process.start()

    def ended(self) -> "Command":
        self.process.join(300)
        self.code, (self.out, self.err) = self.process.exitcode, (file.read_text() for file in self._printed)
        return self


def _command(printed, words, first=None, *arguments):
    for descriptor, file in enumerate(printed, 1):
        with file.open("w") as opened:
            os.dup2(opened.fileno(), descriptor)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job ignores it, and so its children
    if first is not None:
        first(*arguments)
    sys.argv[:] = ["probscene", *words]
    main()


@pytest.fixture
def command(ready, tmp_path_factory) -> Callable[..., Command]:
    """``command(*words, first=(function, *arguments))`` starts the command line, after a call, in another process."""

    def start(*words, first=()):
        return Command(ready, tmp_path_factory.mktemp("printed"), [str(word) for word in words], first)

    return start


@pytest.fixture
def ready_workers(ready, monkeypatch):
    """Workers are made so; that they can be spawned as well is for the tests of worker processes."""
    monkeypatch.setattr("probscene.app.workers.processes.get_context", lambda _: ready)


@pytest.fixture(scope="session")
def idx_folder(tmp_path_factory) -> Path:
    """Digits in the original IDX files: 20 random images for a model, and 20 for its target."""
    folder, rng = tmp_path_factory.mktemp("digits"), np.random.default_rng(0)
    for name in ("train", "t10k"):
        labels = np.arange(20, dtype=np.uint8) % 10
        for what, array in (("images-idx3", rng.integers(0, 256, (20, 28, 28), np.uint8)), ("labels-idx1", labels)):
            header = struct.pack(f">BBBB{array.ndim}I", 0, 0, 8, array.ndim, *array.shape)
            (folder / f"{name}-{what}-ubyte").write_bytes(header + array.tobytes())
    return folder


@pytest.fixture(scope="session")
def discs() -> SimpleNamespace:
    """``file``: a model; ``settings``: words that make a fit of its structure short; ``short``: the preset's fields
    among them; ``parameters``: further ones that make a fit of parameters short; ``without``: words of such a fit,
    without those of fields that begin so, for fits that do not read them."""
    return SimpleNamespace(file=DISCS, settings=SETTINGS, short=STRUCTURE, parameters=PARAMETERS, without=_without)


@pytest.fixture(scope="session")
def target(tmp_path_factory) -> SimpleNamespace:
    """40 images that the model's target drew: ``images`` is their folder, ``labels`` their counts."""
    folder = tmp_path_factory.mktemp("target")
    truth = load_model(str(DISCS)).target(0)
    generate_scenes(truth, truth.prior, 40, folder / "drawn", format="images")
    names, counts = counts_of_dataset(truth, folder / "drawn")
    write_counts(folder / "counts.csv", names, counts, truth.classes)
    return SimpleNamespace(images=folder / "drawn" / "images", labels=folder / "counts.csv", counts=counts)


@pytest.fixture(scope="session")
def fitted(tmp_path_factory, target) -> Path:
    """A finished run."""
    out = tmp_path_factory.mktemp("fitted") / "run"
    done = probscene("fit", DISCS, "--target", target.images, "--out", out, *SETTINGS)
    assert done.code == 0, done.err
    return out


def copied(target, folder: Path, number: int = 10) -> Path:
    """A folder with some of the target's images."""
    folder.mkdir()
    for file in sorted(target.images.iterdir())[:number]:
        (folder / file.name).write_bytes(file.read_bytes())
    return folder


def check_fault(result, code: int, *parts: str) -> None:
    """One line on stderr after what progress says, and nothing that only a programmer reads."""
    assert result.code == code, result.err
    (line,) = [line for line in result.err.splitlines() if line.startswith("probscene: ")]
    assert result.err.endswith(line + "\n") and "Traceback" not in result.err
    for part in parts:
        assert part in line


@pytest.fixture
def inked() -> str:
    """Lines that let a model's file take a folder of assets, which its pictures do not show."""
    return """
import dataclasses
MODEL = dataclasses.replace(MODEL, with_assets=lambda folder: dataclasses.replace(MODEL, assets=f"inks in {folder}"))
"""
