"""Multi-MNIST: the prior's and the target's distributions against the analytic ones, and where the digits stand."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chisquare, kstest

from probscene.app.loading import load_model
from probscene.checks import check
from probscene.models.digits import shipped
from probscene.models.multi_mnist import CLASSES, GRAMMAR, MODEL, target
from probscene.renderers.sprites import SpriteRenderer
from probscene.sampling import run_program, sample, seed_everything
from probscene.structure import StructurePrior, counts

DIGITS = [GRAMMAR.kind(name) for name in CLASSES]


@pytest.fixture(autouse=True)
def _digits_of_the_install(monkeypatch):
    monkeypatch.delenv("PROBSCENE_MNIST", raising=False)


def corners(layer) -> torch.Tensor:
    """``(digits, 4, 2)`` the corners of the glyphs, by the rotation's definition."""
    x, y, angle = layer.x[layer.present], layer.y[layer.present], layer.angle[layer.present]
    cos, sin = angle.cos(), angle.sin()
    square = ((-14, -14), (14, -14), (14, 14), (-14, 14))
    return torch.stack([torch.stack([x + u * cos + v * sin, y - u * sin + v * cos], 1) for u, v in square], 1)


def marginals(model, number: int) -> tuple[np.ndarray, np.ndarray]:
    """How often each number of digits and each digit came up."""
    count = sample(model, model.prior, number).derivation.counts(len(GRAMMAR.kinds))[:, DIGITS]
    return np.bincount(count.sum(1), minlength=11), count.sum(0).numpy()


def test_the_model_is_sound():
    report = check(MODEL)
    assert not report.faults and not report.warnings
    assert report.longer == 0.0
    assert (MODEL.canvas, MODEL.max_steps, MODEL.classes, MODEL.channels) == ((256, 256), 32, tuple("0123456789"), 1)


def test_every_scene_has_a_ground_and_up_to_fifteen_digits_fit():
    prior = StructurePrior(GRAMMAR, Digits=counts(*[0] * 15, 1))
    derivation = sample(MODEL, prior, 3).derivation
    assert derivation.counts(len(GRAMMAR.kinds))[:, GRAMMAR.kind("bg")].tolist() == [1, 1, 1]
    assert derivation.lengths.tolist() == [MODEL.max_steps] * 3


def test_the_prior_is_uniform():
    number, digit = marginals(MODEL, 5000)
    assert chisquare(number).pvalue > 1e-3 and len(number) == 11
    assert chisquare(digit).pvalue > 1e-3


def test_the_prior_places_digits_uniformly_and_independently():
    scenes = sample(MODEL, MODEL.prior, 1000)
    assert set(scenes.parameters) == {"digit.x", "digit.y", "digit.angle", "digit.exemplar"}
    present = scenes.drawing.layers[0].present
    inside = {}
    for name, value in scenes.parameters.items():
        assert (scenes.site_mask[name] == present).all()
        low, width = {"angle": (-math.pi / 6, math.pi / 3), "exemplar": (0, 1)}.get(name.split(".")[1], (20, 216))
        inside[name] = ((value[present] - low) / width).numpy()
        assert kstest(inside[name], "uniform").pvalue > 1e-3
    assert abs(np.corrcoef(list(inside.values())) - np.eye(4)).max() < 0.05


@given(st.integers(0, 2**32 - 1))
def test_no_glyph_of_the_prior_leaves_the_canvas(seed):
    seed_everything(seed)
    layer = sample(MODEL, MODEL.prior, 20).drawing.layers[0]
    assert (layer.scale_x == 1).all() and (layer.scale_y == 1).all()
    assert ((corners(layer) >= 0) & (corners(layer) <= 256)).all()


@pytest.mark.parametrize("x", [20.0, 236.0])
@pytest.mark.parametrize("angle", [-math.pi / 6, math.pi / 6])
def test_no_glyph_leaves_the_canvas_at_the_ends_of_the_range(x, angle):
    derivation = sample(MODEL, MODEL.prior, 8).derivation
    shape = derivation.kind.shape
    ends = {"digit.x": x, "digit.y": x, "digit.angle": angle}
    layer = run_program(MODEL, derivation, {k: torch.full(shape, v) for k, v in ends.items()}).drawing.layers[0]
    assert ((corners(layer) >= 0) & (corners(layer) <= 256)).all()


