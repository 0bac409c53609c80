"""Crops of objects, of photographs and of scenes, by size."""

from types import SimpleNamespace

import numpy as np
import pyro
import pyro.distributions as dist
import pytest

from probscene.app.datasets.generate import generate_scenes
from probscene.app.labels.boxes import read_boxes
from probscene.app.views.crops import NUM_CROPS, object_crops
from probscene.dataset import ImageFolder
from probscene.drawing import Sprites
from probscene.grammar import Grammar
from probscene.model import SceneModel, scene_model
from probscene.structure import StructurePrior, counts, weights

GRAMMAR = Grammar("Scene -> Dots\nDots -> Dot Dots | ε\nDot -> red | blue")
PRIOR = StructurePrior(GRAMMAR, Dots=counts(0, 1), Dot=weights(1, 1))
COLOURS = {"red": 0, "blue": 2}  # channels


def dots(largest: float, classes: tuple[str, ...] = ("red", "blue")) -> SceneModel:
    @scene_model(GRAMMAR, PRIOR, canvas=(64, 64), max_steps=16, classes=classes)
    def dots(scene):
        with scene.nodes("red", "blue"):
            x, y = (pyro.sample(f"dot.{name}", dist.Uniform(10.0, 54.0)) for name in "xy")
            radius = pyro.sample("dot.radius", dist.Uniform(3.0, largest))
        return scene.draw(
            Sprites.disc("red", x, y, radius=radius, tint=(1.0, 0.2, 0.2)),
            Sprites.disc("blue", x, y, radius=radius, tint=(0.2, 0.2, 1.0)),
        )

    return dots


@pytest.fixture(scope="module")
def target(tmp_path_factory) -> SimpleNamespace:
    folder = tmp_path_factory.mktemp("target")
    generate_scenes(dots(8.0), PRIOR, 80, folder, 3, "coco")
    images = ImageFolder(folder / "images", (64, 64), 3)
    return SimpleNamespace(images=images, boxes=read_boxes(folder / "annotations.json", dots(5.0), images))


def test_crops_of_a_class_have_one_scale_and_go_from_small_to_large(target):
    found = object_crops(SimpleNamespace(model=dots(5.0)), {"prior": PRIOR}, target.images, target.boxes)
    assert list(found) == ["red", "blue"]
    sides = np.concatenate([(each[:, 3:] - each[:, 1:3]).numpy() for each in target.boxes.boxes])
    classes = np.concatenate([each[:, 0] for each in target.boxes.boxes])
    for number, (name, sources) in enumerate(found.items()):
        assert list(sources) == ["target", "prior"]
        own, prior = sources["target"], sources["prior"]
        assert own.number == (classes == number).sum() and len(own.images) == len(prior.images) == NUM_CROPS
        assert own.median == pytest.approx(np.median(sides[classes == number], 0), abs=1.0)
        assert own.median > prior.median
        assert len({image.shape for crops in sources.values() for image in crops.images}) == 1
        for crops in sources.values():
            middle = crops.images[0].shape[0] // 2
            assert all(image[middle, middle].argmax() == COLOURS[name] for image in crops.images)
            covered = [(image[..., COLOURS[name]] > image[..., 2 - COLOURS[name]]).sum() for image in crops.images]
            small, middling, large = np.array(covered).reshape(3, -1).mean(1)  # boxes of equal area come in any order
            assert small < middling < large


def test_what_has_no_object_has_no_crop(target):
    run = SimpleNamespace(model=dots(5.0, classes=("red",)))
    assert object_crops(run, {}, target.images, None) == {} == object_crops(run, {}, None, target.boxes)
    assert list(object_crops(run, {"prior": PRIOR}, None, None)["red"]) == ["prior"]
