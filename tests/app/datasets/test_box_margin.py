"""A margin around boxes: boxes of what is visible are wider by it within the image, in every format; all else stays."""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from faster_coco_eval import mask as rle

from probscene.app.datasets.generate import DatasetOptions, generate, generate_scenes
from probscene.app.datasets.scene_dataset import SceneDataset
from probscene.app.fitting.run import RunFolder
from probscene.app.loading import load_model
from probscene.errors import DataError, ProbsceneError

NUM, MARGIN = 20, 5
FILES = {name: Path(__file__).parents[1] / f"{name}.py" for name in ("plates", "lots")}
FORMATS = {"plates": ("coco", "yolo", "kitti"), "lots": ("coco", "yolo")}


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.fixture(scope="module", params=FILES)
def drawn(request, tmp_path_factory) -> SimpleNamespace:
    """One data set of flat or of 3D scenes, without a margin and with one."""
    model, folder = load_model(str(FILES[request.param])), tmp_path_factory.mktemp("margin")
    formats = FORMATS[request.param]
    for margin in (0, MARGIN):
        generate_scenes(
            model, model.prior, NUM, folder / str(margin), 1, formats, options=DatasetOptions(box_margin=margin)
        )
    return SimpleNamespace(file=FILES[request.param], model=model, formats=formats, of=lambda m: folder / str(m))


def annotations(folder: Path) -> list[dict]:
    return json.loads((folder / "annotations.json").read_text())["annotations"]


def test_boxes_are_those_of_the_masks_with_the_margin_as_far_as_the_image_goes(drawn):
    height, width = drawn.model.canvas
    before, after = annotations(drawn.of(0)), annotations(drawn.of(MARGIN))
    assert [one | {"bbox": 0} for one in after] == [one | {"bbox": 0} for one in before]
    at_border = 0
    for one in after:
        rows, columns = np.nonzero(rle.decode(one["segmentation"]))
        x0, y0 = max(columns.min() - MARGIN, 0), max(rows.min() - MARGIN, 0)
        x1, y1 = min(columns.max() + 1 + MARGIN, width), min(rows.max() + 1 + MARGIN, height)
        assert one["bbox"] == [x0, y0, x1 - x0, y1 - y0]
        at_border += x0 == 0 or y0 == 0 or x1 == width or y1 == height
    assert 0 < at_border < len(after)


def test_other_formats_have_the_same_boxes(drawn):
    height, width = drawn.model.canvas
    of_image = [[one["bbox"] for one in annotations(drawn.of(MARGIN)) if one["image_id"] == i] for i in range(NUM)]
    for i, boxes in enumerate(of_image):
        lines = (drawn.of(MARGIN) / "labels" / f"{i:06d}.txt").read_text().splitlines()
        x, y, w, h = np.array([line.split()[1:] for line in lines], float).reshape(-1, 4).T
        yolo = np.stack([(x - w / 2) * width, (y - h / 2) * height, w * width, h * height], 1)
        assert np.allclose(yolo, np.reshape(boxes, (-1, 4)), atol=1e-3)
        if "kitti" in drawn.formats:
            file = drawn.of(MARGIN) / "Kitti" / "raw" / "training" / "label_2" / f"{i:06d}.txt"
            corners = np.array([line.split()[4:8] for line in file.read_text().splitlines()], float).reshape(-1, 4)
            corners[:, 2:] -= corners[:, :2]
            assert np.array_equal(corners, np.reshape(boxes, (-1, 4)))
    for _, target in SceneDataset(drawn.file, NUM, seed=1, box_margin=MARGIN):
        boxes = target["boxes"].numpy().copy()
        boxes[:, 2:] -= boxes[:, :2]
        assert np.array_equal(boxes, np.reshape(of_image[target["image_id"]], (-1, 4)))


def test_images_and_structures_stay_and_provenance_names_the_margin(drawn):
    whole, wide = contents(drawn.of(0)), contents(drawn.of(MARGIN))
    assert whole.keys() == wide.keys()
    assert all(whole[name] == wide[name] for name in whole if "images" in name or "instance" in name)
    left, right = (
        [json.loads(line) for line in each["provenance.jsonl"].decode().splitlines()] for each in (whole, wide)
    )
    assert right == [line | {"box_margin": MARGIN} for line in left]
    assert not any(b"box_margin" in data for data in whole.values())


