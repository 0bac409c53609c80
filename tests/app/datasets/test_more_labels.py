"""Labels beyond boxes and visible masks, each read back by what others wrote or from the pixels alone: panoptic
segments, masks of whole objects, polygons, oriented boxes, keypoints, and the program's own values."""

import contextlib
import io
import json
import tarfile
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pyro
import pytest
import torch
import yaml
from faster_coco_eval import COCO, COCOeval_faster
from faster_coco_eval import mask as rle
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from matplotlib.path import Path as Curve
from PIL import Image
from reference.meshes import MeshReference
from reference.sprites import ReferenceRenderer

from probscene.app.chunks import draw_chunk
from probscene.app.datasets import coco
from probscene.app.datasets.generate import DatasetOptions, generate, generate_scenes
from probscene.app.datasets.polygons import polygon
from probscene.app.datasets.scene_dataset import SceneDataset
from probscene.app.datasets.yolo import around
from probscene.app.fitting.run import RunFolder
from probscene.app.loading import load_model, renderer_for
from probscene.camera_effects import CameraEffects
from probscene.derive import derive
from probscene.drawing import Atlas, Drawing, Sprites, resolve
from probscene.errors import ModelError, ProbsceneError
from probscene.inference.guides.lstm import LSTMGuide
from probscene.request import Objects
from probscene.scenarios import join
from probscene.scene import SceneGraph
from probscene.world import resolve_scene

from .conftest import contents

FILES = {name: Path(__file__).parents[1] / f"{name}.py" for name in ("cars", "lots")}
FORMATS, VALUES, NUM = ("coco", "panoptic", "yolo-seg", "yolo-obb"), ("car.x", "x", "light", "car.far"), 40


@pytest.fixture(scope="module", params=FILES)
def drawn(request, tmp_path_factory) -> SimpleNamespace:
    """Flat or 3D scenes: their drawing, their render, their data set, its annotations, and the nodes of these."""
    model, out = load_model(str(FILES[request.param])), tmp_path_factory.mktemp("labels")
    values = VALUES if request.param == "cars" else ()
    generate_scenes(
        model, model.prior, NUM, out / "out", 1, FORMATS, options=DatasetOptions(amodal=True, values=values)
    )
    scenes = draw_chunk(model, model.prior, 1, 0)
    drawing = scenes.drawing[:NUM]
    annotations = json.loads((out / "out" / "annotations.json").read_text())["annotations"]
    of_image = [[one for one in annotations if one["image_id"] == i] for i in range(NUM)]
    batch = renderer_for(model, 1)(drawing)
    nodes = [[m for m in np.unique(ids[ids > 0]) - 1 if labelled(model, batch, i, m)] for i, ids in ids_of(batch)]
    return SimpleNamespace(
        name=request.param, model=model, out=out / "out", drawing=drawing, batch=batch, of_image=of_image, nodes=nodes
    )


def ids_of(batch):
    return enumerate(batch.instance.numpy())


def labelled(model, batch, i, node) -> bool:
    return model.grammar.kinds[batch.kind[i, node]] in model.classes


@pytest.fixture(scope="module")
def cars(tmp_path_factory) -> SimpleNamespace:
    model = load_model(str(FILES["cars"]))
    return SimpleNamespace(model=model, drawing=draw_chunk(model, model.prior, 1, 0).drawing)


def decoded(segmentation) -> np.ndarray:
    return rle.decode(segmentation).astype(bool)


# panoptic


