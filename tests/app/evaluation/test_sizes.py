"""Sizes of objects: right where one knows them, and looks are not better where sizes went wrong."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
from hypothesis import given
from hypothesis import strategies as st

from probscene.app.datasets.generate import generate_scenes
from probscene.app.evaluation.components import KINDS, VerdictComponent, VerdictComponents
from probscene.app.evaluation.sizes import NUM_SCENES, BoxSizes, _medians, compare_sizes, sizes, with_sizes
from probscene.app.fitting.given_boxes import given_boxes
from probscene.dataset import ImageFolder
from probscene.drawing import Sprites
from probscene.grammar import Grammar
from probscene.inference.statistics.residual import RESAMPLES, Grade
from probscene.model import SceneModel, scene_model
from probscene.structure import StructurePrior, counts, weights

GRAMMAR = Grammar("Scene -> Dots\nDots -> Dot Dots | ε\nDot -> red | blue")
PRIOR = StructurePrior(GRAMMAR, Dots=counts(0, 1, 1, 1), Dot=weights(3, 1))


def side(number: int, scale: float = 1.0, seed: int = 0):
    """Boxes of about 20 x 30 pixels, some in each of 50 images."""
    rng = np.random.default_rng(seed)
    size = scale * np.array([20.0, 30.0]) * np.exp(0.2 * rng.normal(size=(number, 2)))
    return BoxSizes(size, rng.integers(0, 50, number), 50)


@pytest.mark.parametrize(
    ("number", "prior", "learnt", "grade", "worse"),
    [
        (600, 1.5, 1.0, Grade.GOOD, False),
        (600, 1.0, 1.0, Grade.GOOD, False),  # sizes that are right are right, whoever made them so
        (600, 1.0, 1.2, Grade.NO_BETTER, True),
        (600, 0.96, 1.15, Grade.NO_BETTER, True),
        (600, 1.2, 1.2, Grade.NO_BETTER, False),
        (600, 1.5, 1.2, Grade.BETTER, False),
        (600, 0.6, 1.2, Grade.BETTER, False),
        (12, 1.05, 1.1, None, False),
    ],
)
def test_the_grade_of_sizes_is_right_where_they_are_known(number, prior, learnt, grade, worse):
    found = compare_sizes(side(number), side(800, prior, 1), side(800, learnt, 2))
    assert (found.grade, found.worse, found.boxes) == (grade, worse, number)
    assert found.low[0] <= found.given[0] <= found.high[0] and found.off_low <= found.off_high
    assert found.learnt == pytest.approx((20 * learnt, 30 * learnt), rel=0.05)


@given(st.lists(st.tuples(st.integers(1, 9), st.integers(0, 3)), min_size=1, max_size=20))
def test_medians_are_those_of_the_boxes_and_a_resample_has_whole_images(rows):
    size, image = np.array([[a, 10.0 - a] for a, _ in rows]), np.array([i for _, i in rows])
    found = _medians(BoxSizes(size, image, 4), np.random.default_rng(0))
    assert found.shape == (1 + RESAMPLES, 2)
    assert found[0].tolist() == [np.quantile(size[:, k], 0.5, method="inverted_cdf") for k in (0, 1)]
    if len(set(image.tolist())) == 1:  # its boxes are then all that a resample has
        assert (found == found[0]).all()


@given(st.sampled_from([*Grade, None]), st.booleans())
def test_looks_are_no_better_than_the_priors_where_sizes_are_worse(looks, worse):
    size = compare_sizes(side(600), side(600), side(600, 1.3 if worse else 1.0))
    grades = {"structure": Grade.GOOD, "layout": Grade.GOOD, "looks": looks}
    before = VerdictComponents({k: VerdictComponent(grades[k], f"{k}.", verdict=str(grades[k])) for k in KINDS}, {}, {})
    found = with_sizes(before, {"red": size})
    assert with_sizes(before, {}) is before and found.parts["sizes"].grade is (Grade.NO_BETTER if worse else Grade.GOOD)
    assert found.parts["looks"].grade is (Grade.NO_BETTER if worse and looks is not None else looks)
    assert found.overall is Grade.NO_BETTER or not worse
    assert "infer={'learn': False}" in found.parts["sizes"].remedy or not worse


def dots(radius: float) -> SceneModel:
    @scene_model(GRAMMAR, PRIOR, canvas=(64, 64), max_steps=16, classes=("red", "blue"))
    def dots(scene):
        with scene.nodes("red", "blue"):
            x = pyro.sample("dot.x", dist.Uniform(0.0, 64.0))
            y = pyro.sample("dot.y", dist.Uniform(8.0, 56.0))
        return scene.draw(
            Sprites.disc("red", x, y, radius=radius, tint=(1.0, 0.2, 0.2)),
            Sprites.disc("blue", x, y, radius=4.0, tint=(0.2, 0.2, 1.0)),
        )

    return dots


def test_boxes_of_labels_are_held_beside_those_of_scenes(tmp_path):
    """Of objects that learning made larger, and of others that it left as they were."""
    model, learnt = dots(5.0), dots(7.0)
    generate_scenes(model, PRIOR, 60, tmp_path / "target", 3, "coco")
    target = ImageFolder(tmp_path / "target" / "images", (64, 64), 3)
    guide = StructurePrior(GRAMMAR, Dots=counts(0, 1, 1, 1), Dot=weights(3, 1))
    guide.with_parameters = lambda model: replace(model, program=learnt.program)
    labels = {"path": str(tmp_path / "target" / "annotations.json")}
    run = SimpleNamespace(model=model, guide=guide, record={"labels": labels}, visible_shares=dict)
    boxes, told = given_boxes(run, target), []
    found = sizes(run, boxes, target, told.append)
    assert found["red"].grade is Grade.NO_BETTER and found["red"].worse and sum(told) == 2 * NUM_SCENES
    assert found["blue"].grade is Grade.GOOD and found["blue"].given == found["blue"].prior == found["blue"].learnt
    assert found["red"].boxes == sum(int((each[:, 0] == 0).sum()) for each in boxes.boxes)
    assert given_boxes(SimpleNamespace(model=model, record={}), target) is None
    labels["path"] = str(tmp_path / "gone.json")
    assert given_boxes(run, target) is None
