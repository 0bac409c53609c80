"""The example of a renderer of one's own goes the whole path on the command line, and its labels are right."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

import probscene as ps
from probscene.app.datasets.generate import generate_scenes
from probscene.app.loading import load_model, renderer_for
from probscene.checks import check
from probscene.sampling import sample, seed_everything

FILE = Path(__file__).parents[2] / "examples" / "own_renderer.py"
MODEL = load_model(str(FILE))


def test_a_newcomer_reads_it_in_one_go():
    assert len(FILE.read_text(encoding="utf-8").splitlines()) < 150


@pytest.mark.parametrize("model", [MODEL, MODEL.target(0)], ids=["prior", "target"])
def test_grammar_and_prior_are_sound(model):
    report = check(model)
    assert not report.faults and not report.warnings
    assert model.renderer is MODEL.renderer


@given(st.integers(0, 2**32 - 1), st.integers(1, 6))
def test_scenes_are_the_same_alone_and_among_others(seed, num_scenes):
    seed_everything(seed)
    drawing = sample(MODEL, MODEL.prior, num_scenes).drawing
    batch = renderer_for(MODEL)(drawing)
    for i in range(num_scenes):
        alone = renderer_for(MODEL)(drawing[i : i + 1])
        assert all(torch.equal(one, many[i : i + 1]) for one, many in zip(alone[:7], batch[:7], strict=True))


def test_labels_are_where_the_lights_are():
    seed_everything(3)
    scenes = sample(MODEL, MODEL.target(0).prior, 30)
    batch = renderer_for(MODEL)(scenes.drawing)
    buoys = scenes.derivation.kind >= 0
    assert torch.equal(batch.kind, scenes.derivation.kind)
    x, y = scenes.parameters["buoy.x"], scenes.parameters["buoy.y"]
    middle = (batch.amodal_box[..., :2] + batch.amodal_box[..., 2:]) / 2
    assert (torch.stack([x, y], -1) - middle)[buoys].abs().max() <= 1
    whole = buoys & (batch.visible == 1)
    assert whole.any() and torch.equal(batch.box[whole], batch.amodal_box[whole])
    for channel, kind in ((0, "red"), (1, "green")):
        of_kind = (batch.instance > 0) & (
            batch.kind.gather(1, (batch.instance.long() - 1).clamp(min=0).flatten(1)) == MODEL.grammar.kind(kind)
        ).view(batch.instance.shape)
        assert batch.image[:, channel][of_kind].float().mean() > 200
    assert batch.image[:, :, 0].float().mean() < 60  # the sky


def test_lights_add_up():
    """Which is why the renderer is one's own: two lights at one place are brighter than either."""
    seed_everything(5)
    drawing = sample(MODEL, MODEL.target(0).prior, 20).drawing
    night = renderer_for(MODEL)
    fewer = [layer for layer in drawing.layers if layer is not drawing.layers[1]]
    both, red = night(drawing).image, night(type(drawing)(drawing.kind, drawing.kinds, tuple(fewer))).image
    assert (both >= red).all() and (both > red).any()


def test_it_is_fitted_and_generated(tmp_path, call, both_ways, short):
    """By the model that has it, and by one that is drawn otherwise, to which a fit gives it."""
    truth = MODEL.target(0)
    generate_scenes(truth, truth.prior, 40, tmp_path / "drawn", format="images")
    plain = replace(MODEL, renderer=None)
    drawn = tmp_path / "drawn" / "images"
    run = both_ways([], {}, FILE, drawn).command
    config, execution = ps.preset("quick").set(short), ps.Execution(threads=1, progress=False)
    given = ps.fit(replace(plain, renderer=MODEL.renderer), drawn, config, seed=3, execution=execution)
    assert (given.path / "guide.safetensors").read_bytes() == (run / "guide.safetensors").read_bytes()
    assert torch.equal(given.render(3).image, ps.Run.open(run).render(3).image)
    call("generate", run, "--num", 4, "--out", tmp_path / "dataset")
    coco = json.loads((tmp_path / "dataset" / "annotations.json").read_text())
    assert len(coco["images"]) == 4 and {c["name"] for c in coco["categories"]} == {"red", "green"}
    first = np.asarray(Image.open(tmp_path / "dataset" / "images" / coco["images"][0]["file_name"]))
    assert first.shape == (96, 96, 3) and (first[0, 0, :3] < 60).all()
    call("preview", run, "--out", tmp_path / "night.png", "--boxes", "--num", 3)
    assert (tmp_path / "night.png").is_file()
