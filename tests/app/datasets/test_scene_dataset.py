"""The torch dataset: what ``generate`` writes, as a detector's targets, the same for any number of workers."""

import copy
import json
import multiprocessing
from dataclasses import replace
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from pycocotools import mask as rle
from torch.utils.data import DataLoader
from torchvision.models.detection import ssdlite320_mobilenet_v3_large

from probscene.app.datasets import scene_dataset
from probscene.app.datasets.generate import generate, generate_scenes
from probscene.app.datasets.scene_dataset import SceneDataset
from probscene.app.fitting.run import RunFolder
from probscene.app.loading import load_model
from probscene.errors import ModelError, ProbsceneError, RunError

PLATES = Path(__file__).parents[1] / "plates.py"
NUM = 100  # a chunk and a part of another
pytestmark = [
    pytest.mark.filterwarnings("ignore:__array__ implementation doesn't:DeprecationWarning"),  # of pycocotools
    pytest.mark.filterwarnings("ignore:This DataLoader will create:UserWarning"),  # more workers than cores
]


@pytest.fixture(scope="module")
def model():
    return load_model(str(PLATES))


@pytest.fixture(scope="module")
def samples() -> list:
    return list(SceneDataset(PLATES, NUM, seed=5))


def loaded(dataset: SceneDataset, batch_size: int, workers: int, context, batches: int | None = None) -> list:
    """What a loader gives, sample by sample."""
    loader = DataLoader(
        dataset, batch_size, collate_fn=SceneDataset.collate, num_workers=workers, multiprocessing_context=context
    )
    return [one for images, targets in islice(loader, batches) for one in zip(images, targets, strict=True)]


def flat(sample) -> tuple:
    """A sample in bytes, with the shapes and types."""
    image, target = sample
    tensors = {"image": image, **{key: value for key, value in target.items() if key != "image_id"}}
    parts = [(key, value.dtype, tuple(value.shape), value.numpy().tobytes()) for key, value in tensors.items()]
    return target["image_id"], *parts


def same(left: list, right: list) -> bool:
    return [flat(one) for one in left] == [flat(one) for one in right]


def agrees(samples: list, folder: Path) -> None:
    """Compare samples with the images and annotations of a dataset's folder."""
    dataset = json.loads((folder / "annotations.json").read_text())
    for i, (image, target) in enumerate(samples):
        file = cv2.imread(str(folder / "images" / f"{i:06d}.png"))[..., ::-1]
        assert image.dtype == torch.float32 and image.is_contiguous()
        assert torch.equal(image, torch.from_numpy(file.astype(np.float32)).permute(2, 0, 1) / 255)
        found = [annotation for annotation in dataset["annotations"] if annotation["image_id"] == i]
        assert target["image_id"] == i and len(target["boxes"]) == len(found)
        boxes = [[x, y, x + w, y + h] for x, y, w, h in (one["bbox"] for one in found)]
        assert torch.equal(target["boxes"], torch.tensor(boxes, dtype=torch.float32).reshape(-1, 4))
        assert torch.equal(target["labels"], torch.tensor([one["category_id"] for one in found], dtype=torch.int64))
        assert torch.equal(target["area"], torch.tensor([one["area"] for one in found], dtype=torch.float32))
        assert torch.equal(target["iscrowd"], torch.zeros(len(found), dtype=torch.int64))
        assert target["masks"].dtype == torch.uint8 and target["masks"].shape == (len(found), *file.shape[:2])
        for mask, one in zip(target["masks"], found, strict=True):
            assert (mask.numpy() == rle.decode(one["segmentation"])).all()


def test_samples_are_what_generate_writes(model, samples, tmp_path):
    generate_scenes(model, model.prior, NUM, tmp_path / "out", seed=5)
    assert len(samples) == len(SceneDataset(PLATES, NUM)) == NUM
    agrees(samples, tmp_path / "out")
    assert any(len(target["labels"]) == 0 for _, target in samples)


