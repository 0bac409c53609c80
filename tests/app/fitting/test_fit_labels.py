"""``fit --labels``: read before anything is trained, recorded, bound to the run, and handed to the features."""

import json

import pytest

from probscene.app.fitting.config import takers_of_labels
from probscene.app.fitting.run import RunFolder

PARTS = """
import torch
import probscene

SEEN = []


class Mean(torch.nn.Module):
    names = ("red", "blue")

    def __init__(self):
        super().__init__()
        self.register_buffer("scale", torch.ones(2))

    def embed(self, images):
        return images.float().mean((2, 3))[:, [0, -1]] * self.scale


class Calibrated(probscene.Features):
    name, takes_labels = "calibrated", True

    def build(self, model):
        return Mean()

    def training(self, net, renders, photographs, seed):
        labelled = photographs().labelled
        if labelled is not None:
            SEEN.append((labelled.images.shape, labelled.counts.tolist(), labelled.classes))
            net.scale.copy_(labelled.counts.float().mean(0) / net.embed(labelled.images).mean(0))
"""


@pytest.fixture
def parts(tmp_path):
    (tmp_path / "parts.py").write_text(PARTS)
    return f"{tmp_path / 'parts.py'}:Calibrated"


@pytest.fixture
def few(target, tmp_path):
    """Five rows of the target's labels."""
    (tmp_path / "few.csv").write_text("\n".join(target.labels.read_text().splitlines()[:6]))
    return tmp_path / "few.csv"


def words(discs, target, out, *more):
    return ["fit", discs.file, "--target", target.images, "--out", out, *discs.without("features"), *more]


def test_a_network_is_given_what_is_labelled(call, discs, target, parts, few, tmp_path):
    out = tmp_path / "run"
    done = call(*words(discs, target, out, "--features", parts, "--labels", few))
    assert done.code == 0, done.err
    run = RunFolder.at(out)
    assert run.record["labels"]["path"] == str(few) and len(run.record["labels"]["sha256"]) == 64
    images = run.network().net.embed
    assert images is not None and not (run.network().scale == 1).all()
    again = call("fit", "--resume", "--out", out, "--labels", few)
    assert again.code == 0, again.err
    other = call("fit", "--resume", "--out", out, "--labels", target.labels)
    assert other.code == 2 and "labels that the run" in other.err and str(few) in other.err


def test_labels_are_checked_before_anything_is_written(call, discs, target, parts, few, tmp_path):
    out = tmp_path / "run"
    done = call(*words(discs, target, out, "--labels", few, "--features", "count"))
    assert done.code == 2 and not out.exists()
    assert "expected features that labels can calibrate, got 'count'" in done.err
    assert all(f"--features {name}" in done.err for name in takers_of_labels())
    few.write_text(few.read_text().replace("000001.png,", "000001.png,x"))
    done = call(*words(discs, target, out, "--features", parts, "--labels", few))
    assert done.code == 2 and not out.exists() and "of 000001.png" in done.err
    done = call(*words(discs, target, out, "--features", parts, "--labels", tmp_path / "none.csv"))
    assert done.code == 2 and not out.exists() and "none.csv, got none" in done.err


def test_a_run_goes_on_with_the_labels_it_was_begun_with(call, discs, target, parts, few, tmp_path):
    out = tmp_path / "run"
    done = call(*words(discs, target, out, "--features", parts, "--labels", few))
    assert done.code == 0, done.err
    learnt = RunFolder.at(out).guide_hash()
    for name in ("guide", "features", "real"):
        (out / f"{name}.safetensors").unlink()
    assert call("fit", "--resume", "--out", out).code == 0
    assert RunFolder.at(out).guide_hash() == learnt
    elsewhere = few.rename(tmp_path / "elsewhere.csv")
    assert call("fit", "--resume", "--out", out, "--labels", elsewhere).code == 0
    assert json.loads((out / "run.json").read_text())["labels"]["path"] == str(elsewhere)
    (out / "guide.safetensors").unlink()
    few = elsewhere
    few.write_text(few.read_text() + "\n")
    done = call("fit", "--resume", "--out", out)
    assert done.code == 2 and "the labels in" in done.err and "begin a new run" in done.err
    assert json.loads((out / "run.json").read_text())["labels"]["path"] == str(few)
