"""Formats: what readers that others wrote find in each is the same, on the same images, exactly."""

import io
import json
import os
import tarfile
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pyro
import pytest
import torchvision
import webdataset
import yaml
from globox import AnnotationSet
from hypothesis import given
from hypothesis import strategies as st
from pycocotools import mask as rle
from pycocotools.coco import COCO

from probscene.app.datasets import kitti, yolo
from probscene.app.datasets.formats import FORMATS, parse_formats
from probscene.app.datasets.generate import generate_scenes
from probscene.app.loading import load_model
from probscene.derive import derive
from probscene.drawing import Sprites
from probscene.errors import DataError, GrammarError, ProbsceneError
from probscene.grammar import Grammar, Node, Rule
from probscene.model import SceneModel
from probscene.scene import SceneGraph
from probscene.structure import StructurePrior, counts

ALL = ("coco", "yolo", "kitti", "webdataset")
NUM, HEIGHT, WIDTH = 100, 56, 72
TRAINING = Path("Kitti", "raw", "training")
pytestmark = pytest.mark.filterwarnings("ignore:__array__ implementation doesn't:DeprecationWarning")  # of pycocotools


@pytest.fixture(scope="module")
def model():
    """Plates and mugs, half hidden and cut, on a canvas that is not square."""
    return replace(load_model(str(Path(__file__).parents[1] / "plates.py")), canvas=(HEIGHT, WIDTH))


@pytest.fixture(scope="module")
def out(model, tmp_path_factory) -> Path:
    """A dataset in every format."""
    folder = tmp_path_factory.mktemp("formats") / "out"
    generate_scenes(model, model.prior, NUM, folder, seed=1, format=ALL)
    return folder


@pytest.fixture(scope="module")
def truth(out) -> list[list[SimpleNamespace]]:
    """By image, in order: ``name``, ``box`` x0 y0 x1 y1, ``mask`` (H, W), as pycocotools reads them."""
    dataset = COCO(out / "annotations.json")
    found = []
    for i in range(NUM):
        entries = dataset.loadAnns(dataset.getAnnIds(i))
        found.append([])
        for entry in entries:
            x, y, w, h = entry["bbox"]
            name = dataset.cats[entry["category_id"]]["name"]
            mask = rle.decode(entry["segmentation"]).astype(bool)
            found[-1].append(SimpleNamespace(name=name, box=(x, y, x + w, y + h), mask=mask, entry=entry))
    return found


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def pairs(found: list[SimpleNamespace]) -> list[tuple]:
    return [(one.name, *one.box) for one in found]


def test_the_sample_has_every_edge_case(model, out, truth):
    spelt = [json.loads(line)["derivation"] for line in (out / "provenance.jsonl").read_text().splitlines()]
    objects = [text.count("Plate -> plate") + text.count("Mugs -> mug") for text in spelt]
    shown = [len(found) for found in truth]
    assert 0 in objects and any(s < o for s, o in zip(shown, objects, strict=True))  # none, and wholly covered
    for edge in (0, 1):
        assert any(one.box[edge] == 0 for found in truth for one in found)
        assert any(one.box[edge + 2] == (WIDTH, HEIGHT)[edge] for found in truth for one in found)


def test_globox_reads_the_same_boxes_from_yolo_and_coco(out, truth):
    names = yaml.safe_load((out / "data.yaml").read_text())["names"]
    ours = AnnotationSet.from_yolo_v5(out / "labels", image_folder=out / "images", image_extension=".png")
    theirs = AnnotationSet.from_coco(out / "annotations.json")
    assert len(ours) == len(theirs) == NUM
    for i, found in enumerate(truth):
        one, other = ours[f"{i:06d}.png"], theirs[f"{i:06d}.png"]
        assert one.image_size == (WIDTH, HEIGHT)
        corners = [(b.xmin, b.ymin, b.xmax, b.ymax) for b in one.boxes]
        assert np.allclose(corners, np.rint(corners), atol=1e-5, rtol=0)
        read = [(names[int(b.label)], *np.rint(c)) for b, c in zip(one.boxes, corners, strict=True)]
        assert read == pairs(found) == [(b.label, b.xmin, b.ymin, b.xmax, b.ymax) for b in other.boxes]