def test_another_margin_is_another_data_set(drawn):
    for begun, other in ((0, MARGIN), (MARGIN, 0), (MARGIN, 2)):
        with pytest.raises(DataError, match=f"begun with .*box_margin {begun}.*, got box_margin {other}"):
            generate_scenes(
                drawn.model,
                drawn.model.prior,
                NUM,
                drawn.of(begun),
                1,
                drawn.formats,
                options=DatasetOptions(box_margin=other),
            )


@pytest.mark.parametrize("wrong", [-1, 0.5, float("nan")])
def test_a_margin_that_is_none_is_named(tmp_path, wrong):
    model = load_model(str(FILES["plates"]))
    with pytest.raises(ProbsceneError, match="whole number of pixels, 0 or more"):
        generate_scenes(model, model.prior, 1, tmp_path / "out", options=DatasetOptions(box_margin=wrong))
    with pytest.raises(ProbsceneError, match="whole number of pixels, 0 or more"):
        SceneDataset(model, 1, box_margin=wrong)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ("plate", "whole number of pixels, 0 or more, got plate"),
        ("plate=", "whole number of pixels"),
        ("plate=2,plate=3", "once for each class"),
        ({"plate": -1}, "whole number of pixels"),
        ("lamp=2", "classes of model .*, got lamp"),
    ],
)
def test_margins_of_classes_that_are_none_are_named(tmp_path, wrong, said):
    model = load_model(str(FILES["plates"]))
    with pytest.raises(ProbsceneError, match=said):
        generate_scenes(model, model.prior, 1, tmp_path / "out", options=DatasetOptions(box_margin=wrong))
    with pytest.raises(ProbsceneError, match=said):
        SceneDataset(model, 1, box_margin=wrong)
    assert not (tmp_path / "out").exists()


def test_each_class_has_its_own_margin(drawn, tmp_path):
    """In all formats, the other classes' boxes as they are without."""
    name, others = drawn.model.classes[0], drawn.model.classes[1:]
    options = [
        DatasetOptions(box_margin=each) for each in (f"{name}={MARGIN}", {name: MARGIN, **dict.fromkeys(others, 0)})
    ]
    for number, each in enumerate(options):
        generate_scenes(drawn.model, drawn.model.prior, NUM, tmp_path / str(number), 1, drawn.formats, options=each)
    one, two = (annotations(tmp_path / str(number)) for number in (0, 1))
    assert one == two and others
    of_class = drawn.model.classes.index(name) + 1
    for found, wide, touching in zip(one, annotations(drawn.of(MARGIN)), annotations(drawn.of(0)), strict=True):
        assert found == (wide if found["category_id"] == of_class else touching)
    files = zip(*(sorted((folder / "labels").iterdir()) for folder in (tmp_path / "0", drawn.of(MARGIN))), strict=True)
    for own, wide in files:
        lines = zip(own.read_text().splitlines(), wide.read_text().splitlines(), strict=True)
        assert all(a == b for a, b in lines if a.startswith(f"{of_class - 1} "))


def test_kitti_boxes_of_whole_silhouettes_have_none(tmp_path):
    model = load_model(str(FILES["lots"]))
    with pytest.raises(ProbsceneError, match="no box_margin in KITTI's labels of the 3D model"):
        generate_scenes(
            model, model.prior, 1, tmp_path / "out", format="kitti", options=DatasetOptions(box_margin=MARGIN)
        )
    assert not (tmp_path / "out").exists()


def test_the_command_line_takes_it(fitted, call, tmp_path):
    generate(RunFolder.at(fitted), 70, tmp_path / "one", options=DatasetOptions(box_margin=3))
    done = call("generate", fitted, "--num", 70, "--out", tmp_path / "two", "--box-margin", 3)
    assert done.code == 0, done.err
    assert contents(tmp_path / "one") == contents(tmp_path / "two")
