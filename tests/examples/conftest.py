"""Each example of a part of one's own, in a fit of a few seconds: by the command line and from Python."""

import runpy
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from typer.testing import CliRunner

import probscene as ps
from probscene.app.cli import app
from probscene.app.fitting.config import configuration

EXAMPLES = Path(__file__).parents[2] / "examples"
TABLETOP = EXAMPLES / "tabletop.py"
SHORT = {
    "features.schedule.steps": 16,
    "features.schedule.images": 4,
    "features.schedule.crops": 4,
    "features.width": "4,8,8",
    "pretrain.derivations": 100,
    "pretrain.epochs": 1,
    "fallback_to_prior": "false",
    "parameters": "none",
    "structure.batches": 2,
    "structure.num_scenes": 20,
    "structure.draws_per_structure": 1,
}
EXECUTION = ps.Execution(threads=1, cache=False, progress=False)
FILES = ("features.safetensors", "real.safetensors", "guide.safetensors", "log.jsonl")


def settings_for(features) -> dict[str, str | int]:
    """Those of ``SHORT`` that features read; None for the preset's."""
    return {key: value for key, value in SHORT.items() if features is None or not key.startswith("features.")}


def probscene(*words):
    """Call the command line in this process; it must succeed."""
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert result.exit_code == 0, result.output
    return result.stdout


@pytest.fixture(scope="session", autouse=True)
def _own_cache(tmp_path_factory):
    """Tests neither read nor write the user's cache of feature networks."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PROBSCENE_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="module", autouse=True)
def _quick_verdicts(few_and_small_images):
    pass


@pytest.fixture(scope="session")
def call():
    return probscene


@pytest.fixture
def script(monkeypatch, capsys):
    """``script(file, *words)``: it runs as a script here, without seconds of imports; what comes is a process's."""

    def run(file, *words):
        monkeypatch.setattr(sys, "argv", [str(file), *map(str, words)])
        code = 0
        try:
            runpy.run_path(str(file), run_name="__main__")
        except SystemExit as end:
            code = end.code
        said = capsys.readouterr()
        return subprocess.CompletedProcess(words, code or 0, said.out, said.err)

    return run


@pytest.fixture(scope="session")
def short():
    """Settings of a fit that ends soon."""
    return SHORT


@pytest.fixture(scope="session")
def tables(tmp_path_factory) -> Path:
    """40 pictures of tables."""
    folder, truth = tmp_path_factory.mktemp("tables"), ps.load_model(TABLETOP).target(0)
    ps.generate(truth, 40, folder, format="images", progress=False)
    return folder / "images"


@pytest.fixture(scope="session")
def both_ways(tmp_path_factory, tables):
    """Fits of a model by the command line and from Python: ``command`` and ``python``, which have the same bytes.

    ``both_ways(words, options)`` takes the command's further words and the further arguments of ``configuration``.
    """

    def fitted(words, options, model=TABLETOP, target=tables):
        folder = tmp_path_factory.mktemp("ways")
        settings = settings_for(options.get("features"))
        short = [word for key, value in settings.items() for word in ("--set", f"{key}={value}")]
        common = ["--preset", "quick", "--features", "count", "--threads", 1, "--seed", 3, "--no-cache", "--no-verdict"]
        probscene("fit", model, "--target", target, "--out", folder / "command", *common, *short, *words)
        config = configuration(ps.preset("quick"), **{"features": "count", **options}, settings=settings)
        fit = ps.fit(model, target, config, seed=3, out=folder / "python", execution=EXECUTION)
        for name in FILES:
            assert (folder / "command" / name).read_bytes() == (fit.path / name).read_bytes(), name
        return SimpleNamespace(command=folder / "command", python=fit)

    return fitted


@pytest.fixture
def goes_on(tmp_path, tables, monkeypatch):
    """Checks that a fit with parts of one's own, interrupted in a stage of its log, goes on to the same bytes."""

    def check(stage, **options):
        from probscene.app.fitting import store as checkpoints

        class Interrupted(Exception):
            pass

        def stop(keeper, line):
            kept(keeper, line)
            if line is not None and line["stage"] == stage:
                raise Interrupted

        settings = settings_for(options.get("features"))
        config = configuration(ps.preset("quick"), **{"features": "count", **options}, settings=settings)
        whole = ps.fit(TABLETOP, tables, config, out=tmp_path / "whole", execution=EXECUTION)
        kept = checkpoints.Checkpointer.__call__
        with monkeypatch.context() as patch:
            patch.setattr(checkpoints, "SAVE_EVERY", -1.0)
            patch.setattr(checkpoints.Checkpointer, "__call__", stop)
            with pytest.raises(Interrupted):
                ps.fit(TABLETOP, tables, config, out=tmp_path / "parts", execution=EXECUTION)
        assert list((tmp_path / "parts").glob("*-checkpoint.safetensors"))
        again = ps.fit(TABLETOP, tables, config, out=tmp_path / "parts", resume=True, execution=EXECUTION)
        for name in FILES:
            assert (whole.path / name).read_bytes() == (again.path / name).read_bytes(), name

    return check
