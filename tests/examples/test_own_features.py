"""The example of features of one's own: both forms go the whole path, and the network counts what is seen."""

import re
from pathlib import Path

import pytest
import torch

import probscene as ps
from probscene.app.fitting.rendered_features import RenderedFeatures
from probscene.app.modules import import_file

EXAMPLES = Path(__file__).parents[2] / "examples"
FILE = EXAMPLES / "own_features.py"
OWN = import_file(FILE)
MODEL = ps.load_model(EXAMPLES / "tabletop.py")


def test_a_newcomer_reads_it_in_one_go():
    assert len(FILE.read_text(encoding="utf-8").splitlines()) < 120


@pytest.fixture(scope="module")
def few_steps(tmp_path_factory):
    """The example with fewer steps."""
    file = tmp_path_factory.mktemp("features") / "own_features.py"
    file.write_text(re.sub(r"steps: int = \d+", "steps: int = 4", FILE.read_text(encoding="utf-8")), encoding="utf-8")
    return file


def test_the_short_form_is_fitted(both_ways):
    ways = both_ways(["--features", f"{FILE}:Colours"], {"features": OWN.Colours()})
    assert ways.python.feature_names == OWN.Colours.names
    assert ps.Run.open(ways.command).feature_names == OWN.Colours.names
    assert ways.python.evaluate(num=50, progress=False).record()


def test_the_long_form_is_fitted(both_ways, few_steps):
    ways = both_ways(["--features", f"{few_steps}:TinyCounts"], {"features": OWN.TinyCounts(steps=4)})
    lines = (ways.command / "log.jsonl").read_text().splitlines()
    assert sum('"features"' in line for line in lines) == 4
    run = ps.Run.open(ways.command)
    assert run.record["config"]["features"] == f"{few_steps}:TinyCounts" and run.features.resolution == 0.5
    again = ps.Run.open(ways.python.path, features=OWN.TinyCounts(steps=4))
    images = torch.randint(0, 256, (2, 3, 256, 256), dtype=torch.uint8)
    assert torch.equal(run.network().embed(images), again.network().embed(images))


@pytest.mark.parametrize("stage", ["features", "structure"])
def test_it_goes_on_to_the_same_bytes(goes_on, stage):
    goes_on(stage, features=OWN.TinyCounts(steps=3))


def test_it_learns_to_count():
    ps.seed_everything(0)
    renders, net = RenderedFeatures(MODEL, 1), OWN.TinyNet(MODEL.classes)
    shown = renders.draw(100)
    counts = OWN.visible_counts(shown, len(MODEL.classes))
    OWN.TinyTraining(net, renders, 80, seed=1).run()
    assert ((net.embed(shown.image) - counts).square().mean(0) < 0.5 * counts.var(0)).all()
