"""The demo's model: digits stay on the canvas, and the target's stand upright in an evenly spaced row."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from probscene.checks import check
from probscene.models.digits import SIZE
from probscene.models.small_digits import CANVAS, GRAMMAR, MAX_DIGITS, MODEL, SCALE, target
from probscene.sampling import sample, seed_everything
from probscene.structure import StructurePrior, counts

HALF = SCALE * SIZE / 2  # of a glyph's side


def test_the_model_is_sound():
    report = check(MODEL)
    assert not report.faults and not report.warnings and report.longer == 0.0


@given(st.integers(0, 2**32 - 1))
def test_no_glyph_of_the_prior_leaves_the_canvas(seed):
    seed_everything(seed)
    layer = sample(MODEL, MODEL.prior, 20).drawing.layers[0]
    x, y, angle = layer.x[layer.present], layer.y[layer.present], layer.angle[layer.present].abs()
    reach = HALF * (angle.cos() + angle.sin())
    assert (angle <= math.radians(30)).all()
    assert all(((at - reach >= 0) & (at + reach <= CANVAS)).all() for at in (x, y))


@pytest.mark.parametrize("number", range(1, MAX_DIGITS + 1))
def test_the_target_is_an_upright_centred_row_of_even_spacing(number):
    layer = sample(target(0), StructurePrior(GRAMMAR, Digits=counts(*[0] * number, 1)), 2).drawing.layers[0]
    assert (layer.angle[layer.present] == 0).all() and (layer.y[layer.present] == CANVAS / 2).all()
    for x in (layer.x[i][layer.present[i]] for i in range(2)):
        even = torch.arange(1, number + 1) * CANVAS / (number + 1)
        assert torch.allclose(x, even) and x[0] - HALF >= 0 and x[-1] + HALF <= CANVAS