def test_samples_of_a_run_are_what_it_generates(fitted, tmp_path):
    run = RunFolder.at(fitted)
    generate(run, 10, tmp_path / "out", seed=2)
    dataset = SceneDataset(fitted, 10, seed=2)
    assert dataset.classes == ("red", "blue") and dataset.model.name == "discs"
    agrees(list(dataset), tmp_path / "out")
    assert same(list(SceneDataset(run, 10, seed=2)), list(dataset))
    assert same(list(SceneDataset(run.model, 10, seed=2, policy=run.guide)), list(dataset))


def test_grey_images_have_three_equal_channels(model, tmp_path):
    dull = replace(model, channels=1)
    generate_scenes(dull, model.prior, 5, tmp_path / "out")
    agrees(list(SceneDataset(dull, 5)), tmp_path / "out")


@pytest.mark.parametrize(("batch_size", "workers"), [(8, 1), (8, 2), (24, 3)])
def test_same_order_for_any_number_of_workers(samples, workers, batch_size, ready):
    """One that is spawned as well as several that are ready at once."""
    dataset = SceneDataset(PLATES, NUM, seed=5, batch_size=batch_size)
    assert same(loaded(dataset, batch_size, workers, "spawn" if workers == 1 else ready), samples)
    assert not multiprocessing.active_children()


def test_without_the_batch_size_the_same_samples(samples, ready):
    dataset = SceneDataset(PLATES, NUM, seed=5)
    found = loaded(dataset, 7, 2, ready)
    assert not same(found, samples)
    assert same(sorted(found, key=lambda sample: sample[1]["image_id"]), samples)
    assert same(loaded(dataset, 64, 2, ready), samples)


@given(st.integers(1, 200), st.integers(1, 5), st.integers(1, 100) | st.none())
def test_shares_are_a_partition_by_turns(num, workers, batch_size):
    """Against a loader's way with batches, worker after worker, without rendering."""
    dataset = SceneDataset("multi_mnist", num, batch_size=batch_size)
    share = batch_size or 64
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scene_dataset, "draw_chunk", lambda model, policy, seed, chunk: Stub(64 * chunk))
        patch.setattr(scene_dataset, "renderer_for", lambda model, threads: lambda drawing: drawing)
        patch.setattr(SceneDataset, "_samples", lambda self, model, render, drawing, *rest: iter(check_slice(*rest)))
        whole = list(dataset)
        shares = []
        for worker in range(workers):
            info = torch.utils.data._utils.worker.WorkerInfo(id=worker, num_workers=workers, seed=0, dataset=dataset)
            patch.setattr(scene_dataset, "get_worker_info", lambda info=info: info)
            shares.append(list(dataset))
    assert whole == list(range(num)) == sorted(sum(shares, []))
    turns = [whole[i : i + share] for i in range(0, num, share)]
    assert shares == [sum(turns[worker::workers], []) for worker in range(workers)]


class Stub:
    """Scenes whose drawing is the list of their numbers."""

    def __init__(self, first):
        self.drawing = list(range(first, first + 64))


def check_slice(batch, first):
    assert batch[0] == first
    return batch


def test_epochs_go_on_where_the_one_before_ended(samples):
    dataset = SceneDataset(PLATES, 64, seed=5)
    assert same(list(dataset), samples[:64])
    dataset.set_epoch(1)
    second = list(dataset)
    assert same(second[: NUM - 64], samples[64:]) and [t["image_id"] for _, t in second] == list(range(64, 128))
    short = SceneDataset(PLATES, 3, seed=5)
    short.set_epoch(1)
    assert same(list(short), second[:3])  # a chunk is never begun twice


def test_an_endless_dataset(samples, ready):
    dataset = SceneDataset(PLATES, seed=5, batch_size=4)
    assert same(list(islice(dataset, NUM)), samples)
    assert same(loaded(dataset, 4, 2, ready, batches=20), samples[:80])
    dataset.set_epoch(2)
    assert next(iter(dataset))[1]["image_id"] == 2 * 2**26
    with pytest.raises(TypeError, match="give SceneDataset a num"):
        len(dataset)
    assert dataset


