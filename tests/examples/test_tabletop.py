"""The example of a new domain: it runs as a script, loads as a model, and its things stand where they belong."""

import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from probscene.app.loading import load_model
from probscene.checks import check
from probscene.renderers.sprites import SpriteRenderer
from probscene.sampling import sample, seed_everything

ROOT = Path(__file__).parents[2]
FILE = ROOT / "examples" / "tabletop.py"
MODEL = load_model(str(FILE))
PLATE, MUG = MODEL.grammar.kind("plate"), MODEL.grammar.kind("mug")


def run(*arguments: str) -> subprocess.CompletedProcess:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    return subprocess.run([sys.executable, FILE, *arguments], env=environment, capture_output=True, text=True)


def test_a_newcomer_reads_it_in_one_go():
    assert len(FILE.read_text(encoding="utf-8").splitlines()) < 150


@pytest.mark.parametrize(("number", "rows"), [(3, 1), (8, 2)])
def test_the_script_draws_a_grid(tmp_path, number, rows, script):
    out = tmp_path / "grid.png"
    words = ("--num", str(number), "--out", str(out))
    done = run(*words) if rows == 1 else script(FILE, *words)
    assert done.returncode == 0, done.stderr
    grid = cv2.imread(str(out))
    assert grid.shape == (256 * rows, 256 * 4, 3)
    cells = grid.reshape(rows, 256, 4, 256, 3).transpose(0, 2, 1, 3, 4).reshape(-1, 256, 256, 3)
    assert [bool(cell.any()) for cell in cells] == [i < number for i in range(4 * rows)]
    assert len(np.unique(cells[:number].reshape(number, -1), axis=0)) == number


@pytest.mark.parametrize("arguments", [("--num", "0"), ("--num", "1", "--out", "no/such/folder/grid.png")])
def test_the_script_says_what_it_expects(arguments, script):
    done = script(FILE, *arguments)
    assert done.returncode == 2
    assert "expected" in done.stderr and "Traceback" not in done.stderr


@pytest.mark.parametrize("model", [MODEL, MODEL.target(0)], ids=["prior", "target"])
def test_grammar_and_prior_are_sound(model):
    report = check(model)
    assert not report.faults and not report.warnings


@given(st.integers(0, 2**32 - 1))
def test_mugs_stand_on_their_plate_and_plates_apart_on_the_table(seed):
    seed_everything(seed)
    scenes = sample(MODEL, MODEL.prior, 20)
    _, _, plates, mugs = scenes.drawing.layers
    kind, parent = scenes.derivation.kind, scenes.derivation.parent
    assert torch.equal(plates.present, kind == PLATE) and torch.equal(mugs.present, kind == MUG)
    radius, mug_radius = plates.scale_x * 64, mugs.scale_x * 32  # the sprites' silhouettes
    for i in range(20):
        mine = mugs.present[i].nonzero().squeeze(1)
        on = parent[i, mine]
        assert (kind[i, on] == PLATE).all()
        away = torch.hypot(mugs.x[i, mine] - plates.x[i, on], mugs.y[i, mine] - plates.y[i, on])
        assert (away + mug_radius[i, mine] <= radius[i, on]).all()
        dishes = plates.present[i].nonzero().squeeze(1)
        place = torch.stack([plates.x[i, dishes], plates.y[i, dishes]], 1)
        assert ((place - 128).norm(dim=1) + radius[i, dishes] <= 122).all()
        assert (torch.pdist(place) >= 2 * 38).all()


def test_every_plate_and_mug_of_the_prior_is_seen():
    scenes = sample(MODEL, MODEL.prior, 100)
    batch = SpriteRenderer(MODEL.canvas, threads=1)(scenes.drawing)
    labelled = (scenes.derivation.kind == PLATE) | (scenes.derivation.kind == MUG)
    assert torch.equal(batch.kind >= 0, labelled)
    assert (batch.visible[labelled] > 0.4).all()
    assert (batch.visible[batch.kind == MUG] > 0.7).all()


def test_the_first_plate_of_the_target_has_the_mugs():
    model = MODEL.target(0)
    derivation = sample(model, model.prior, 2000).derivation
    first = (derivation.kind == PLATE).int().argmax(1)
    has_plate = (derivation.kind == PLATE).any(1)
    mugs = derivation.kind == MUG
    on_first = (mugs & (derivation.parent == first.unsqueeze(1))).sum(1)[has_plate]
    on_others = mugs.sum(1)[has_plate] - on_first
    others = (derivation.kind == PLATE).sum() - has_plate.sum()
    assert on_first.float().mean() == pytest.approx(2.4, abs=0.1)  # (1 + 2 * 4 + 3 * 5) / 10
    assert on_others.sum() / others < 0.35


def test_targets_are_their_seed_alone():
    assert torch.equal(MODEL.target(1).prior.table, MODEL.target(1).prior.table)
    assert not torch.equal(MODEL.target(1).prior.table, MODEL.target(2).prior.table)
