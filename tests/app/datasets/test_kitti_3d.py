"""KITTI's labels of 3D scenes: boxes of known cuboids, read by others' and a plain reader, projected through P2."""

import json
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyro
import pytest
import torch
import torchvision
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from probscene.app.chunks import CHUNK
from probscene.app.datasets import coco, kitti
from probscene.app.datasets.generate import generate_scenes
from probscene.app.labels.boxes import read_boxes
from probscene.app.loading import load_model
from probscene.batch import RenderBatch, SceneGeometry
from probscene.dataset import ImageFolder

HEIGHT, WIDTH = 94, 310
KINDS = ("tree", "car", "pedestrian", "bike")
MODEL = SimpleNamespace(name="street", classes=KINDS, canvas=(HEIGHT, WIDTH), grammar=SimpleNamespace(kinds=KINDS))
TYPES = ("tree", "Car", "Pedestrian", "Cyclist")
K = np.array([[180.4, 0, 152.0], [0, 181.1, 42.9], [0, 0, 1]])
COLUMNS = 15


def corners(h, w, length, x, y, z, rotation):
    """The 3D box's corners ``(8, 3)`` in the camera's axes: length along the heading, y down, the bottom at y."""
    local = [(a * length / 2, b, c * w / 2) for a in (-1, 1) for b in (0, -h) for c in (-1, 1)]
    c, s = math.cos(rotation), math.sin(rotation)
    return np.array([(x + c * a + s * d, y + b, z - s * a + c * d) for a, b, d in local])


def projected(box, P):
    """The extent ``x0, y0, x1, y1`` of a 3D box's corners through ``P (3, 4)``."""
    points = np.c_[corners(*box), np.ones(8)] @ P.T
    uv = points[:, :2] / points[:, 2:]
    return np.concatenate([uv.min(0), uv.max(0)])


def rendered(objects) -> RenderBatch:
    """One image of cuboids ``(kind, box, visible)``, each painted as its amodal box's part on the canvas, in order."""
    M = len(objects)
    instance = np.zeros((HEIGHT, WIDTH), np.int16)
    amodal, visible_box = np.zeros((M, 4)), np.zeros((M, 4))
    truncated = np.zeros(M)
    for k, (_, box, _) in enumerate(objects):
        x0, y0, x1, y1 = amodal[k] = projected(box, np.c_[K, np.zeros(3)]) + 0.5  # from the corner, see world.py
        inside = (min(x1, WIDTH) - max(x0, 0)) * (min(y1, HEIGHT) - max(y0, 0))
        truncated[k] = 1 - inside / ((x1 - x0) * (y1 - y0))
        a, b = math.ceil(x0 - 0.5), math.ceil(y0 - 0.5)  # pixels whose middle is inside
        instance[max(b, 0) : math.floor(y1 + 0.5), max(a, 0) : math.floor(x1 + 0.5)] = k + 1
    for k in range(M):
        rows, columns = np.nonzero(instance == k + 1)
        if len(rows):
            visible_box[k] = columns.min(), rows.min(), columns.max() + 1, rows.max() + 1
    box = torch.tensor([[box for _, box, _ in objects]], dtype=torch.float32)
    space = SceneGeometry(
        depth=torch.ones(1, HEIGHT, WIDTH),
        semantic=torch.zeros(1, HEIGHT, WIDTH, dtype=torch.uint8),
        names=("sky",),
        truncated=torch.tensor(truncated, dtype=torch.float32)[None],
        box=box,
        intrinsics=torch.tensor(K, dtype=torch.float32)[None],
    )
    return RenderBatch(
        image=torch.zeros(1, 3, HEIGHT, WIDTH, dtype=torch.uint8),
        instance=torch.from_numpy(instance)[None],
        kind=torch.tensor([[kind for kind, _, _ in objects]]),
        box=torch.tensor(visible_box, dtype=torch.float32)[None],
        amodal_box=torch.tensor(amodal, dtype=torch.float32)[None],
        pixels=torch.tensor([[int((instance == k + 1).sum()) for k in range(M)]]),
        visible=torch.tensor([[share for _, _, share in objects]]),
        space=space,
    )


def parsed(text):
    """Label lines by the development kit's description: one dict an object."""
    found = []
    for line in text.splitlines():
        type, *numbers = line.split(" ")
        v = [float(number) for number in numbers]
        assert len(v) == COLUMNS - 1
        found.append({"type": type, "truncated": v[0], "occluded": v[1], "alpha": v[2], "bbox": v[3:7], "box": v[7:]})
    return found


