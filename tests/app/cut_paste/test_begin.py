"""A model begun with labelled photographs draws what they show."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from probscene.app.checking.model_check import check_model
from probscene.app.cut_paste.begin import BeginOptions, begin
from probscene.app.labels.boxes import read_boxes
from probscene.app.loading import load_model, renderer_for
from probscene.app.trial.sets import read_set
from probscene.dataset import ImageFolder
from probscene.decoding import stored
from probscene.drawing import Atlas
from probscene.errors import DataError
from probscene.sampling import sample, seed_everything

RADIUS = {"disc": 9.0, "Big Disc": 15.0}
HEIGHT, WIDTH = 96, 128


def ground(rng, shape=(HEIGHT, WIDTH), light=120.0):
    """A grey slope with noise, ``(H, W, 3)``."""
    y, x = np.mgrid[-1 : 1 : shape[0] * 1j, -1 : 1 : shape[1] * 1j]
    grey = light + 10 * x - 6 * y + rng.normal(0, 2, shape)
    return np.repeat(grey[..., None], 3, 2)


def paint(image, x, y, radius, rng):
    """A textured bright disc; its box."""
    rows, columns = np.mgrid[: image.shape[0], : image.shape[1]] + 0.5
    inside = np.clip(radius - np.hypot(columns - x, rows - y) + 0.5, 0, 1)[..., None]
    look = 210 + 8 * rng.normal(size=(*image.shape[:2], 1)) - np.array([0, 20, 40])
    image[:] = image * (1 - inside) + look * inside
    return [x - radius, y - radius, 2 * radius, 2 * radius]


def photographs(folder: Path, number=6, each=2, names=tuple(RADIUS), sizes=((HEIGHT, WIDTH),), at=None) -> Path:
    """Photographs of discs that do not overlap, and their labels in COCO, the path of which is returned."""
    (folder / "photos").mkdir(parents=True)
    rng, images, annotations = np.random.default_rng(0), [], []
    for i in range(number):
        h, w = sizes[i % len(sizes)]
        image, places = ground(rng, (h, w)), []
        for k in range(each):
            name = names[(i + k) % len(names)]
            for _ in range(200):
                x, y = (rng.uniform(18, w - 18), rng.uniform(18, h - 18)) if at is None else at(rng, w, h)
                if all(np.hypot(x - a, y - b) > RADIUS[name] + r + 2 for a, b, r in places):
                    break
            places.append((x, y, RADIUS[name]))
            box = paint(image, x, y, RADIUS[name], rng)
            one = {"id": len(annotations) + 1, "image_id": i + 1, "category_id": list(RADIUS).index(name) + 1}
            annotations.append({**one, "bbox": box, "iscrowd": 0})
        Image.fromarray(np.clip(image, 0, 255).astype(np.uint8)).save(folder / "photos" / f"{i}.png")
        images.append({"id": i + 1, "file_name": f"{i}.png", "height": h, "width": w})
    categories = [{"id": i + 1, "name": name} for i, name in enumerate(RADIUS)]
    file = folder / "labels.json"
    file.write_text(json.dumps({"images": images, "annotations": annotations, "categories": categories}))
    return file


def change(file: Path, **changes) -> None:
    """Of the first annotation."""
    whole = json.loads(file.read_text())
    whole["annotations"][0].update(changes)
    file.write_text(json.dumps(whole))


def made(folder: Path, out="model", **options):
    return begin(folder / "photos", folder / "labels.json", folder / out, BeginOptions(**options), progress=False)


def rendered_prior(path: Path, number=32):
    model = load_model(str(path))
    seed_everything(0)
    return model, renderer_for(model, 1)(sample(model, model.prior, number).drawing)


@pytest.fixture(scope="module")
def begun(tmp_path_factory):
    folder = tmp_path_factory.mktemp("begun")
    photographs(folder)
    return folder, made(folder)


def test_it_is_a_model_without_faults_that_a_person_can_read(begun):
    folder, found = begun
    text = found.path.read_text()
    assert len(text.splitlines()) < 120 and max(map(len, text.splitlines())) <= 120
    assert not check_model(load_model(str(found.path))).faults
    assert dict(found.objects) == {"Big Disc": 6, "disc": 6} and found.grounds == 6
    assert len(list((folder / "model" / "cutouts" / "disc").iterdir())) == found.cutouts["disc"]
    for file in (folder / "model").rglob("*.png"):
        with Image.open(file) as picture:
            assert picture.mode == ("RGBA" if file.parent.parent.name == "cutouts" else "RGB")


def test_its_objects_are_as_large_and_as_bright_as_those_of_the_photographs(begun):
    folder, found = begun
    for kind, radius in (("disc", RADIUS["disc"]), ("big_Disc", RADIUS["Big Disc"])):
        for sprite in Atlas.from_folder(folder / "model" / "cutouts" / kind).sprites:
            there = sprite[..., 3] > 127
            assert there.sum() == pytest.approx(np.pi * radius**2, rel=0.1)
            assert (
                np.abs(sprite[there][:, :3].mean(0) / (210, 190, 170) - 1).max() < 0.15
            )  # the light's differs by so much
    model, batch = rendered_prior(found.path)
    sides = (batch.box[..., 2:] - batch.box[..., :2]).amax(-1)
    whole = (batch.visible > 0.99) & (batch.kind == model.grammar.kind("disc"))
    assert 0.75 * 2 * RADIUS["disc"] < float(sides[whole].min()) <= float(sides[whole].max()) < 1.3 * 2 * RADIUS["disc"]


def test_where_objects_were_the_ground_goes_on(tmp_path):
    photographs(tmp_path, number=1, each=3)
    made(tmp_path)
    (file,) = (tmp_path / "model" / "grounds").iterdir()
    pixels = np.asarray(Image.open(file)).astype(float)
    expected = ground(np.random.default_rng(1))
    smooth = [cv2.GaussianBlur(image, (0, 0), 4) for image in (pixels, expected)]
    assert np.abs(smooth[0] - smooth[1]).max() < 8
    rough = [(image - cv2.GaussianBlur(image, (0, 0), 2))[8:-8, 8:-8].std() for image in (pixels, expected)]
    assert rough[0] == pytest.approx(rough[1], rel=0.2)


def test_objects_that_never_overlap_do_not(begun):
    _, found = begun
    _, batch = rendered_prior(found.path, 64)
    assert "ps.separate" in found.path.read_text()
    assert float((batch.visible[batch.kind >= 0] > 0.8).float().mean()) > 0.95


def test_its_own_labels_are_read_with_it(begun):
    folder, found = begun
    model = load_model(str(found.path))
    target = ImageFolder(folder / "photos", model.canvas, model.channels)
    read = read_boxes(folder / "model" / "labels.json", model, target)
    assert model.classes == read.classes == ("big_Disc", "disc") and read.counts.sum(0).tolist() == [6, 6]
    assert any("big_Disc" in note for note in found.notes)


def test_the_same_photographs_give_the_same_bytes(begun):
    folder, found = begun
    made(folder, "again")
    files = sorted(file.relative_to(folder / "again") for file in (folder / "again").rglob("*") if file.is_file())
    assert len(files) > 15
    for file in files:
        one, other = ((folder / name / file).read_bytes() for name in ("model", "again"))
        assert one == other.replace(b"def again(", b"def model(")


def test_photographs_that_were_cut_are_known_by_their_pixels(begun):
    folder, found = begun
    record = json.loads((found.path.parent / "begun.json").read_text())
    shutil.copytree(folder / "photos", folder / "set" / "images", dirs_exist_ok=True)
    shutil.copy(folder / "labels.json", folder / "set" / "annotations.json")
    digests = {example.path.name: example.digest for example in read_set(folder / "set").examples}
    assert {each["name"]: each["digest"] for each in record["photographs"]} == digests


def test_masks_are_taken_as_they_are(tmp_path):
    file = photographs(tmp_path, number=1, each=1, names=("disc",))
    x, y, w, h = json.loads(file.read_text())["annotations"][0]["bbox"]
    square = [x + 4, y + 4, x + w - 4, y + 4, x + w - 4, y + h - 4, x + 4, y + h - 4]
    change(file, segmentation=[square])
    made(tmp_path)
    (sprite,) = Atlas.from_folder(tmp_path / "model" / "cutouts" / "disc").sprites
    assert (sprite[..., 3] > 127).sum() == pytest.approx((w - 8) * (h - 8), rel=0.15)


def test_little_is_said_to_be_little(tmp_path):
    photographs(tmp_path, number=1, each=3, names=("disc",))
    found = made(tmp_path)
    assert any("disc: 3 objects are all" in note for note in found.notes)
    assert any("Only one photograph" in note for note in found.notes)
    rendered_prior(found.path, 4)


def test_a_class_that_is_always_at_the_border_is_drawn_as_it_is(tmp_path):
    photographs(tmp_path, number=4, each=1, names=("disc",), at=lambda rng, w, h: (0.0, rng.uniform(20, h - 20)))
    found = made(tmp_path)
    assert found.cutouts["disc"] == 4 and any("cut by the border" in note for note in found.notes)
    rendered_prior(found.path, 4)


def test_photographs_of_several_sizes_and_of_grey_and_colour(tmp_path):
    photographs(tmp_path, sizes=((96, 128), (192, 256), (120, 100)))
    grey = tmp_path / "photos" / "0.png"
    Image.open(grey).convert("L").save(grey)
    found = made(tmp_path)
    model, batch = rendered_prior(found.path, 4)
    assert model.canvas == (96, 128) and model.channels == 3 and batch.image.shape[2:] == (96, 128)


def test_what_is_no_object_is_drawn_without_a_label(tmp_path):
    photographs(tmp_path)
    found = made(tmp_path, ignore=("disc",))
    model, batch = rendered_prior(found.path, 64)
    assert model.classes == ("big_Disc",) and "DIRT" in found.path.read_text()
    empty = (batch.kind < 0).all(1)
    assert empty.any() and float(batch.image[empty].float().amax((1, 2, 3)).max()) > 190


def test_what_a_detector_found_makes_grounds_and_distractors(tmp_path):
    """Of six photographs of a small and a large disc three are labelled; a detector finds all discs and 0.png's corner.
    In one of the labelled ones the small disc's label is missing."""
    whole = json.loads(photographs(tmp_path).read_text())
    seen = [{**one, "score": 0.9} for one in whole["annotations"]]
    seen.append({**seen[0], "id": 99, "bbox": [0, 0, 8, 8], "score": 0.2})  # too unsure
    (tmp_path / "found.json").write_text(json.dumps({**whole, "annotations": seen}))
    some = [one for one in whole["annotations"] if one["image_id"] <= 3]
    small = next(one for one in some if one["category_id"] == 1)
    some = {"images": whole["images"][:3], "annotations": [one for one in some if one is not small]}
    (tmp_path / "labels.json").write_text(json.dumps(whole | some))
    first, second = made(tmp_path), made(tmp_path, "second", detections=tmp_path / "found.json")
    assert (first.grounds, second.grounds) == (3, 6)
    assert second.cutouts == {**first.cutouts, "ignore": 1} and second.objects == {**first.objects, "ignore": 1}
    for file in (tmp_path / "second" / "grounds").iterdir():
        assert np.asarray(Image.open(file)).max() < 170
    assert load_model(str(second.path)).classes == load_model(str(first.path)).classes
    record = json.loads((second.path.parent / "begun.json").read_text())
    assert [each["name"] for each in record["photographs"]] == [f"{i}.png" for i in range(6)]
    model = load_model(str(second.path))
    labelled = ImageFolder([tmp_path / "photos" / f"{i}.png" for i in range(3)], model.canvas, 3)
    assert read_boxes(second.path.parent / "labels.json", model, labelled).counts.sum() == 5