def test_yolos_folder_is_ultralytics(out):
    data = yaml.safe_load((out / "data.yaml").read_text())
    assert data["names"] == {0: "mug", 1: "plate"} and data["train"] == data["val"] == "images" and "path" not in data
    images = sorted(path.stem for path in (out / data["train"]).iterdir())
    assert images == sorted(path.stem for path in (out / "labels").iterdir()) == [f"{i:06d}" for i in range(NUM)]


def test_torchvision_reads_the_same_from_kitti(out, truth):
    dataset = torchvision.datasets.Kitti(out)
    assert len(dataset) == NUM
    for k in range(NUM):
        image, target = dataset[k]
        i = int(Path(dataset.images[k]).stem)
        assert (np.asarray(image)[..., ::-1] == cv2.imread(str(out / "images" / f"{i:06d}.png"))).all()
        assert [(one["type"], *one["bbox"]) for one in target] == pairs(truth[i])
        for one, other in zip(target, truth[i], strict=True):
            X, Y, W, H = other.entry["amodal_bbox"]
            beyond = np.ones((H, W), bool)  # the amodal box, pixel by pixel
            beyond[max(-Y, 0) : max(HEIGHT - Y, 0), max(-X, 0) : max(WIDTH - X, 0)] = False
            assert one["truncated"] == pytest.approx(beyond.mean(), abs=0.005001)
            assert one["occluded"] in (0, 1, 2)
            if not beyond.any():
                assert one["occluded"] == sum(other.entry["visible_fraction"] < share for share in (0.9, 0.5))
            assert (one["alpha"], one["rotation_y"]) == (-10, -10)
            assert one["dimensions"] == [-1] * 3 and one["location"] == [-1000] * 3


def test_opencv_reads_the_same_masks_from_kitti(model, out, truth):
    for i, found in enumerate(truth):
        png = cv2.imread(str(out / TRAINING / "instance" / f"{i:06d}.png"), cv2.IMREAD_UNCHANGED)
        assert png.dtype == np.uint16 and png.shape == (HEIGHT, WIDTH)
        seen = dict.fromkeys(model.classes, 0)
        whole = np.zeros_like(png)
        for one in found:  # in the order of the lines
            seen[one.name] += 1
            value = 256 * (model.classes.index(one.name) + 1) + seen[one.name]
            assert ((png == value) == one.mask).all()
            whole[one.mask] = value
        assert (png == whole).all()


@pytest.mark.filterwarnings("ignore:unclosed file.*shard-000000:ResourceWarning")  # webdataset leaves it to the end
def test_webdataset_reads_the_same_from_shards(model, out, truth):
    samples = list(webdataset.WebDataset(str(out / "shard-000000.tar"), shardshuffle=False))
    assert [sample["__key__"] for sample in samples] == [f"{i:06d}" for i in range(NUM)]
    lines = (out / "provenance.jsonl").read_text(encoding="utf-8").splitlines()
    for i, sample in enumerate(samples):
        assert sample["png"] == (out / "images" / f"{i:06d}.png").read_bytes()
        labels = json.loads(sample["json"])
        assert labels["classes"] == list(model.classes) and (labels["height"], labels["width"]) == (HEIGHT, WIDTH)
        assert labels["provenance"] == json.loads(lines[i])
        for one, other in zip(labels["annotations"], truth[i], strict=True):
            x, y, w, h = one["bbox"]
            assert one["class"] == other.name and (x, y, x + w, y + h) == other.box
            assert (rle.decode(one["segmentation"]) == other.mask).all()
            same = ("category_id", "area", "iscrowd", "visible_fraction", "amodal_bbox")
            assert all(one[key] == other.entry[key] for key in same)


@pytest.mark.parametrize("format", [*ALL, "images", "coco,webdataset", "images,webdataset"])
def test_a_format_is_the_same_alone(model, out, tmp_path, format):
    generate_scenes(model, model.prior, NUM, tmp_path / "out", seed=1, format=format)
    alone, whole = contents(tmp_path / "out"), contents(out)
    info = alone.pop("annotations.json", None)
    assert alone.items() <= whole.items()
    if info is not None:
        left, right = json.loads(info), json.loads(whole["annotations.json"])
        assert left.pop("info")["format"] == format and right.pop("info")["format"] == ",".join(ALL)
        assert left == right
    assert ("images/000000.png" in alone) == (format != "webdataset")
    assert ("shard-000000.tar" in alone) == ("webdataset" in format) and "provenance.jsonl" in alone
    assert not any(name.startswith(".") for name in alone)


