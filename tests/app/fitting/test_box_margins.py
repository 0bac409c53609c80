"""The room that labels leave around a target's objects, found by the model's scenes and taken off."""

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from probscene.app.datasets.generate import DatasetOptions, generate_scenes
from probscene.app.fitting.box_margins import box_margins, margins_said, without_margins
from probscene.app.labels.boxes import Boxes, read_boxes
from probscene.dataset import ImageFolder
from probscene.drawing import Sprites
from probscene.grammar import Grammar
from probscene.model import SceneModel, scene_model
from probscene.structure import StructurePrior, counts, weights

GRAMMAR = Grammar("Scene -> Dots\nDots -> Dot Dots | ε\nDot -> red | blue")
PRIOR = StructurePrior(GRAMMAR, Dots=counts(0, 1, 1, 1), Dot=weights(1, 1))


def dots(radius: float) -> SceneModel:
    @scene_model(GRAMMAR, PRIOR, canvas=(96, 96), max_steps=16, classes=("red", "blue"))
    def dots(scene):
        with scene.nodes("red", "blue"):
            x, y = (pyro.sample(f"dot.{name}", dist.Uniform(16.0, 80.0)) for name in "xy")
        return scene.draw(
            Sprites.disc("red", x, y, radius=radius, tint=(1.0, 0.2, 0.2)),
            Sprites.disc("blue", x, y, radius=6.0, tint=(0.2, 0.2, 1.0)),
        )

    return dots


@pytest.mark.parametrize(("room", "found"), [({}, {}), ({"red": 4, "blue": 2}, {"red": 4, "blue": 2})])
def test_the_room_of_each_class_is_found_though_the_models_objects_are_smaller(tmp_path, room, found):
    model, photographed = dots(6.0), dots(9.0)
    options = DatasetOptions(box_margin=room or 0)
    generate_scenes(photographed, PRIOR, 60, tmp_path / "target", 3, "coco", options=options)
    target = ImageFolder(tmp_path / "target" / "images", (96, 96), 3)
    boxes = read_boxes(tmp_path / "target" / "annotations.json", model, target)
    margins = box_margins(model, boxes, target)
    assert {name: round(margin.pixels) for name, margin in margins.items()} == found
    if found:
        assert "--box-margin red=4,blue=2." in margins_said(margins)
    sides = np.concatenate([(each[:, 3:] - each[:, 1:3]).numpy() for each in without_margins(boxes, margins).boxes])
    classes = np.concatenate([each[:, 0] for each in boxes.boxes])
    for number, side in enumerate((18, 12)):
        assert np.median(sides[classes == number]) == pytest.approx(side, abs=1.5)


def test_images_without_a_box_have_no_margin(tmp_path):
    boxes = Boxes([0, 1], (torch.zeros(0, 5), torch.zeros(0, 5)), ("red", "blue"))
    assert box_margins(dots(6.0), boxes, None) == {}
    assert without_margins(boxes, {}) is boxes


@given(st.integers(0, 30), st.integers(1, 40))
def test_some_of_the_images_keep_their_boxes(number, most):
    each = tuple(torch.full((1, 5), float(i)) for i in range(number))
    some = Boxes(list(range(100, 100 + number)), each, ("red",), scores=each).some(most)
    assert len(some.rows) == len(set(some.rows)) == min(number, most) and some.rows == sorted(some.rows)
    assert (
        [int(box[0, 0]) + 100 for box in some.boxes] == [int(score[0, 0]) + 100 for score in some.scores] == some.rows
    )