def test_what_kitti_does_not_care_about_is_no_distractor(tmp_path):
    """A detector finds all discs; the small ones have no label, but stand in such regions."""
    whole = json.loads(photographs(tmp_path).read_text())
    (tmp_path / "found.json").write_text(json.dumps(whole))
    (tmp_path / "label_2").mkdir()
    for image in whole["images"]:
        lines = []
        for one in (one for one in whole["annotations"] if one["image_id"] == image["id"]):
            x, y, width, height = one["bbox"]
            kind = "Disc" if one["category_id"] == 2 else "DontCare"
            lines.append(f"{kind} 0 0 0 {x} {y} {x + width} {y + height} -1 -1 -1 -1000 -1000 -1000 -10\n")
        (tmp_path / "label_2" / f"{Path(image['file_name']).stem}.txt").write_text("".join(lines))
    options = BeginOptions(detections=tmp_path / "found.json")
    found = begin(tmp_path / "photos", tmp_path / "label_2", tmp_path / "model", options, progress=False)
    assert dict(found.objects) == {"Disc": 6}


def test_what_lies_on_something_is_drawn_on_it(tmp_path):
    """Small discs lie on large ones, which are drawn from those that have none."""
    file = photographs(tmp_path, number=8, each=2, names=("Big Disc",))
    whole, rng = json.loads(file.read_text()), np.random.default_rng(5)
    for one in [one for one in whole["annotations"] if one["id"] % 2]:
        x, y, side, _ = one["bbox"]
        path = tmp_path / "photos" / f"{one['image_id'] - 1}.png"
        image = np.asarray(Image.open(path)).astype(float)
        at = x + side / 2 + rng.uniform(-4, 4), y + side / 2 + rng.uniform(-4, 4)
        rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
        image[np.hypot(columns - at[0], rows - at[1]) < 6] = (60, 40, 90)
        Image.fromarray(image.astype(np.uint8)).save(path)
        box = [at[0] - 6, at[1] - 6, 12, 12]
        whole["annotations"].append({**one, "id": one["id"] + 100, "category_id": 1, "bbox": box})
    file.write_text(json.dumps(whole))
    found = made(tmp_path)
    assert "big_Disc(List_disc)" in found.path.read_text() and found.cutouts == {"Big Disc": 8, "disc": 8}
    model = load_model(str(found.path))
    assert not check_model(model).faults
    seed_everything(0)
    scenes = sample(model, model.prior, 64)
    small = scenes.derivation.kind == model.grammar.kind("disc")
    batch = renderer_for(model, 1)(scenes.drawing)
    middle = (batch.amodal_box[..., :2] + batch.amodal_box[..., 2:]) / 2
    parent = scenes.derivation.parent.clamp(min=0).unsqueeze(-1).expand(-1, -1, 2)
    away = (middle - middle.gather(1, parent)).abs().amax(-1)
    assert small.any() and float(away[small & (batch.visible > 0)].max()) < 8
    assert (scenes.derivation.kind.gather(1, parent[..., 0])[small] == model.grammar.kind("big_Disc")).all()


