"""A least visible fraction: labels are those without one that are visible enough, in every format; all else stays."""

import json
import tarfile
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from probscene.app.datasets.generate import DatasetOptions, generate, generate_scenes
from probscene.app.datasets.scene_dataset import SceneDataset
from probscene.app.fitting.run import RunFolder
from probscene.app.loading import load_model
from probscene.errors import DataError, ProbsceneError

ALL = ("coco", "yolo", "kitti", "webdataset")
NUM, LEAST = 70, (0.25, 0.6, 1.0)
TRAINING = Path("Kitti", "raw", "training")


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.fixture(scope="module", params=["plates", "lots"])
def drawn(request, tmp_path_factory) -> SimpleNamespace:
    """One data set of flat or of 3D scenes in every format, by its least visible fraction."""
    file = Path(__file__).parents[1] / f"{request.param}.py"
    model, folder = load_model(str(file)), tmp_path_factory.mktemp("visible")
    for least in (0.0, *LEAST):
        generate_scenes(
            model, model.prior, NUM, folder / str(least), seed=1, format=ALL, options=DatasetOptions(min_visible=least)
        )
    return SimpleNamespace(file=file, model=model, of=lambda least: folder / str(least))


def annotations(folder: Path) -> list[list[dict]]:
    """By image, without their numbers, which count those that are there."""
    found = [[] for _ in range(NUM)]
    for one in json.loads((folder / "annotations.json").read_text())["annotations"]:
        found[one["image_id"]].append({key: value for key, value in one.items() if key != "id"})
    return found


def lines(folder: Path, i: int) -> list[str]:
    return (folder / f"{i:06d}.txt").read_text().splitlines()


def instances(folder: Path, i: int) -> list[np.ndarray]:
    """The masks in the order of the lines of their classes."""
    png = cv2.imread(str(folder / TRAINING / "instance" / f"{i:06d}.png"), cv2.IMREAD_UNCHANGED)
    return [png == value for value in np.unique(png) if value]


def shard(folder: Path) -> list[list[dict]]:
    with tarfile.open(folder / "shard-000000.tar") as tar:
        return [json.load(tar.extractfile(m))["annotations"] for m in tar if m.name.endswith("json")]


@pytest.mark.parametrize("least", LEAST)
def test_labels_are_those_that_are_visible_enough_in_every_format(drawn, least):
    whole, cut = drawn.of(0.0), drawn.of(least)
    before, after = annotations(whole), annotations(cut)
    kept = [[one["visible_fraction"] >= least for one in found] for found in before]
    assert any(map(any, kept)) and not all(map(all, kept))

    def chosen(found, i):
        return [one for one, keep in zip(found, kept[i], strict=True) if keep]

    shards = shard(whole), shard(cut)
    for i in range(NUM):
        assert after[i] == chosen(before[i], i)
        assert shards[1][i] == chosen(shards[0][i], i)
        for of in ("labels", TRAINING / "label_2"):
            assert lines(cut / of, i) == chosen(lines(whole / of, i), i)
        order = np.argsort([one["category_id"] for one in before[i]], kind="stable")
        masks = [mask for mask, k in zip(instances(whole, i), order, strict=True) if kept[i][k]]
        assert all((x == y).all() for x, y in zip(instances(cut, i), masks, strict=True))


@pytest.mark.parametrize("least", LEAST)
def test_images_and_structures_stay(drawn, least):
    whole, cut = contents(drawn.of(0.0)), contents(drawn.of(least))
    assert whole.keys() == cut.keys()
    same = [name for name in whole if "images" in name or "image_2" in name or "calib" in name or name == "data.yaml"]
    assert all(whole[name] == cut[name] for name in same)
    left, right = (
        [json.loads(line) for line in each["provenance.jsonl"].decode().splitlines()] for each in (whole, cut)
    )
    assert right == [line | {"min_visible": least} for line in left]


@pytest.mark.parametrize("least", (0.0, *LEAST))
def test_the_torch_dataset_has_the_same_labels_with_whole_boxes_and_visible_fractions(drawn, least):
    found = annotations(drawn.of(least))
    for _, target in SceneDataset(drawn.file, NUM, seed=1, min_visible=least):
        same = found[target["image_id"]]
        assert target["labels"].tolist() == [one["category_id"] for one in same]
        assert target["visible"].tolist() == pytest.approx([one["visible_fraction"] for one in same], abs=1e-6)
        boxes = np.array([one["amodal_bbox"] for one in same], np.float32).reshape(-1, 4)
        boxes[:, 2:] += boxes[:, :2]
        assert target["amodal_boxes"].shape == target["boxes"].shape
        assert np.allclose(target["amodal_boxes"], boxes, atol=2e-3)
        assert {str(target[key].dtype) for key in ("amodal_boxes", "visible")} == {"torch.float32"}


def test_another_fraction_is_another_data_set(drawn, tmp_path):
    for begun, other in ((0.0, 0.25), (0.25, 0.0), (0.25, 0.6)):
        before = contents(drawn.of(begun))
        message = f"begun with .*min_visible {begun}.*, got min_visible {other}"
        with pytest.raises(DataError, match=message):
            generate_scenes(
                drawn.model, drawn.model.prior, NUM, drawn.of(begun), 1, ALL, options=DatasetOptions(min_visible=other)
            )
        assert contents(drawn.of(begun)) == before
        again = generate_scenes(
            drawn.model, drawn.model.prior, NUM, drawn.of(begun), 1, ALL, options=DatasetOptions(min_visible=begun)
        )
        assert again.made == 0

        def interrupted(done, of):
            if done:
                raise KeyboardInterrupt

        out = tmp_path / f"{begun} {other}"
        with pytest.raises(KeyboardInterrupt):
            generate_scenes(
                drawn.model, drawn.model.prior, NUM, out, 1, ALL, interrupted, DatasetOptions(min_visible=begun)
            )
        with pytest.raises(DataError, match=message):
            generate_scenes(drawn.model, drawn.model.prior, NUM, out, 1, ALL, options=DatasetOptions(min_visible=other))
        generate_scenes(drawn.model, drawn.model.prior, NUM, out, 1, ALL, options=DatasetOptions(min_visible=begun))
        assert contents(out) == before


def test_the_default_leaves_no_trace(drawn, tmp_path):
    generate_scenes(drawn.model, drawn.model.prior, NUM, tmp_path / "out", seed=1, format=ALL)
    assert contents(tmp_path / "out") == contents(drawn.of(0.0))
    assert not any(b"min_visible" in data for data in contents(tmp_path / "out").values())


@pytest.mark.parametrize("wrong", [-0.1, 1.5, float("nan")])
def test_what_is_no_fraction_is_refused(drawn, tmp_path, wrong):
    with pytest.raises(ProbsceneError, match="min_visible from 0 to 1"):
        generate_scenes(drawn.model, drawn.model.prior, 1, tmp_path / "out", options=DatasetOptions(min_visible=wrong))
    assert not (tmp_path / "out").exists()


def test_the_command_leaves_out_the_same(call, fitted, tmp_path):
    generate(RunFolder.at(fitted), 70, tmp_path / "one", options=DatasetOptions(min_visible=0.9))
    done = call("generate", fitted, "--num", 70, "--out", tmp_path / "two", "--min-visible", 0.9)
    assert done.code == 0, done.err
    assert contents(tmp_path / "one") == contents(tmp_path / "two")
    refused = call("generate", fitted, "--num", 70, "--out", tmp_path / "two")
    assert refused.code == 2 and "min_visible 0.9" in refused.err and "left as it is" in refused.err
