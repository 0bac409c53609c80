"""The example that Panda3D draws: it is drawn as the model says, the same each time, and what is there can be seen."""

import importlib.util
from pathlib import Path

import pytest
import torch

from probscene.app.checking.generator_check import check_generator
from probscene.app.fitting.presets import images_drawn
from probscene.app.loading import load_model, renderer_for
from probscene.sampling import sample, seed_everything

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("panda3d") is None, reason="Panda3D is not there: pip install panda3d"
)
FILE = Path(__file__).parents[2] / "examples" / "generators" / "panda3d" / "pallets.py"


@pytest.fixture(scope="module")
def model():
    return load_model(str(FILE))


@pytest.fixture(scope="module")
def drawn(model):
    seed_everything(0)
    scenes = sample(model, model.prior, 60)
    return scenes, renderer_for(model)(scenes.drawing)


def test_bytes_are_the_same_in_fresh_processes(model):
    report = check_generator(model, images_drawn())
    assert not report.differs and report.command == "draw.py"


def test_all_is_seen_where_the_program_puts_it(model, drawn):
    scenes, batch = drawn
    kind, x = scenes.drawing.kind, scenes.drawing.objects[0].values["x"]
    pallet = kind == model.grammar.kind("pallet")
    assert (batch.pixels[pallet] > 0).all() and (batch.pixels[kind >= 0] > 0).float().mean() > 0.95
    middle = (batch.box[..., 0] + batch.box[..., 2]) / 2
    found = torch.corrcoef(torch.stack([middle[pallet], x[pallet]]))
    assert found[0, 1] > 0.97


def test_colours_are_those_of_the_kind(model, drawn):
    scenes, batch = drawn
    red, blue = [], []
    for i, node in (scenes.drawing.kind == model.grammar.kind("pallet")).nonzero().tolist():
        seen = batch.image[i][:, batch.instance[i] == node + 1].double().mean(1)
        red.append(seen[0])
        blue.append(seen[2])
    assert torch.stack(red).mean() > 1.4 * torch.stack(blue).mean()  # wood


def test_the_target_fills_the_first_pallet(model):
    seed_everything(0)
    truth = model.target(0)
    counts = sample(truth, truth.prior, 200).derivation.counts(3)
    assert 2 <= counts[:, 1:].sum(1).float().mean() <= 4.5