def bars(folder: Path, angle) -> None:
    photographs(folder, number=6, each=0)
    rng, annotations = np.random.default_rng(3), []
    for i in range(6):
        file = folder / "photos" / f"{i}.png"
        image, turn = np.asarray(Image.open(file)).copy(), angle(rng)
        corners = cv2.boxPoints(((64, 48), (36, 10), float(np.degrees(turn))))
        cv2.fillPoly(image, [corners.astype(np.int32)], (220, 220, 220))
        (x0, y0), (x1, y1) = corners.min(0).tolist(), corners.max(0).tolist()
        annotations.append({"id": i + 1, "image_id": i + 1, "category_id": 1, "bbox": [x0, y0, x1 - x0, y1 - y0]})
        Image.fromarray(image).save(file)
    whole = json.loads((folder / "labels.json").read_text())
    (folder / "labels.json").write_text(json.dumps({**whole, "annotations": annotations}))


@pytest.mark.parametrize("differ", [True, False])
def test_objects_turn_where_their_directions_differ(tmp_path, differ):
    bars(tmp_path, (lambda rng: rng.uniform(0, np.pi)) if differ else (lambda rng: 0.1))
    found = made(tmp_path)
    assert ('TURNED = ("disc",)' in found.path.read_text()) == differ
    text = made(tmp_path, "other", turn=not differ).path.read_text()
    assert ('TURNED = ("disc",)' in text) != differ