def matrices(text):
    """The matrices of a calibration file by name."""
    found = {}
    for line in filter(None, text.split("\n")):
        name, _, numbers = line.partition(": ")
        found[name] = np.array([float(number) for number in numbers.split(" ")]).reshape(3, -1)
    return found


POSE = st.tuples(
    st.integers(0, 3),
    st.tuples(
        st.floats(0.5, 4), st.floats(0.4, 3), st.floats(0.5, 8),
        st.floats(-8, 8), st.floats(1, 2), st.floats(10, 60), st.floats(-math.pi, math.pi),
    ),
    st.floats(0.05, 1),
)  # fmt: skip


@given(st.lists(POSE, min_size=1, max_size=6))
def test_every_column_is_what_the_benchmark_means_by_it(objects):
    batch = rendered(objects)
    annotations = coco.annotations(MODEL, batch, 0)
    P = matrices(kitti.calib(batch.space.intrinsics[0]))["P2"]
    lines = parsed(kitti.label(MODEL, annotations))
    shown = [k for k in range(len(objects)) if batch.pixels[0, k]]
    assert len(lines) == len(shown)
    for k, line in zip(shown, lines, strict=True):
        kind, box, visible = objects[k]
        assert line["type"] == TYPES[kind]
        assert line["box"] == pytest.approx(box, abs=6e-5)
        h, w, length, x, y, z, rotation = box
        assert abs(math.remainder(line["alpha"] - (rotation - math.atan2(x, z)), 2 * math.pi)) < 1e-3
        assert -math.pi - 1e-4 <= line["alpha"] <= math.pi + 1e-4
        assert line["occluded"] == (0 if visible >= 0.9 else 1 if visible >= 0.5 else 2)
        whole = projected(line["box"], P)
        low, high = np.clip(whole[:2], 0, None), np.clip(whole[2:], None, [WIDTH - 1, HEIGHT - 1])
        assert line["bbox"] == pytest.approx([*low, *high], abs=0.05)
        size = whole[2:] - whole[:2]
        edge = np.clip(whole.reshape(2, 2), -0.5, [WIDTH - 0.5, HEIGHT - 0.5])
        assert line["truncated"] == pytest.approx(1 - np.prod(edge[1] - edge[0]) / np.prod(size), abs=0.006)
        x0, y0, x1, y1 = batch.box[0, k].tolist()  # no visible pixel's middle is outside
        left, top, right, bottom = line["bbox"]
        assert left <= x0 + 0.01 and top <= y0 + 0.01 and right >= x1 - 1.01 and bottom >= y1 - 1.01


def test_calibration_has_one_camera_and_a_velodyne_where_it_is():
    text = kitti.calib(torch.tensor(K, dtype=torch.float32))
    found = matrices(text)
    assert list(found) == ["P0", "P1", "P2", "P3", "R0_rect", "Tr_velo_to_cam", "Tr_imu_to_velo"]
    for i in range(4):
        assert np.allclose(found[f"P{i}"], np.c_[K, np.zeros(3)], rtol=1e-6)
    forward_left_up = np.array([10.0, 2.0, 1.0, 1.0])
    x, y, z = found["R0_rect"] @ found["Tr_velo_to_cam"] @ forward_left_up
    assert (x, y, z) == (-2.0, -1.0, 10.0)  # right, down, forward
    assert found["Tr_imu_to_velo"].tolist() == np.eye(3, 4).tolist()


OBJECTS = [
    (1, (1.5, 1.7, 4.2, -3.0, 1.6, 12.0, -1.5), 1.0),
    (2, (1.8, 0.6, 0.8, 4.0, 1.6, 9.0, 0.3), 0.6),
    (1, (1.5, 1.7, 4.2, 9.5, 1.6, 12.0, 1.5), 0.2),
]