def test_workers_that_persist_see_the_epoch(ready):
    dataset = SceneDataset(PLATES, 8, batch_size=4)
    loader = DataLoader(
        dataset, 4, collate_fn=SceneDataset.collate, num_workers=1, multiprocessing_context=ready,
        persistent_workers=True,
    )  # fmt: skip
    ids = []
    for epoch in range(3):
        dataset.set_epoch(epoch)
        ids.append([target["image_id"] for _, targets in loader for target in targets])
    assert ids == [list(range(64 * epoch, 64 * epoch + 8)) for epoch in range(3)]


def test_seeds_differ(samples):
    pairs = zip(samples, SceneDataset(PLATES, NUM, seed=6), strict=True)
    assert not any(torch.equal(one[0], other[0]) for one, other in pairs if len(one[1]["labels"]))


def test_the_callers_random_numbers_and_threads_are_left_alone():
    before, threads = torch.get_rng_state(), torch.get_num_threads()
    list(SceneDataset(PLATES, 2))
    assert torch.equal(torch.get_rng_state(), before) and torch.get_num_threads() == threads


def test_hardly_visible_objects_are_left_out(model, samples, tmp_path):
    generate_scenes(model, model.prior, NUM, tmp_path / "out", seed=5)
    annotations = json.loads((tmp_path / "out" / "annotations.json").read_text())["annotations"]
    for least in (0.5, 1.0):
        kept = list(SceneDataset(PLATES, NUM, seed=5, min_visible=least))
        boxes = [[x, y, x + w, y + h] for x, y, w, h in
                 (one["bbox"] for one in annotations if one["visible_fraction"] >= least)]  # fmt: skip
        assert [box.tolist() for _, target in kept for box in target["boxes"]] == boxes
        assert 0 < len(boxes) < sum(len(target["boxes"]) for _, target in samples)


@pytest.mark.filterwarnings("ignore:.*use of fork:DeprecationWarning")  # of Python 3.12, rightly
def test_a_fork_after_rendering_is_a_clear_error(samples):
    loader = DataLoader(
        SceneDataset(PLATES, 4), collate_fn=SceneDataset.collate, num_workers=1, multiprocessing_context="fork"
    )
    with pytest.raises(ProbsceneError, match="'spawn'"):
        list(loader)


def test_a_model_that_no_other_process_can_load_is_a_clear_error(model, ready):
    loader = DataLoader(SceneDataset(model, 4), num_workers=1, multiprocessing_context=ready)
    with pytest.raises(ModelError, match="name its file"):
        list(loader)
    assert len(list(SceneDataset(model, 4))) == 4


def test_it_can_be_copied(samples):
    dataset = SceneDataset(PLATES, 4, seed=5)
    other = copy.deepcopy(dataset)
    other.set_epoch(1)
    assert same(list(dataset), samples[:4]) and not same(list(other), samples[:4])


def test_a_detector_takes_the_samples(samples):
    detector = ssdlite320_mobilenet_v3_large(weights=None, weights_backbone=None, num_classes=3).train()
    images, targets = SceneDataset.collate(samples[:4])
    losses = detector(images, targets)
    assert all(loss.isfinite() for loss in losses.values())
    sum(losses.values()).backward()


@pytest.mark.parametrize(
    "wrong, message",
    [
        ({"num": 0}, "positive number of images, got 0"),
        ({"batch_size": 0}, "positive number of images of a batch"),
        ({"seed": -1}, "seed of 0 or more"),
        ({"min_visible": 1.5}, "min_visible from 0 to 1"),
        ({"min_visible": float("nan")}, "min_visible from 0 to 1"),
        ({"source": "mnist"}, "expected a built-in model"),
    ],
)
def test_wrong_arguments(wrong, message):
    with pytest.raises(ProbsceneError, match=message):
        SceneDataset(**{"source": PLATES, **wrong})
    with pytest.raises(ProbsceneError, match="epoch of 0 or more"):
        SceneDataset(PLATES).set_epoch(-1)


def test_an_unfinished_run_is_refused(tmp_path):
    run = RunFolder.create(tmp_path / "run", str(PLATES), {"guide": {"hidden": 8}})
    with pytest.raises(RunError, match="unfinished"):
        SceneDataset(run.path)
