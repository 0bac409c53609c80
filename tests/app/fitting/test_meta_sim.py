"""``fit --parameters meta-sim``: kept, used by all that draws, and resumed."""

import json
from pathlib import Path

import pytest
import torch

from probscene.app.datasets.generate import generate_scenes
from probscene.app.fitting import site_selection
from probscene.app.fitting import store as storage
from probscene.app.fitting.run import RunFolder
from probscene.inference.parameters.meta_sim.learning import MetaSimLearning
from probscene.inference.parameters.meta_sim.transform import ParameterTransform
from probscene.inference.statistics.energy import BootstrapTest
from probscene.sampling import sample, seed_everything

SCHEDULE = {"steps": 4, "scenes": 6, "values": 10, "rate": 0.05, "feature_size": 96, "images": 20, "hidden": 8}
SETTINGS = [word for key, value in SCHEDULE.items() for word in ("--set", f"parameters.{key}={value}")]
LEARN = ("--learn", "structure,parameters", "--parameters", "meta-sim", "--set", "refine.batches=2", *SETTINGS)


def it_is_kept(patch):
    patch.setattr(site_selection, "bootstrap_test", lambda *_: BootstrapTest(0.0, 1.0, 0.0))


@pytest.fixture(scope="module")
def fitted(tmp_path_factory, call, discs, target) -> Path:
    """A finished run."""
    out = tmp_path_factory.mktemp("meta-sim") / "run"
    with pytest.MonkeyPatch.context() as patch:
        it_is_kept(patch)
        done = call("fit", discs.file, "--target", target.images, "--out", out, *discs.without("parameters"), *LEARN)
    assert done.code == 0, done.err
    assert "Learnt sites: x, y." in " ".join(done.err.split())
    return out


def test_a_run_keeps_what_it_has_learnt(fitted):
    run = RunFolder.at(fitted)
    assert run.config.parameter_method == run.parameters["method"] == "meta-sim"
    assert [(site["name"], site["learnt"]) for site in run.parameters["sites"]] == [("x", True), ("y", True)]
    assert run.parameters["kept"] == "learnt" and run.guide.with_parameters is not None
    assert run.config.parameters.steps == 4
    log = [json.loads(line) for line in (fitted / "log.jsonl").read_text().splitlines()]
    assert [line["step"] for line in log if line["stage"] == "parameters"] == [1, 2, 3, 4]


def test_all_that_draws_takes_them(fitted, call, tmp_path):
    run = RunFolder.at(fitted)
    seed_everything(0)
    moved = sample(run.model, run.guide, 40).parameters["x"]
    assert isinstance(run.guide.with_parameters.__self__, ParameterTransform)
    run.guide.with_parameters = None
    seed_everything(0)
    assert not torch.equal(moved, sample(run.model, run.guide, 40).parameters["x"])
    done = call("generate", run.path, "--num", 70, "--out", tmp_path / "command")
    assert done.code == 0, done.err
    generate_scenes(run.model, RunFolder.at(fitted).guide, 70, tmp_path / "here", format="images")
    one, two = (sorted((tmp_path / name / "images").iterdir()) for name in ("command", "here"))
    assert [file.read_bytes() for file in one] == [file.read_bytes() for file in two] and len(one) == 70
    assert call("preview", run.path, "--out", tmp_path / "p.png").code == 0


def test_a_fit_goes_on_to_the_same_bytes(fitted, call, discs, target, tmp_path, monkeypatch):
    words = (
        "fit",
        discs.file,
        "--target",
        target.images,
        "--out",
        tmp_path / "run",
        *discs.without("parameters"),
        *LEARN,
    )
    monkeypatch.setattr(storage, "SAVE_EVERY", 0)
    it_is_kept(monkeypatch)
    run = MetaSimLearning.run

    def interrupted(self, callback=None):
        def heard(training, line):
            callback(training, line)
            if training.done == 2:
                raise KeyboardInterrupt

        run(self, heard)

    with monkeypatch.context() as patch:
        patch.setattr(MetaSimLearning, "run", interrupted)
        assert call(*words).code != 0
    assert (tmp_path / "run" / "parameters-checkpoint.safetensors").exists()
    done = call("fit", "--resume", "--out", tmp_path / "run")
    assert done.code == 0, done.err
    assert (tmp_path / "run" / "guide.safetensors").read_bytes() == (fitted / "guide.safetensors").read_bytes()
    other = ["likelihood" if word == "meta-sim" else word for word in LEARN[: -len(SETTINGS)]]
    again = call("fit", "--resume", "--out", tmp_path / "run", *discs.without("parameters"), *other)
    assert again.code != 0 and "the parameters.kind" in again.err


def test_another_word_is_named(call, discs, target, tmp_path):
    done = call("fit", discs.file, "--target", target.images, "--out", tmp_path / "run", "--parameters", "magic")
    assert done.code != 0 and "likelihood, tilting, meta-sim" in done.err and "magic" in done.err
