"""The example with real photographs: it runs as a script on a folder, and its cells lie and look as they should."""

import csv
import runpy
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from probscene.app.loading import load_model
from probscene.checks import check
from probscene.renderers.sprites import SpriteRenderer
from probscene.sampling import sample, seed_everything

ROOT = Path(__file__).resolve().parents[2]
FILE = ROOT / "examples" / "blood_smear.py"
COUNTED = FILE.with_name("blood_smear_counted.csv")
MODEL, SOURCE = load_model(str(FILE)), runpy.run_path(str(FILE))
CLASSES = ("rbc", "wbc", "platelet")


def photographs(folder: Path, number: int) -> Path:
    """Images of one colour each, none of another's."""
    folder.mkdir()
    for i in range(number):
        assert cv2.imwrite(
            str(folder / f"{i}.{('png', 'jpg', 'jpeg')[i % 3]}"), np.full((480, 640, 3), 20 * i, np.uint8)
        )
    return folder


@pytest.fixture(scope="module")
def scenes():
    seed_everything(0)
    drawn = sample(MODEL, MODEL.prior, 100)
    return drawn, SpriteRenderer(MODEL.canvas, threads=1)(drawn.drawing)


def test_a_newcomer_reads_it_in_one_go():
    assert len(FILE.read_text(encoding="utf-8").splitlines()) < 200


def test_grammar_program_and_looks_are_sound():
    report = check(MODEL)
    assert not report.faults and not report.warnings
    assert MODEL.classes == CLASSES


def test_the_script_sets_photographs_above_scenes(tmp_path, script):
    out = tmp_path / "beside.png"
    done = script(FILE, photographs(tmp_path / "photographs", 9), "--out", out)
    assert done.returncode == 0, done.stderr
    height, width = MODEL.canvas
    rows = cv2.imread(str(out)).reshape(4, height, 4, width, 3).transpose(0, 2, 1, 3, 4).reshape(16, -1)
    assert (rows[:8].std(1) < 2).all() and (rows[8:].std(1) > 2).all()
    assert len(np.unique(rows.astype(int).mean(1))) == 16  # each once


@pytest.mark.parametrize(("number", "out"), [(7, "beside.png"), (8, "no/such/folder/beside.png")])
def test_the_script_says_what_it_expects(tmp_path, number, out, monkeypatch, capsys):
    folder = photographs(tmp_path / "photographs", number)
    monkeypatch.setattr(sys, "argv", [str(FILE), str(folder), "--out", str(tmp_path / out)])
    with pytest.raises(SystemExit) as end:
        SOURCE["main"]()
    assert end.value.code == 2 and "expected" in capsys.readouterr().err


def test_cells_are_drawn_where_they_can_be_seen(scenes):
    drawn, batch = scenes
    cells = drawn.derivation.kind >= 0
    height, width = MODEL.canvas
    assert torch.equal(batch.kind >= 0, cells)
    for layer in drawn.drawing.layers[1:5]:
        x, y = layer.x[layer.present], layer.y[layer.present]
        assert (-25 < x).all() and (x < width + 25).all() and (-25 < y).all() and (y < height + 25).all()
    assert (batch.pixels[cells] > 0).float().mean() > 0.98
    for name, size in zip(CLASSES, (52, 98, 11.5), strict=True):  # pixels, half of the photographs'
        box = batch.amodal_box[batch.kind == MODEL.grammar.kind(name)]
        assert (box[:, 2:] - box[:, :2]).prod(1).sqrt().median() == pytest.approx(size, rel=0.15), name


def test_red_cells_are_red_and_others_violet(scenes):
    _, batch = scenes
    kind = batch.kind.gather(1, (batch.instance.long() - 1).clamp(min=0).flatten(1)).view(batch.instance.shape)
    colour = {}
    for name in CLASSES:
        seen = (batch.instance > 0) & (kind == MODEL.grammar.kind(name))
        colour[name] = batch.image.permute(0, 2, 3, 1)[seen].float().mean(0)
    red, _, blue = colour["rbc"]
    assert red > blue + 10
    assert all(colour[name][2] > colour[name][0] + 20 for name in ("wbc", "platelet"))


@settings(max_examples=30, deadline=None)
@given(
    st.lists(st.tuples(st.floats(0.45, 0.55), st.floats(0.45, 0.55)), min_size=2, max_size=2, unique=True),
    st.tuples(st.floats(5, 40), st.floats(5, 40)),
    st.floats(0, 1),
)
def test_two_cells_push_one_another_apart_and_the_smaller_one_farther(places, radii, close):
    x, y = (torch.tensor([values], dtype=torch.float64) for values in zip(*places, strict=True))
    radius = torch.tensor([radii], dtype=torch.float64)
    there, away = torch.ones(1, 2, dtype=torch.bool), torch.tensor([[close]], dtype=torch.float64)
    before = SOURCE["settled"](x, y, radius, ~there, away)  # nobody there: where they would lie alone
    after = SOURCE["settled"](x, y, radius, there, away)
    distance = [float(torch.hypot(*(values[0, 0] - values[0, 1] for values in where))) for where in (before, after)]
    assert distance[1] >= distance[0] - 1e-6
    moved = torch.hypot(after[0] - before[0], after[1] - before[1])[0]
    smaller = int(radius[0].argmin())
    assert moved[smaller] >= moved[1 - smaller] - 1e-6
    if distance[0] >= close * sum(radii):
        assert moved.max() < 1e-6


def test_what_was_counted_by_eye_has_the_models_classes():
    rows = list(csv.DictReader(COUNTED.read_text(encoding="utf-8").splitlines()))
    assert tuple(rows[0]) == ("image", *CLASSES)
    assert len({row["image"] for row in rows}) == 15
    assert all(int(row[name]) >= 0 for row in rows for name in CLASSES)
    assert 20 < np.mean([int(row["rbc"]) for row in rows]) < 40
