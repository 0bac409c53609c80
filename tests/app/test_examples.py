"""A new domain in one file goes the whole path; so do the other objective and the paper's preset."""

from pathlib import Path

import pytest

from probscene.app.datasets.generate import generate_scenes
from probscene.app.fitting.run import RunFolder
from probscene.app.loading import load_model

TABLETOP = Path(__file__).resolve().parents[2] / "examples" / "tabletop.py"


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    """40 pictures of tables that are laid otherwise than the prior's."""
    folder = tmp_path_factory.mktemp("photos")
    truth = load_model(str(TABLETOP)).target(0)
    generate_scenes(truth, truth.prior, 40, folder, format="images")
    return folder / "images"


def test_tabletop_is_fitted_and_generated(call, discs, photos, tmp_path):
    run, dataset = tmp_path / "run", tmp_path / "dataset"
    done = call("fit", TABLETOP, "--target", photos, "--out", run, *discs.settings)
    assert done.code == 0, done.err
    done = call("generate", run, "--num", 5, "--out", dataset)
    assert done.code == 0, done.err
    assert len(list((dataset / "images").glob("*.png"))) == 5
    assert (dataset / "annotations.json").is_file()


FEW_RENDERS = ["--set", "features.images=40", "--set", "features.epochs=1"]
FEW_COUNTS = ["--features", "count", "--set", "features.schedule.steps=16", "--set", "features.width=4,8,8"]


@pytest.mark.parametrize(
    "words",
    [
        [
            "--preset",
            "paper",
            "--set",
            "features.images=40",
            "--set",
            "features.epochs=1",
            "--set",
            "structure.num_real=10",
        ],
        ["--preset", "paper-aerial", *FEW_RENDERS],
        ["--preset", "paper-driving", "--features", "efficientnet", "--set", "structure.num_real=10"],
        [
            "--preset",
            "quick",
            "--divergence",
            "mmd",
            "--set",
            "features.schedule.steps=16",
            "--set",
            "features.width=4,8,8",
        ],
        [
            "--preset",
            "quick",
            "--set",
            "guide.num_latents=3",
            "--set",
            "features.schedule.steps=16",
            "--set",
            "features.width=4,8,8",
        ],
        [
            "--preset",
            "quick",
            "--guide",
            "pcfg",
            "--set",
            "features.schedule.steps=16",
            "--set",
            "features.width=4,8,8",
        ],
        [
            "--preset",
            "quick",
            "--guide",
            "grammar-vae",
            "--set",
            "features.schedule.steps=16",
            "--set",
            "features.width=4,8,8",
        ],
    ],
    ids=["paper", "paper-aerial", "paper-driving", "mmd", "latents", "pcfg", "grammar-vae"],
)
def test_other_presets_and_objectives_run(words, call, photos, tmp_path):
    few = (
        "pretrain.derivations=100",
        "structure.batches=2",
        "structure.num_scenes=20",
        "structure.learning_rate=1e-3",
        "fallback_to_prior=false",
        "parameters=none",
    )
    few = [word for setting in few for word in ("--set", setting)]
    out = ["--target", photos, "--out", tmp_path / "run", "--threads", 1, "--no-verdict"]
    done = call("fit", TABLETOP, *out, *words, *few)
    assert done.code == 0, done.err
    run = RunFolder.at(tmp_path / "run")
    guide = "lstm" if "--guide" not in words else words[words.index("--guide") + 1]
    assert run.config.guide.kind == guide
    assert len(getattr(run.guide, "latents", [0])) == getattr(run.config.guide, "num_latents", 1)
    assert run.config.divergence_name == ("mmd" if "mmd" in words else "kde")