@pytest.mark.parametrize("least", [0.0, 0.7])
def test_every_pixel_is_in_the_segment_of_what_it_shows(drawn, tmp_path, least):
    out, model, batch = drawn.out, drawn.model, drawn.batch
    if least:
        out = tmp_path / "out"
        generate_scenes(model, model.prior, NUM, out, 1, "panoptic,coco", options=DatasetOptions(min_visible=least))
    found = json.loads((out / "panoptic.json").read_text())
    names = {category["id"]: category["name"] for category in found["categories"]}
    assert {c["name"] for c in found["categories"] if c["isthing"]} == {*model.classes} - {*model.stuff}
    assert [names[i] for i in range(1, 1 + len(model.classes))] == list(model.classes)
    voids, seen = 0, set()
    for i, (entry, image) in enumerate(zip(found["annotations"], found["images"], strict=True)):
        assert entry["image_id"] == image["id"] == i and entry["file_name"] == image["file_name"] == f"{i:06d}.png"
        with Image.open(out / "panoptic" / entry["file_name"]) as picture:
            rgb = np.asarray(picture).astype(np.int64)
        ids = rgb[..., 0] + 256 * rgb[..., 1] + 256**2 * rgb[..., 2]
        assert {segment["id"] for segment in entry["segments_info"]} == set(np.unique(ids)) - {0}
        shown = np.full(ids.shape, "", object)
        for segment in entry["segments_info"]:
            mask = ids == segment["id"]
            rows, columns = np.nonzero(mask)
            x, y, w, h = segment["bbox"]
            assert (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1) == (x, y, x + w, y + h)
            assert segment["area"] == mask.sum() and segment["iscrowd"] == 0
            shown[mask] = names[segment["category_id"]]
            if shown[mask][0] in {*model.classes} - {*model.stuff}:
                assert len(np.unique(batch.instance[i].numpy()[mask])) == 1
        for category in names.values():
            segments = [s for s in entry["segments_info"] if names[s["category_id"]] == category]
            assert len(segments) <= 1 or category in {*model.classes} - {*model.stuff}
        instance = batch.instance[i].numpy()
        for node in range(-1, batch.kind.shape[1]):
            here = shown[instance == node + 1]
            if node < 0:
                rest = np.full(ids.shape, "background", object)
                if batch.space is not None:
                    rest = np.array(batch.space.names, object)[batch.space.semantic[i].numpy()]
                assert (here == rest[instance == 0]).all()
            elif len(here):
                kind = model.grammar.kinds[batch.kind[i, node]]
                left_out = kind in model.classes and batch.visible[i, node] < least
                assert (here == ("" if left_out else kind)).all()
                voids += left_out
        seen |= set(shown.ravel())
    expected = (
        {"car", "tree", "lot", "background"} if drawn.name == "cars" else {"box", "lid", "road", "terrain", "sky"}
    )
    assert expected <= seen and bool(voids) == bool(least)


# masks of whole objects


def only(drawing, i: int, node: int):
    """Scene i with one node alone."""
    layers = []
    for layer in drawing[i : i + 1].layers:
        if layer.labelled:
            present = torch.zeros_like(layer.present)
            present[0, node] = layer.present[0, node]
            layers.append(replace(layer, present=present))
    more = {} if isinstance(drawing, Drawing) else {"ground": None, "photo": resolve_scene(CameraEffects(), 1)}
    return replace(drawing[i : i + 1], layers=tuple(layers), **more)


def test_whole_masks_are_the_objects_drawn_alone(drawn):
    reference = ReferenceRenderer(drawn.model.canvas)
    scenes = NUM
    if drawn.name == "lots":
        reference, scenes = MeshReference(drawn.model.canvas, colours=False), 3
    hidden = off = pixels = 0
    for i in range(scenes):
        for one, node in zip(drawn.of_image[i], drawn.nodes[i], strict=True):
            whole, visible = decoded(one["amodal_segmentation"]), decoded(one["segmentation"])
            alone = reference(only(drawn.drawing, i, node)).instance[0].numpy() == node + 1
            off, pixels = off + (whole != alone).sum(), pixels + alone.sum()
            assert (whole >= visible).all()
            hidden += (whole > visible).any()
            x, y, w, h = one["amodal_bbox"]
            rows, columns = np.nonzero(whole)
            assert x <= columns.min() + 0.5 <= columns.max() + 0.5 <= x + w
            assert y <= rows.min() + 0.5 <= rows.max() + 0.5 <= y + h
    assert hidden >= 2 and off <= pixels / 1000  # at edges, where a rounding error may decide