def test_images_are_stored_once_but_for_shards(out, model, tmp_path, monkeypatch):
    for i in range(NUM):
        assert os.path.samefile(out / "images" / f"{i:06d}.png", out / TRAINING / "image_2" / f"{i:06d}.png")

    def link(*args, **kwargs):
        raise PermissionError("no hard links here")

    monkeypatch.setattr(os, "link", link)
    generate_scenes(model, model.prior, NUM, tmp_path / "out", seed=1, format=ALL)
    assert contents(tmp_path / "out") == contents(out)


def test_shards_are_of_1024_images_and_nobodys(model, tmp_path):
    generate_scenes(model, model.prior, 1030, tmp_path / "out", format="webdataset")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        "provenance.jsonl", "shard-000000.tar", "shard-000001.tar",
    ]  # fmt: skip
    names = []
    for number in range(2):
        with tarfile.open(tmp_path / "out" / f"shard-{number:06d}.tar") as tar:
            assert {(m.mtime, m.uid, m.gid, m.uname, m.gname, m.mode) for m in tar} == {(0, 0, 0, "", "", 0o644)}
            names.append(tar.getnames())
    assert [len(of_shard) for of_shard in names] == [2 * 1024, 2 * 6]
    assert names[0] + names[1] == [f"{i:06d}.{ending}" for i in range(1030) for ending in ("png", "json")]
    assert generate_scenes(model, model.prior, 1030, tmp_path / "out", format="webdataset").made == 0


class Cut(KeyboardInterrupt):
    """An interrupt at a chosen moment."""


def test_interrupted_at_every_step_every_format_goes_on(model, tmp_path, monkeypatch):
    generate_scenes(model, model.prior, 2, tmp_path / "whole", format=ALL)
    whole, rename = contents(tmp_path / "whole"), os.replace
    for step in range(40):
        out, left = tmp_path / f"cut{step}", step

        def replace_some(source, target):
            nonlocal left
            left -= 1
            if left < 0:
                raise Cut
            rename(source, target)

        monkeypatch.setattr(os, "replace", replace_some)
        try:
            generate_scenes(model, model.prior, 2, out, format=ALL)
        except Cut:
            shown = {name: data for name, data in contents(out).items() if not name.startswith(".")}
            assert shown.items() <= whole.items()  # whole or absent
            monkeypatch.setattr(os, "replace", rename)
            if step:
                with pytest.raises(DataError, match="begun with"):
                    generate_scenes(model, model.prior, 2, out, format="coco")
            generate_scenes(model, model.prior, 2, out, format=ALL)
            assert contents(out) == whole
        else:
            assert step == 20 and contents(out) == whole  # settings, 2 x 5 files, a record, 4 written and moved
            return
    pytest.fail("the work never ended")


def test_damaged_files_of_any_format_are_made_again(model, tmp_path, monkeypatch):
    generate_scenes(model, model.prior, 70, tmp_path / "whole", format=ALL)
    out = tmp_path / "out"

    def no_data(*args):
        raise Cut

    with monkeypatch.context() as patch, pytest.raises(Cut):
        patch.setattr(yolo, "data", no_data)
        generate_scenes(model, model.prior, 70, out, format=ALL)
    (out / TRAINING / "instance" / "000065.png").write_bytes(b"")
    assert generate_scenes(model, model.prior, 70, out, format=ALL).made == 6
    assert contents(out) == contents(tmp_path / "whole")


def test_other_formats_leave_a_dataset_as_it_is(model, out):
    before = contents(out)
    for format in (*ALL, "images", "coco,yolo,kitti"):
        with pytest.raises(DataError, match=f"coco,yolo,kitti,webdataset.*got format {format}; .*left as it is"):
            generate_scenes(model, model.prior, NUM, out, seed=1, format=format)
    assert generate_scenes(model, model.prior, NUM, out, seed=1, format=(*reversed(ALL), "images")).made == 0
    assert contents(out) == before


@pytest.mark.parametrize("format", ["voc", ("coco", "voc"), "coco,voc", "", "coco,", ()])
def test_an_unknown_format_is_one_error_that_names_them(model, tmp_path, format):
    names = "coco, panoptic, yolo, yolo-seg, yolo-obb, yolo-pose, kitti, webdataset, depth, images"
    with pytest.raises(ProbsceneError, match=f"among {names}, got ('(voc)?'|none)"):
        generate_scenes(model, model.prior, 1, tmp_path / "out", format=format)
    assert not (tmp_path / "out").exists()


