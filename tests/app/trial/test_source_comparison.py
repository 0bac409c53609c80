"""Which source of a run trains the best detector: the measure, what is compared, and what is made of it."""

import json
import shutil
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import probscene as ps
from probscene.app.datasets.generate import DatasetOptions
from probscene.app.detectors import source_comparison
from probscene.app.detectors.source_comparison import RESULT, DetectorBudget, compare_sources, count_agreement
from probscene.app.detectors.train import train
from probscene.app.fitting.pipeline import open_target
from probscene.app.fitting.run import RunFolder
from probscene.app.progress import Display, silent
from probscene.app.trial.detector import RECIPES

from .conftest import small_options

RECIPE = RECIPES["efficientnet"]._replace(iterations=2, batch_size=2)
BUDGET = DetectorBudget("efficientnet", RECIPE, (64, 64), 4, DatasetOptions(), 0)


@given(st.integers(0, 10**6), st.integers(1, 3), st.integers(2, 30), st.integers(1, 4))
def test_agreement_is_the_best_correlation_of_each_class(seed, scores, photographs, classes):
    rng = np.random.default_rng(seed)
    found, read = rng.integers(0, 4, (scores, photographs, classes)), rng.random((photographs, classes))
    each = np.zeros((scores, classes))
    for s in range(scores):
        for c in range(classes):
            if found[s, :, c].std():
                each[s, c] = np.corrcoef(found[s, :, c], read[:, c])[0, 1]
    assert count_agreement(found, read) == pytest.approx(each.max(0).mean())
    assert count_agreement(found, 3 * read + 1) == pytest.approx(count_agreement(found, read))


@pytest.fixture
def counters(monkeypatch):
    """In the place of detectors: of each source, one whose counts go with what is read as ``right`` says, 0 to 1."""
    right, trained = {"learnt": 0.5, "prior": 0.5}, []
    rng = np.random.default_rng(0)
    read = rng.integers(0, 5, (50, 2)).astype(float)

    def trained_on(run, source, budget, into, more):
        trained.append(source)
        into.mkdir()
        more(budget.recipe.num_images)
        rows = iter(right[source] * read + (1 - right[source]) * np.random.default_rng(1).integers(0, 5, read.shape))
        return lambda image, classes: (10 * next(rows)).round().astype(int)[None]

    monkeypatch.setattr(source_comparison, "_trained", trained_on)
    monkeypatch.setattr(source_comparison, "_reading", lambda run, images: (("red", "blue"), list(range(50)), read))
    monkeypatch.setattr("probscene.app.detectors.train.open_target", lambda run, show: Black())
    return SimpleNamespace(right=right, trained=trained)


def stub(*sources: str) -> SimpleNamespace:
    return SimpleNamespace(guide=1, model=SimpleNamespace(prior=0), generated_sources=lambda: sources)


ALL = "prior", "start", "structure", "parameters", "learnt"


@pytest.mark.parametrize(
    ("sources", "right", "best", "trained"),
    [
        (("prior", "learnt"), {"learnt": 0.9, "prior": 0.4}, "learnt", ["learnt", "prior"]),
        (("prior", "learnt"), {"learnt": 0.4, "prior": 0.9}, "prior", ["learnt", "prior"]),
        (ALL, {"learnt": 0.9, "prior": 0.4}, "learnt", ["learnt", "prior"]),
        (
            ALL,
            {"learnt": 0.4, "prior": 0.6, "structure": 0.9, "parameters": 0.2},
            "structure",
            ["learnt", "prior", "structure", "parameters"],
        ),
    ],
)
def test_parts_are_compared_only_where_the_whole_is_worse_than_the_prior(
    counters, tmp_path, sources, right, best, trained
):
    counters.right |= right
    found = compare_sources(stub(*sources), Black(), BUDGET, tmp_path / "work", silent)
    assert found.source == best and counters.trained == trained and set(found.agreement) == set(trained)
    assert not (tmp_path / "work").exists() and found.photographs == 50
    assert all(f"{name} " in str(found) for name in trained) and f"Best: {best}." in str(found)


