"""From photographs and labels to labelled photographs, by the command line."""

import json

from .test_begin import photographs

TINY = {
    "parameters": "none", "features": "count", "features.schedule.steps": 4, "structure.batches": 1,
    "structure.num_scenes": 20, "pretrain.derivations": 60, "pretrain.epochs": 1,
}  # fmt: skip


def test_each_command_takes_what_the_one_before_has_written(tmp_path, call, few_and_small_images):
    labels, photos = photographs(tmp_path, number=40), tmp_path / "photos"
    settings = [word for name, value in TINY.items() for word in ("--set", f"{name}={value}")]
    model, run, detector = tmp_path / "cells", tmp_path / "run", tmp_path / "detector"
    own = model / "labels.json"
    small = ("--generate", 8, "--iterations", 2, "--size", "64x64")
    for words in (
        ("begin", photos, "--labels", labels, "--out", model),
        ("fit", model / "model.py", "--target", photos, "--out", run, "--no-cache", *settings),
        ("train", run, "--real", photos, "--labels", own, "--out", detector, *small),
        ("predict", detector, photos, "--out", tmp_path / "predicted.json", "--min-score", 0),
        ("begin", photos, "--labels", labels, "--detections", tmp_path / "predicted.json", "--out", tmp_path / "again"),
    ):
        done = call(*words)
        assert done.code == 0, done.err
    found = json.loads((tmp_path / "predicted.json").read_text())
    assert len(found["images"]) == 40 and {one["name"] for one in found["categories"]} == {"disc", "big_Disc"}