FAULTS = {
    "no size": (dict(bbox=[5, 5, 0, 4]), "width and height above 0"),
    "outside": (dict(bbox=[500, 5, 4, 4]), "expected boxes on the image of 128x96"),
    "another mask": (dict(segmentation={"size": [3, 3], "counts": [4, 5]}), "expected a mask of 128x96"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_bad_labels_are_one_message_and_no_folder(fault, tmp_path):
    changes, words = FAULTS[fault]
    change(photographs(tmp_path), **changes)
    with pytest.raises(DataError, match=words):
        made(tmp_path)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["labels.json", "photos"]


def test_a_box_around_all_of_a_photograph_is_left_out(tmp_path):
    change(photographs(tmp_path), bbox=[0, 0, WIDTH, HEIGHT])
    found = made(tmp_path)
    assert any("1 objects that cover the whole photograph" in note for note in found.notes)


def test_a_folder_that_holds_files_is_not_written(begun, call):
    folder, found = begun
    result = call("begin", folder / "photos", "--labels", folder / "labels.json", "--out", folder / "model")
    assert result.code == 2 and "expected a new or empty folder" in result.err and result.err.count("\n") == 1
    assert found.path.is_file()


def test_labels_of_other_photographs(tmp_path):
    photographs(tmp_path)
    shutil.rmtree(tmp_path / "photos")
    (tmp_path / "photos").mkdir()
    Image.new("RGB", (8, 8)).save(tmp_path / "photos" / "else.png")
    with pytest.raises(DataError, match="expected labels of photographs in"):
        made(tmp_path)


@pytest.mark.parametrize("name", ["2024-cells", "class", "ärger", "scene"])
def test_models_and_classes_of_any_name(name, tmp_path):
    file = photographs(tmp_path, number=2)
    file.write_text(file.read_text().replace("Big Disc", f"{name} 1/2").replace('"disc"', f'"{name}"'))
    model, _ = rendered_prior(made(tmp_path, name).path, 2)
    assert len(model.classes) == 2


def test_the_command_says_what_it_made(tmp_path, call):
    photographs(tmp_path)
    out = tmp_path / "made"
    result = call("begin", tmp_path / "photos", "--labels", tmp_path / "labels.json", "--out", out, "--canvas", "64x48")
    assert result.code == 0 and "of 6 disc" in result.out and load_model(str(out / "model.py")).canvas == (48, 64)


def test_what_is_deleted_is_no_longer_drawn_and_binds_no_run(begun, tmp_path):
    folder, _ = begun
    shutil.copytree(folder / "model", tmp_path / "copy")
    before = load_model(str(tmp_path / "copy" / "model.py")).assets
    next((tmp_path / "copy" / "cutouts" / "disc").iterdir()).unlink()
    assert load_model(str(tmp_path / "copy" / "model.py")).assets != before
    shutil.rmtree(tmp_path / "copy" / "cutouts" / "disc")
    with pytest.raises(DataError, match="expected PNG files in"):
        load_model(str(tmp_path / "copy" / "model.py"))


def test_real_cells(data_dir, tmp_path):
    """Twenty photographs, if there are some."""
    source = data_dir / "cells"
    if not source.is_dir():
        pytest.skip(f"no cells in {data_dir}")
    whole = json.loads((source / "annotations.json").read_text())
    images = whole["images"][::19]
    ids = {image["id"] for image in images}
    some = {**whole, "images": images, "annotations": [a for a in whole["annotations"] if a["image_id"] in ids]}
    (tmp_path / "labels.json").write_text(json.dumps(some))
    found = begin(source / "images", tmp_path / "labels.json", tmp_path / "model", progress=False)
    assert min(found.cutouts.values()) > 4
    model, batch = rendered_prior(found.path, 8)
    assert torch.isin(batch.kind, torch.tensor([-1, 0, 1])).all() and model.classes == ("dead", "live")
    with Image.open(found.path.parent / "cutouts.png") as sheet:
        assert sheet.size[0] > 500
    assert stored((found.path.parent / "cutouts.png").read_bytes())[1][1] > 500