def test_a_comparison_goes_on_after_an_interruption(counters, tmp_path):
    counters.right |= {"learnt": 0.9, "prior": 0.4}
    shown: list[tuple[int, int]] = []

    def stopping(name, done, total, note="", unit=""):
        shown.append((done, total))
        if len(counters.trained) == 2:
            raise KeyboardInterrupt

    work = tmp_path / "work"
    with pytest.raises(KeyboardInterrupt):
        compare_sources(stub("prior", "learnt"), Black(), BUDGET, work, stopping)
    assert json.loads((work / RESULT).read_text()).keys() == {"learnt"}
    shutil.rmtree(work / "prior-0")
    found = compare_sources(stub("prior", "learnt"), Black(), BUDGET, work, silent)
    assert counters.trained == ["learnt", "prior", "prior"] and found.source == "learnt"
    whole = compare_sources(stub("prior", "learnt"), Black(), BUDGET, work, silent)
    assert whole == found and shown[-1] == (58, 108)  # of 4 images and 50 photographs each


def test_one_source_is_better_than_another_where_it_is_with_every_seed(counters, tmp_path):
    counters.right |= {"learnt": 0.4, "prior": 0.9}
    found = compare_sources(stub("prior", "learnt"), Black(), BUDGET._replace(seeds=3), tmp_path / "work", silent)
    assert counters.trained == ["learnt"] * 3 + ["prior"] * 3 and found.source == "prior"
    assert found.is_better("prior", "learnt") and not found.is_better("learnt", "prior")
    assert not found.is_better("structure", "learnt")
    mixed = found._replace(agreement={"prior": [0.9, 0.5], "learnt": [0.4, 0.6]})
    assert not mixed.is_better("prior", "learnt") and not mixed.is_better("learnt", "prior")


def test_detectors_of_a_run_are_trained_and_compared_the_same_each_time(fitted, tmp_path):
    run = RunFolder.at(fitted)
    images = open_target(run, Display())
    one, two = (compare_sources(run, images, BUDGET, tmp_path / name, silent) for name in "ab")
    assert one is not None and one == two and one.agreement.keys() == {"learnt", "prior"}
    assert one.classes == ("red", "blue") and all(-1 <= value <= 1 for (value,) in one.agreement.values())
    run.guide = run.model.prior
    assert compare_sources(run, images, BUDGET, tmp_path / "c", silent) is None


def test_a_detector_is_trained_on_the_best_source(fitted, photographs, tmp_path, counters):
    """Of a comparison of its own, of one that the run has, or on the one that is asked for."""
    run = RunFolder.at(shutil.copytree(fitted, tmp_path / "run"))
    counters.right |= {"learnt": 0.4, "prior": 0.9}
    own = train(run, photographs / "train", None, tmp_path / "own", small_options())
    asked = train(run, photographs / "train", None, tmp_path / "asked", small_options(source="prior"))
    assert own.record["source"] == asked.record["source"] == "prior" and asked.record["sources"] is None
    assert own.record["weights_sha256"] == asked.record["weights_sha256"]
    assert own.record["sources"]["agreement"]["prior"] > own.record["sources"]["agreement"]["learnt"]
    assert {file.name for file in own.path.iterdir()} == {file.name for file in asked.path.iterdir()}
    run.write_sources(own.record["sources"] | {"source": "learnt"})
    trained = list(counters.trained)
    learnt = train(run, photographs / "train", None, tmp_path / "learnt", small_options())
    assert learnt.record["source"] == "learnt" and counters.trained == trained
    assert learnt.record["weights_sha256"] != own.record["weights_sha256"]


def test_a_run_keeps_what_was_found(fitted, tmp_path, counters, monkeypatch, call):
    monkeypatch.setattr("probscene.app.api.calls.open_target", lambda run, show: Black())
    counters.right |= {"learnt": 0.4, "prior": 0.9}
    run = ps.Run.open(shutil.copytree(fitted, tmp_path / "run"))
    found = run.compare_sources(progress=False)
    assert found is not None and found.source == "prior" and ps.Run.open(run.path).sources == found.record()
    monkeypatch.setattr(source_comparison, "_reading", lambda run, images: None)
    assert run.compare_sources(progress=False) is None
    assert call("fit", "--resume", "--out", run.path, "--detector-test").code == 0  # it has been compared


class Black:
    """Images of nothing."""

    def load(self, row: int) -> torch.Tensor:
        return torch.zeros(3, 4, 4, dtype=torch.uint8)