@given(st.integers(1, 15), st.integers(0, 2**32 - 1))
def test_the_target_is_an_upright_centred_row_of_even_spacing(number, seed):
    model = target(seed)
    layer = sample(model, StructurePrior(GRAMMAR, Digits=counts(*[0] * number, 1)), 2).drawing.layers[0]
    assert (layer.angle[layer.present] == 0).all() and (layer.scale_x[layer.present] == 1).all()
    assert (layer.y[layer.present] == 128).all()
    for x in (layer.x[i][layer.present[i]] for i in range(2)):
        assert len(x) == number
        assert x[0] + x[-1] == 256
        assert (x == x.round()).all()
        assert x[0] >= 14 and x[-1] <= 242
        if number > 1:
            spacing = x.diff()
            assert (spacing == spacing[0]).all()
            assert abs(spacing[0] - 256 / (number + 1)) < 2


def test_a_glyph_of_the_target_keeps_its_bytes():
    model = target(0)
    scenes = sample(model, StructurePrior(GRAMMAR, Digits=counts(0, 1)), 20)
    images = SpriteRenderer(model.canvas, threads=1)(scenes.drawing).image
    layer = scenes.drawing.layers[0]
    for image, sprite in zip(images, layer.sprite[layer.present], strict=True):
        glyph = torch.from_numpy(shipped(True).atlas.sprites[sprite][..., 3].copy())
        assert (image[:, 114:142, 114:142] == glyph).all()
        assert image.sum() == 3 * glyph.sum()


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_target_keeps_to_its_analytic_marginals(seed):
    rng = np.random.default_rng(seed)
    want_number, want_digit = rng.dirichlet([1.0] * 11), rng.dirichlet([1.0] * 10)
    number, digit = marginals(target(seed), 5000)
    assert chisquare(number, want_number * number.sum()).pvalue > 1e-3
    assert chisquare(digit, want_digit * digit.sum()).pvalue > 1e-3


@given(st.integers(0, 2**63), st.integers(0, 2**63))
@settings(max_examples=10)
def test_a_seed_gives_one_target_and_another_seed_another(one, other):
    assert torch.equal(target(one).prior.table, target(one).prior.table)
    if one != other:
        assert not torch.equal(target(one).prior.table, target(other).prior.table)


def test_making_a_target_touches_no_global_generator():
    torch_state, numpy_state = torch.get_rng_state(), np.random.get_state()[1].copy()
    target(3)
    assert torch.equal(torch_state, torch.get_rng_state())
    assert (numpy_state == np.random.get_state()[1]).all()


def test_dirichlet_one_is_uniform_on_the_simplex():
    """Each coordinate of a uniform point of the simplex over c classes is Beta(1, c - 1)."""
    derivation = sample(MODEL, StructurePrior(GRAMMAR, Digits=counts(1)), 1).derivation
    empty = [float(target(seed).prior.log_prob(derivation).exp()) for seed in range(300)]
    assert kstest(empty, "beta", (1, 10)).pvalue > 1e-3


def test_the_same_seed_gives_the_same_scenes():
    drawings = []
    for _ in range(2):
        seed_everything(5)
        drawings.append(sample(target(7), target(7).prior, 10).drawing.layers[0])
    assert torch.equal(drawings[0].sprite, drawings[1].sprite) and torch.equal(drawings[0].x, drawings[1].x)


def test_model_and_target_share_no_exemplar():
    model, truth = (sample(m, m.prior, 5).drawing.layers[0].atlas for m in (MODEL, MODEL.target(0)))
    assert model is shipped(False).atlas and truth is shipped(True).atlas
    assert not {s.tobytes() for s in model.sprites} & {s.tobytes() for s in truth.sprites}


def test_the_environment_names_another_folder_of_digits(data_dir, monkeypatch):
    if not (data_dir / "mnist").is_dir():
        pytest.skip(f"no folder mnist in {data_dir}")
    monkeypatch.setenv("PROBSCENE_MNIST", str(data_dir / "mnist"))
    truth = load_model("multi_mnist").target(0)
    atlas = sample(truth, truth.prior, 2).drawing.layers[0].atlas
    assert len(atlas) == 10_000
