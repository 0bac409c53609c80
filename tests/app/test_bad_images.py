"""Images that no fit can take: each fault is one line, and nothing is left half-written."""

import shutil

import numpy as np
import pytest
import safetensors.torch
import torch
from PIL import Image

from probscene.app.fitting.run import RunFolder

from .conftest import check_fault, copied


def spoil_empty(folder):
    for file in folder.iterdir():
        file.unlink()


def spoil_no_images(folder):
    spoil_empty(folder)
    (folder / "notes.txt").write_text("none")


def spoil_corrupt(folder):
    (folder / "000003.png").write_bytes(b"not a picture")


def spoil_truncated(folder):
    file = folder / "000003.png"
    file.write_bytes(file.read_bytes()[:-20])


def spoil_file(folder):
    spoil_empty(folder)
    folder.rmdir()
    folder.write_text("a file")


def spoil_gone(folder):
    spoil_empty(folder)
    folder.rmdir()


IMAGES = {
    spoil_empty: "an empty folder",
    spoil_no_images: "notes.txt",
    spoil_corrupt: "000003.png",
    spoil_truncated: "000003.png is truncated",
    spoil_file: "which is a file",
    spoil_gone: "which is not there",
}


@pytest.mark.parametrize("spoil", IMAGES, ids=lambda spoil: spoil.__name__[6:])
def test_bad_images(spoil, call, discs, target, fitted, tmp_path):
    folder = copied(target, tmp_path / "images")
    spoil(folder)
    check_fault(call("fit", discs.file, "--target", folder, "--out", tmp_path / "run"), 2, IMAGES[spoil])
    assert not (tmp_path / "run").exists()
    check_fault(call("evaluate", fitted, "--target", folder, "--json", tmp_path / "e.json"), 2, IMAGES[spoil])
    assert not (tmp_path / "e.json").exists()


def test_bad_files_are_left_out_and_other_sizes_resized_where_it_says_so(call, discs, target, tmp_path):
    folder = copied(target, tmp_path / "images", 40)
    spoil_corrupt(folder)
    Image.fromarray(np.zeros((30, 40, 3), np.uint8)).save(folder / "small.png")
    unnamed = [word for word in discs.settings if word not in ("--features", "count")]  # so that the fit asks for it
    words = ["fit", discs.file, "--target", folder, "--out", tmp_path / "run", *unnamed, "--set", "structure.batches=1"]
    result = call(*words, "--skip-bad", "--set", "features.schedule.steps=16")
    assert result.code == 0, result.err
    assert result.err.count("000003.png") == 1 and result.err.count("resized to 64x64") == 1
    lines = [line for line in result.err.splitlines() if not line.startswith(("Note: ", "Warning: "))]
    stages = [line.split(":")[0] for line in lines]
    first = ["Target's images", "Domain shift", "Feature network", "Target's features"]
    assert stages == [*first, "Pretraining", "Structure", "Outcome"]
    assert len(RunFolder.at(tmp_path / "run").read_tensors("real")["features"]) == 40


def test_images_that_no_distribution_can_be_learnt_from(call, discs, target, tmp_path):
    few, same = copied(target, tmp_path / "few", 39), tmp_path / "same"
    same.mkdir()
    for i in range(50):
        shutil.copy(target.images / "000000.png", same / f"{i}.png")
    out = tmp_path / "run"
    check_fault(call("fit", discs.file, "--target", few, "--out", out), 2, "at least 40 images", "got 39")
    check_fault(call("fit", discs.file, "--target", same, "--out", out), 2, "images that differ", "50 that are all the")
    assert not out.exists()


@pytest.mark.parametrize(
    ("setting", "where"),
    [
        ("features.schedule.learning_rate=1e38", " steps "),
        ("pretrain.learning_rate=1e37", "epoch "),
        ("structure.learning_rate=1e37", "At batch "),
    ],
)
def test_what_is_no_longer_finite_stops_with_the_step_and_a_remedy(call, discs, target, tmp_path, setting, where):
    out = tmp_path / "run"
    result = call("fit", discs.file, "--target", target.images, "--out", out, *discs.settings, "--set", setting)
    check_fault(result, 2, where, "egin again with", "lower rate")
    for kept in out.glob("*.safetensors"):
        assert all(torch.isfinite(tensor).all() for tensor in safetensors.torch.load_file(kept).values())
