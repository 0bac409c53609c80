"""Labelled images drawn for a trial: bright discs and dark squares on a dull ground."""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from probscene.app.detectors.folder import TrainedDetector
from probscene.app.detectors.train import TrainOptions, train
from probscene.app.trial.trial import TrainingBudget

SIDE = 64


def draw_set(
    folder: Path, number: int, seed: int, classes: tuple[str, ...] = ("disc", "square"), side: int = SIDE
) -> Path:
    """A folder of COCO with ``number`` images, one to three objects in each."""
    random = np.random.default_rng(seed)
    (folder / "images").mkdir(parents=True)
    images, labels = [], []
    for i in range(number):
        image = random.integers(100, 130, (side, side, 3)).astype(np.uint8)
        for _ in range(random.integers(1, 4)):
            c, r = int(random.integers(0, 2)), int(random.integers(7, 11))
            x, y = (int(v) for v in random.integers(r, side - r, 2))
            if c == 0:
                cv2.circle(image, (x, y), r, (60, 230, 250), -1)
            else:
                cv2.rectangle(image, (x - r, y - r), (x + r, y + r), (20, 20, 90), -1)
            box = [x - r, y - r, 2 * r + 1, 2 * r + 1]
            labels.append({"id": len(labels) + 1, "image_id": i, "category_id": c + 1, "bbox": box, "iscrowd": 0})
        cv2.imwrite(str(folder / "images" / f"{i:03d}.png"), image)
        images.append({"id": i, "file_name": f"{i:03d}.png", "height": side, "width": side})
    categories = [{"id": i, "name": name} for i, name in enumerate(classes, 1)]
    record = {"images": images, "annotations": labels, "categories": categories}
    (folder / "annotations.json").write_text(json.dumps(record), encoding="utf-8")
    return folder


def change(folder: Path, how: Callable[[dict], None]) -> Path:
    """Change a set's labels."""
    file = folder / "annotations.json"
    record = json.loads(file.read_text(encoding="utf-8"))
    how(record)
    file.write_text(json.dumps(record), encoding="utf-8")
    return folder


@pytest.fixture(scope="session")
def photographs(tmp_path_factory) -> Path:
    """The same of the classes of the model of discs; shapes and colours are others."""
    folder = tmp_path_factory.mktemp("photographs")
    draw_set(folder / "train", 8, 1, ("red", "blue"))
    draw_set(folder / "test", 6, 2, ("red", "blue"))
    return folder


@pytest.fixture(scope="session")
def trained(discs, photographs, tmp_path_factory) -> TrainedDetector:
    """A detector that was trained for four steps and is tested on six photographs."""
    out = tmp_path_factory.mktemp("trained") / "detector"
    return train(discs.file, photographs / "train", None, out, small_options(test=photographs / "test"))


def small_options(**more) -> TrainOptions:
    """Options of a training of four steps."""
    budget = TrainingBudget(iterations=4, batch_size=2)
    return TrainOptions(**{"generate": 4, "size": (64, 64), "budget": budget, **more})


@pytest.fixture(scope="session")
def drawn(tmp_path_factory) -> Path:
    """Eight images to train on and six to test on, ``train`` and ``test``."""
    folder = tmp_path_factory.mktemp("drawn")
    draw_set(folder / "train", 8, 1)
    draw_set(folder / "test", 6, 2)
    return folder