@given(st.lists(st.sampled_from(FORMATS), min_size=1))
def test_formats_are_a_set(names):
    same = parse_formats(names)
    assert same == parse_formats(",".join(names)) == parse_formats(" , ".join(reversed(names))) == parse_formats(same)
    assert {*names} - {*same} <= {"images"} and {*same} <= {*names}


@given(st.data(), st.integers(1, 20_000), st.integers(1, 20_000))
def test_yolos_boxes_come_back_to_the_pixel(data, height, width):
    x0, y0 = data.draw(st.integers(0, width - 1)), data.draw(st.integers(0, height - 1))
    x1, y1 = data.draw(st.integers(x0 + 1, width)), data.draw(st.integers(y0 + 1, height))
    canvas = SimpleNamespace(canvas=(height, width))
    line = yolo.label(canvas, [{"bbox": [x0, y0, x1 - x0, y1 - y0], "category_id": 3}])
    number, *shares = line.split()
    cx, cy, w, h = np.float32(shares)  # as Ultralytics reads them
    corners = (cx - w / 2) * width, (cy - h / 2) * height, (cx + w / 2) * width, (cy + h / 2) * height
    assert number == "2" and tuple(np.rint(corners)) == (x0, y0, x1, y1) and line.count("\n") == 1


@given(st.lists(st.from_regex(r"[a-zß0-9_\-]+", fullmatch=True), min_size=1, unique=True))
def test_any_class_name_comes_back_from_data_yaml(names):
    read = yaml.safe_load(yolo.data(SimpleNamespace(classes=names)))
    assert read["names"] == dict(enumerate(names))


def test_a_name_with_a_space_is_refused_by_the_grammar():
    with pytest.raises(GrammarError, match="parking lot"):
        Rule("Scene", Node("parking lot"))


GRAMMAR = Grammar("Scene -> Dots\nDots -> dot Dots | ε")


def dots(number):
    """A model of so many dots, none on another, 20 in a row."""

    def program(num_scenes, structure):
        with pyro.plate("scenes", num_scenes, dim=-2):
            scene = SceneGraph(GRAMMAR, derive(GRAMMAR, structure, num_scenes, max_steps=2 + number))
            rank = scene.rank("dot")
        return scene.draw(Sprites.box("dot", 2.0 + 4 * (rank % 20), 2.0 + 4 * (rank // 20), 3.0, 3.0))

    prior = StructurePrior(GRAMMAR, Dots=counts(*[0] * number, 1))
    return SceneModel("dots", GRAMMAR, prior, program, (80, 80), 2 + number, ("dot",), channels=1)


def test_as_many_objects_as_kittis_masks_can_number_and_no_more(tmp_path):
    most, more = dots(255), dots(256)
    generate_scenes(most, most.prior, 1, tmp_path / "most", format="kitti")
    png = cv2.imread(str(tmp_path / "most" / TRAINING / "instance" / "000000.png"), cv2.IMREAD_UNCHANGED)
    assert set(np.unique(png)) == {0, *range(257, 512)}
    with pytest.raises(ProbsceneError, match="at most 255 objects.*got 256 of class 'dot' in image 0"):
        generate_scenes(more, more.prior, 1, tmp_path / "more", format="kitti,coco")
    assert not list((tmp_path / "more").glob("[!.]*"))
    generate_scenes(more, more.prior, 1, tmp_path / "coco", format="coco")
    with pytest.raises(ProbsceneError, match="at most 255 classes"):
        kitti.check(SimpleNamespace(name="many", classes=tuple(map(str, range(256)))))


def test_the_command_line_takes_several(call, fitted, tmp_path):
    words = ["generate", fitted, "--num", 2, "--out"]
    for folder, *format in (("a", "--format", "coco", "--format", "yolo,kitti"), ("b", "--format", "kitti,coco,yolo")):
        done = call(*words, tmp_path / folder, *format)
        assert done.code == 0, done.err
    assert contents(tmp_path / "a") == contents(tmp_path / "b")
    with io.BytesIO(contents(tmp_path / "a")["annotations.json"]) as file:
        assert json.load(file)["info"]["format"] == "coco,yolo,kitti"
    refused = call(*words, tmp_path / "a", "--format", "webdataset")
    assert refused.code == 2 and "left as it is" in refused.err