def test_the_torch_data_set_has_whole_masks_and_keypoints(drawn):
    for _, target in SceneDataset(FILES[drawn.name], NUM, seed=1, amodal=True):
        annotations = drawn.of_image[target["image_id"]]
        whole = [decoded(one["amodal_segmentation"]) for one in annotations]
        assert target["amodal_masks"].shape == target["masks"].shape and target["amodal_masks"].dtype == torch.uint8
        assert (target["amodal_masks"].numpy() == np.reshape(whole, target["masks"].shape)).all()
        assert ("keypoints" in target) == (drawn.name == "cars")
        for one, points in zip(annotations, target.get("keypoints", ()), strict=drawn.name == "cars"):
            expected = np.reshape(one.get("keypoints", [0] * 9), (3, 3))
            assert points.dtype == torch.float32 and np.allclose(points, expected, atol=1e-3)


# polygons


MASKS = arrays(bool, st.tuples(st.integers(1, 7), st.integers(1, 7))).filter(np.any)


@given(MASKS)
def test_a_polygon_holds_the_masks_pixels_and_no_others(mask):
    corners = polygon(mask)
    middles = np.stack(np.meshgrid(np.arange(mask.shape[1]), np.arange(mask.shape[0])), -1).reshape(-1, 2) + 0.5
    closed = Curve(np.concatenate([corners, corners[:1]]))
    assert (closed.contains_points(middles).reshape(mask.shape) == mask).all()
    x, y = corners.T
    assert (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2 == mask.sum()  # as many as its signed area
    steps = corners - np.roll(corners, 1, 0)
    assert ((steps == 0).sum(1) == 1).all()  # along the edges of pixels


def test_polygons_in_ultralytics_folders_are_the_visible_masks(drawn):
    height, width = drawn.model.canvas
    assert yaml.safe_load((drawn.out / "yolo-seg" / "data.yaml").read_text())["names"] == dict(
        enumerate(drawn.model.classes)
    )
    common = total = 0
    for i in range(NUM):
        folder = drawn.out / "yolo-seg"
        image = folder / "images" / f"{i:06d}.png"
        assert image.samefile(drawn.out / "images" / image.name)
        lines = (folder / "labels" / f"{i:06d}.txt").read_text().splitlines()
        for line, one in zip(lines, drawn.of_image[i], strict=True):
            number, *shares = line.split()
            assert int(number) == one["category_id"] - 1
            corners = np.array(shares, float).reshape(-1, 2) * (width, height)
            assert np.allclose(corners, np.rint(corners), atol=1e-5)
            mask, loop = decoded(one["segmentation"]), np.rint(corners).astype(np.int32)
            x, y, w, h = one["bbox"]
            assert (*loop.min(0), *loop.max(0)) == (x, y, x + w, y + h)
            middles = np.argwhere(np.ones_like(mask))[:, ::-1] + 0.5
            assert (Curve(np.concatenate([loop, loop[:1]])).contains_points(middles).reshape(mask.shape) == mask).all()
            theirs = cv2.fillPoly(np.zeros(mask.shape, np.uint8), [loop], 1).astype(bool)  # as Ultralytics draws it
            assert (theirs >= mask).all()
            common, total = common + mask.sum(), total + theirs.sum()
    assert common / total > 0.75  # small objects, of which the border is much


# oriented boxes


@given(MASKS, st.floats(-7, 7) | st.just(np.nan), st.integers(0, 3))
def test_an_oriented_box_is_a_rectangle_that_touches_the_mask_on_all_sides(mask, angle, margin):
    box = around(mask, angle, margin)
    sides = np.roll(box, -1, 0) - box
    lengths = np.linalg.norm(sides, axis=1)
    assert np.allclose((sides * np.roll(sides, -1, 0)).sum(1), 0) and np.allclose(lengths[:2], lengths[2:])
    right, down = sides[:2] / lengths[:2, None]
    assert np.isclose(right[0] * down[1] - right[1] * down[0], 1)  # clockwise on the screen
    if not np.isnan(angle):
        assert np.allclose(right, (np.cos(angle), -np.sin(angle)))
    points = np.argwhere(mask)[:, ::-1] + 0.5
    for axis, length in ((right, lengths[0]), (down, lengths[1])):
        along = (points - box[0]) @ axis
        assert np.allclose((along.min(), length - along.max()), 0.5 + margin)


def test_oriented_boxes_are_turned_as_the_sprites_are(drawn):
    size = drawn.model.canvas[::-1]
    near = turned = 0
    for i in range(NUM):
        lines = (drawn.out / "yolo-obb" / "labels" / f"{i:06d}.txt").read_text().splitlines()
        for line, one, node in zip(lines, drawn.of_image[i], drawn.nodes[i], strict=True):
            number, *shares = line.split()
            corners = np.array(shares, float).reshape(4, 2) * size
            assert int(number) == one["category_id"] - 1 and (corners >= 0).all() and (corners <= size).all()
            if (corners == 0).any() or (corners == size).any():
                continue  # at the border they may have been moved
            points = np.argwhere(decoded(one["segmentation"]))[:, ::-1] + 0.5
            _, (w, h), degrees = cv2.minAreaRect(corners.astype(np.float32))  # as Ultralytics reads it
            if drawn.name == "lots":
                smallest = cv2.minAreaRect(points.astype(np.float32))[1]
                assert w * h <= (max(smallest) + 1.01) * (min(smallest) + 1.01)
                turned += 1
                continue
            layer = drawn.drawing.layers[1]
            if not layer.present[i, node]:
                continue
            angle, scale = float(layer.angle[i, node]), float(layer.scale_x[i, node])
            assert abs((degrees + np.degrees(angle) + 45) % 90 - 45) < 0.5
            turned += abs(angle) > 0.1
            if one["visible_fraction"] == 1:
                middle = np.array([layer.x[i, node], layer.y[i, node]])
                x, y = np.array([-12, 12, 12, -12]) * scale, np.array([-6, -6, 6, 6]) * scale
                cos, sin = np.cos(angle), np.sin(angle)
                assert np.abs(corners - middle - np.stack([cos * x + sin * y, -sin * x + cos * y], 1)).max() < 1.5
                near += 1
    assert turned > 10 and (near > 5 or drawn.name == "lots")


# keypoints


def test_coco_tools_read_keypoints(drawn):
    if drawn.name == "lots":
        assert not any("keypoints" in one for entries in drawn.of_image for one in entries)
        return
    with contextlib.redirect_stdout(io.StringIO()):
        truth = COCO(str(drawn.out / "annotations.json"))
        assert truth.cats[1]["keypoints"] == ["nose", "left", "beyond"] and "keypoints" not in truth.cats[2]
        entries = [one for one in truth.anns.values() if one["category_id"] == 1]
        seen = [one for one in entries if one["num_keypoints"]]
        keys = ("image_id", "category_id", "keypoints")
        same = truth.loadRes([{key: one[key] for key in keys} | {"score": 1.0} for one in seen])
        judge = COCOeval_faster(truth, same, "keypoints", print_function=lambda *_: None)
        judge.params.catIds, judge.params.kpt_oks_sigmas = [1], np.full(3, 0.05)
        judge.evaluate()
        judge.accumulate()
        judge.summarize()
    assert judge.stats[0] == 1
    for one in entries:
        assert one["num_keypoints"] == (np.reshape(one["keypoints"], (3, 3))[:, 2] > 0).sum()


def test_yolos_keypoints_are_cocos(cars, tmp_path):
    generate_scenes(cars.model, cars.model.prior, 20, tmp_path, 1, "coco,yolo-pose")
    assert yaml.safe_load((tmp_path / "yolo-pose" / "data.yaml").read_text())["kpt_shape"] == [3, 3]
    entries = json.loads((tmp_path / "annotations.json").read_text())["annotations"]
    for i in range(20):
        lines = (tmp_path / "yolo-pose" / "labels" / f"{i:06d}.txt").read_text().splitlines()
        for line, one in zip(lines, [one for one in entries if one["image_id"] == i], strict=True):
            number, cx, cy, w, h, *points = np.array(line.split(), float)
            assert number == one["category_id"] - 1 and len(points) == 9
            assert np.allclose([(cx - w / 2) * 96, (cy - h / 2) * 72, w * 96, h * 72], one["bbox"], atol=1e-4)
            found = np.reshape(points, (3, 3)) * (96, 72, 1)
            assert np.allclose(found.ravel(), one.get("keypoints", [0] * 9), atol=1e-4)


def test_keypoints_are_seen_where_the_mask_is(drawn):
    if drawn.name == "lots":
        return
    layer, seen = drawn.drawing.layers[1], {0: 0, 1: 0, 2: 0}
    height, width = drawn.model.canvas
    for i in range(NUM):
        for one, node in zip(drawn.of_image[i], drawn.nodes[i], strict=True):
            if not layer.present[i, node]:
                continue
            points = np.reshape(one["keypoints"], (3, 3))
            cos, sin = np.cos(float(layer.angle[i, node])), np.sin(float(layer.angle[i, node]))
            for (x, y, visibility), (right, down) in zip(points, ((10.5, 0), (-2.4, -4.5), (24, 0)), strict=True):
                right, down = right * float(layer.scale_x[i, node]), down * float(layer.scale_y[i, node])
                expected = np.array(
                    [layer.x[i, node] + cos * right + sin * down, layer.y[i, node] - sin * right + cos * down]
                )
                inside = 0 <= expected[0] < width and 0 <= expected[1] < height
                assert np.allclose((x, y), expected if inside else 0, atol=1e-2) and (visibility > 0) == inside
                seen[visibility] += 1
                if inside and right < 24 * float(layer.scale_x[i, node]):
                    column, row = int(x), int(y)
                    around_it = drawn.batch.instance[i, max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
                    own = (around_it == node + 1).numpy()
                    if own.all() or not own.any():
                        assert visibility == (2 if own.all() else 1)
    assert min(seen.values()) > 10


@given(st.tuples(st.integers(1, 4), st.integers(1, 5)), st.data(), st.floats(-4, 4), st.floats(3, 6), st.floats(3, 6))
def test_a_keypoint_lies_where_the_texel_is_drawn(size, data, angle, scale_x, scale_y):
    row, column = data.draw(st.integers(0, size[0] - 1)), data.draw(st.integers(0, size[1] - 1))
    sprite = np.full((*size, 4), (0, 0, 0, 255), np.uint8)
    sprite[row, column, :3] = 255
    point = ((column + 0.5) / size[1], (row + 0.5) / size[0])
    drawing = one_sprite(sprite, {"texel": point}, angle=angle, scale=scale_x, scale_y=scale_y)
    light = ReferenceRenderer((64, 64))(drawing).image[0, 0].numpy().astype(float)
    y, x = np.mgrid[:64, :64] + 0.5
    middle = (x * light).sum() / light.sum(), (y * light).sum() / light.sum()
    assert np.allclose(drawing.layers[0].keypoints[0, 0, 0], middle, atol=0.35 * max(scale_x, scale_y))


def one_sprite(sprite, keypoints, **more):
    sprites = Sprites("car", Atlas((sprite,)), 0, 32.3, 31.8, keypoints=keypoints, **more)
    present = torch.ones(1, 1, dtype=torch.bool)
    return Drawing(torch.zeros(1, 1, dtype=torch.int64), ("car",), (resolve(sprites, present),))


# values of the program


def test_annotations_have_the_programs_own_values(drawn):
    if drawn.name == "lots":
        return
    lines = [json.loads(line) for line in (drawn.out / "provenance.jsonl").read_text().splitlines()]
    number = 0
    for i, entries in enumerate(drawn.of_image):
        assert lines[i]["values"] == "car.x,x,light,car.far"
        for one, node in zip(entries, drawn.nodes[i], strict=True):
            values = one["attributes"]
            assert values["light"] == lines[i]["parameters"]["light"][0]
            if one["category_id"] == 2:
                assert np.float32(values["x"]) == drawn.drawing.layers[2].x[i, node] and "car.x" not in values
                continue
            assert values["car.x"] in lines[i]["parameters"]["car.x"] and values["x"] in lines[i]["parameters"]["x"]
            assert values["car.x"] == pytest.approx(values["x"] + values["car.far"][0], abs=1e-4)  # x is the lot's
            number += 1
    assert number > 20


# all of them


ALL = {"format": "coco,panoptic,yolo,yolo-seg,yolo-obb,yolo-pose,webdataset", "amodal": True, "values": "car.x,light"}


def test_the_same_bytes_by_two_workers_and_after_an_interruption(call, tmp_path, monkeypatch, ready_workers):
    """With every option, those of other files too."""
    options = DatasetOptions(amodal=True, values=ALL["values"], min_visible=0.3, box_margin=3)
    every = {"format": ALL["format"], "options": options}
    torch.manual_seed(0)
    run = RunFolder.create(tmp_path / "run", str(FILES["cars"]), {"guide": {"hidden": 8}})
    run.write_tensors("guide", LSTMGuide(run.model.grammar, run.model.max_steps, hidden=8).state_dict())
    with monkeypatch.context() as patch, pytest.raises(ZeroDivisionError):
        patch.setattr(coco, "write", lambda *_: 1 / 0)
        generate(run, 70, tmp_path / "one", **every)
    assert generate(run, 70, tmp_path / "one", **every).made == 0
    words = ("--format", ALL["format"], "--amodal", "--values", "car.x", "--values", "light")
    words += ("--min-visible", 0.3, "--box-margin", 3, "--workers", 2)
    done = call("generate", run.path, "--num", 70, "--out", tmp_path / "two", *words)
    assert done.code == 0, done.err
    assert contents(tmp_path / "one") == contents(tmp_path / "two")
    assert generate(run, 70, tmp_path / "one", **every).made == 0  # it is seen to be finished
    with pytest.raises(ProbsceneError, match=r"begun with \(amodal True\), got amodal False"):
        generate(run, 70, tmp_path / "one", **every | {"options": replace(options, amodal=False)})
    found = json.loads((tmp_path / "one" / "annotations.json").read_text())
    assert found["info"]["values"] == "car.x,light" and found["info"]["amodal"] is True
    sharded = []
    with tarfile.open(tmp_path / "one" / "shard-000000.tar") as tar:
        for name in tar.getnames()[1::2]:
            sample = json.load(tar.extractfile(name))
            assert sample["keypoints"] == {"car": ["nose", "left", "beyond"]}
            sharded += sample["annotations"]
    keys = ("category_id", "segmentation", "amodal_segmentation", "attributes", "keypoints", "num_keypoints")
    for one, other in zip(sharded, found["annotations"], strict=True):
        assert all(one.get(key) == other.get(key) for key in keys)


def test_scenarios_keep_keypoints_and_values(cars, tmp_path):
    both = join("both", {"one": cars.model, "other": cars.model})
    generate_scenes(both, both.prior, 30, tmp_path, options=DatasetOptions(values="one/car.x,one/light"))
    entries = json.loads((tmp_path / "annotations.json").read_text())["annotations"]
    entries = [one for one in entries if one["category_id"] == 1]
    assert {tuple(one["attributes"]) for one in entries} == {(), ("one/car.x", "one/light")}
    for one in entries:
        x, y, w, h = one["bbox"]
        for u, v, visibility in np.reshape(one["keypoints"], (3, 3))[:2]:
            assert visibility < 2 or (x - 1 <= u <= x + w + 1 and y - 1 <= v <= y + h + 1)


def test_names_of_keypoints_that_change_are_one_error(cars, tmp_path):
    names = iter("abc")

    def program(num_scenes, structure):
        drawing = cars.model.program(num_scenes, structure)
        layers = [replace(layer, keypoint_names=(next(names), "x", "y")) if layer.keypoint_names else layer
                  for layer in drawing.layers]  # fmt: skip
        return replace(drawing, layers=tuple(layers))

    changing = replace(cars.model, program=program)
    with pytest.raises(ModelError, match="name the same keypoints whatever it draws, got .*'a'.* and .*'b'"):
        generate_scenes(changing, changing.prior, 65, tmp_path)
    assert not (tmp_path / "annotations.json").exists()


def test_what_a_model_does_not_have_is_one_error(cars, tmp_path, call):
    def message(**asked) -> str:
        with pytest.raises(ProbsceneError) as error:
            model, formats = asked.pop("model", cars.model), asked.pop("format", "coco")
            generate_scenes(model, model.prior, 1, tmp_path / "out", 0, formats, options=DatasetOptions(**asked))
        assert not (tmp_path / "out").exists()
        return str(error.value)

    assert "sites of model 'cars' (light, x, y, car.turn, car.far, car.scale, car.x), got 'car.z'" in message(
        values="car.x,car.z"
    )
    for asked in ({"amodal": True}, {"values": "x"}):
        assert "expected coco or webdataset among the formats" in message(format="yolo,panoptic", **asked)
    assert "to have depth" in message(format="coco,depth")
    plain = load_model(str(FILES["lots"]))
    assert "sprites of model 'lots' with keypoints, for format yolo-pose, got none" in message(
        model=plain, format="yolo-pose"
    )

    def request(num_scenes, structure):
        with pyro.plate("scenes", num_scenes, dim=-2):
            scene = SceneGraph(cars.model.grammar, derive(cars.model.grammar, structure, num_scenes, 24))
            return scene.request(Objects("car", x=1.0))

    generated = replace(cars.model, program=request, generator=lambda scene: 1 / 0)
    assert "sprites or meshes for amodal masks, got 'cars'" in message(model=generated, amodal=True)
    with pytest.raises(ProbsceneError, match="sprites or meshes for amodal masks"):
        next(iter(SceneDataset(generated, 1, amodal=True)))


@pytest.mark.parametrize(
    "wrong, message",
    [
        ({"keypoints": {"nose": (0.5,)}}, "as pairs by name"),
        ({"keypoints": {3: (0.5, 0.5)}}, "as pairs by name"),
        ({"keypoints": (0.5, 0.5)}, "as pairs by name"),
        ({"keypoints": {"nose": (0.5, 0.5)}, "labelled": False}, "keypoints of sprites with a label"),
        ({"keypoints": {"nose": (0.5, 0.5)}, "kinds": ()}, "keypoints of sprites with a label"),
        ({"keypoints": {"nose": ("left", 0.5)}}, r"keypoints\['nose'\] as a number"),
        ({"keypoints": {"nose": (0.5, torch.nan)}}, r"finite values in Sprites\('car'\).keypoints\['nose'\]"),
        ({"keypoints": {"nose": (torch.zeros(3, 5), 0.5)}}, r"keypoints\['nose'\] to broadcast"),
    ],
)
def test_keypoints_that_are_none_are_named(cars, wrong, message):
    with pytest.raises(ModelError, match=message):
        one_sprite_of(**wrong)


def one_sprite_of(kinds="car", **more):
    sprites = Sprites(kinds, Atlas((np.full((2, 2, 4), 255, np.uint8),)), 0, 1.0, 1.0, **more)
    return resolve(sprites, torch.ones(1, 2, dtype=torch.bool))