def test_torchvision_reads_the_same(tmp_path):
    batch = rendered(OBJECTS)
    annotations = coco.annotations(MODEL, batch, 0)
    for folder, contents in (
        ("label_2", kitti.label(MODEL, annotations).encode()),
        ("calib", kitti.calib(batch.space.intrinsics[0]).encode()),
    ):
        file = tmp_path / kitti.file_name(folder, 0)
        file.parent.mkdir(parents=True)
        file.write_bytes(contents)
    (tmp_path / "Kitti/raw/training/image_2").mkdir()
    Image.fromarray(np.zeros((HEIGHT, WIDTH, 3), np.uint8)).save(tmp_path / kitti.file_name("image_2", 0))
    image, read = torchvision.datasets.Kitti(tmp_path)[0]
    image.close()
    text = (tmp_path / "Kitti/raw/training/label_2/000000.txt").read_text()
    for one, other, (_, box, _) in zip(read, parsed(text), OBJECTS, strict=True):
        assert (one["type"], one["bbox"], one["alpha"]) == (other["type"], other["bbox"], other["alpha"])
        assert one["dimensions"] + one["location"] + [one["rotation_y"]] == pytest.approx(box, abs=1e-4)
        assert (one["truncated"], one["occluded"]) == (other["truncated"], other["occluded"])
    assert [one["occluded"] for one in read] == [0, 1, 2] and read[2]["truncated"] > 0.1 > read[0]["truncated"]
    folder = tmp_path / "Kitti/raw/training/label_2"
    target = ImageFolder(tmp_path / "Kitti/raw/training/image_2", (HEIGHT, WIDTH), 3)
    read = read_boxes(folder, MODEL, target)
    counts, classes = read.counts, read.classes
    assert dict(zip(classes, counts[0].tolist(), strict=True)) == {"car": 2, "pedestrian": 1, "bike": 0}


def test_coco_has_the_space_beside_the_rest():
    batch = rendered(OBJECTS)
    for k, found in enumerate(json.loads(json.dumps(coco.annotations(MODEL, batch, 7)))):
        assert found["image_id"] == 7 and found["box_3d"] == pytest.approx(OBJECTS[k][1], abs=1e-5)
        x, y, w, h = found["amodal_bbox"]
        assert [x, y, x + w, y + h] == pytest.approx(batch.amodal_box[0, k].tolist(), abs=2e-3)
        assert found["truncated"] == pytest.approx(float(batch.space.truncated[0, k]), abs=1e-6)
    flat = batch._replace(space=None, amodal_box=batch.box)
    assert not any({"box_3d", "truncated"} & set(found) for found in coco.annotations(MODEL, flat, 0))


@pytest.fixture(scope="module")
def level():
    """The model of boxes and lids under a camera that is not pitched, so that its y axis is the world's."""
    model = load_model(str(Path(__file__).parents[1] / "lots.py"))
    return replace(model, program=pyro.condition(model.program, {"camera.pitch": torch.zeros(CHUNK, 1)}))


def test_boxes_of_rendered_cuboids_are_their_projections(level, tmp_path):
    generate_scenes(level, level.prior, 128, tmp_path, seed=3, format="kitti,coco")
    training, dataset = tmp_path / "Kitti" / "raw" / "training", torchvision.datasets.Kitti(tmp_path)
    height, width = level.canvas
    whole = cut = 0
    for k, name in enumerate(dataset.images):
        file = training / "label_2" / f"{Path(name).stem}.txt"
        P = matrices((training / "calib" / file.name).read_text())["P2"]
        image, read = dataset[k]
        image.close()
        for one, other in zip(parsed(file.read_text()), read, strict=True):
            assert one["box"] == other["dimensions"] + other["location"] + [other["rotation_y"]]
            if corners(*one["box"])[:, 2].min() < 0.5:
                continue  # it reaches behind the camera
            box = projected(one["box"], P)
            edges = np.clip(box, 0, [width - 1, height - 1] * 2)
            assert one["bbox"] == pytest.approx(edges, abs=0.05)
            inside = np.clip(box, -0.5, [width - 0.5, height - 0.5] * 2)
            area = np.prod(inside[2:] - inside[:2]) / np.prod(box[2:] - box[:2])
            assert one["truncated"] == pytest.approx(1 - area, abs=0.006)
            whole, cut = whole + (area > 0.999), cut + (area < 0.95)
    assert whole > 100 and cut > 3


def test_a_dataset_in_space_is_the_same_whoever_makes_it(level, tmp_path):
    for name, format in (("one", "kitti"), ("two", "webdataset,kitti,coco")):
        generate_scenes(level, level.prior, 3, tmp_path / name, seed=1, format=format)
    files = sorted((tmp_path / "one" / "Kitti").rglob("*.*"))
    assert len(files) == 3 * 4 and {file.parent.name for file in files} == {"image_2", "label_2", "instance", "calib"}
    for file in files:
        assert file.read_bytes() == (tmp_path / "two" / file.relative_to(tmp_path / "one")).read_bytes()
