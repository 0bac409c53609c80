"""The one reader of labels: the same objects in every format, and files as other programs write them."""

import json
from pathlib import Path
from types import SimpleNamespace

import hypothesis.extra.numpy
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from PIL import Image
from pycocotools import mask

from probscene.app.datasets.generate import generate_scenes
from probscene.app.evaluation.labels import read_labels
from probscene.app.labels.boxes import read_boxes
from probscene.app.labels.coco import around
from probscene.app.labels.partial_labels import labels_record, read_partial_labels
from probscene.app.loading import load_model
from probscene.app.trial.sets import read_set
from probscene.dataset import ImageFolder
from probscene.errors import DataError
from probscene.image_array import ImageArray

CLASSES = ("rbc", "wbc")
CELLS = SimpleNamespace(name="cells", classes=CLASSES)
HEIGHT, WIDTH = 96, 128
REST = "-1 -1 -1 -1000 -1000 -1000 -10"

sides = st.tuples(st.integers(0, WIDTH - 9), st.integers(0, HEIGHT - 9), st.integers(1, 9), st.integers(1, 9))
objects = st.lists(st.lists(st.tuples(st.sampled_from(CLASSES), sides), max_size=4), min_size=1, max_size=4)


def target(number: int) -> ImageArray:
    return ImageArray(np.zeros((number, HEIGHT, WIDTH), np.uint8), (HEIGHT, WIDTH), 3)


def write_coco(path: Path, images: list, name="image {}", id=int, size=int, shape="bbox") -> Path:
    """COCO's JSON, in the spelling of one program or another."""
    entries, annotations = [], []
    for i, found in enumerate(images):
        entries.append({"id": id(i), "file_name": name.format(i), "width": size(WIDTH), "height": size(HEIGHT)})
        for label, (x, y, w, h) in found:
            one = {"image_id": id(i), "category_id": id(CLASSES.index(label))}
            if shape == "bbox":
                one["bbox"] = [x, y, w, h]
            elif shape == "polygons":
                one |= {"segmentation": [[x, y, x + w, y, x + w, y + h], [x, y, x, y + h, x + w, y + h]], "bbox": []}
            else:
                pixels = np.zeros((HEIGHT, WIDTH), np.uint8, order="F")
                pixels[y : y + h, x : x + w] = 1
                coded = mask.encode(pixels)
                counts = coded["counts"].decode() if shape == "mask" else runs_of(pixels)
                one |= {"segmentation": {**coded, "counts": counts}, "bbox": None}
            annotations.append(one)
    whole = {"images": entries, "annotations": annotations}
    whole["categories"] = [{"id": id(i), "name": label} for i, label in enumerate(CLASSES)]
    path.write_text(json.dumps(whole))
    return path


def runs_of(pixels: np.ndarray) -> list[int]:
    """Of zeros, of ones, of zeros, ..., down the columns."""
    flat = pixels.flatten(order="F")
    ends = [*(np.flatnonzero(np.diff(flat)) + 1).tolist(), len(flat)]
    return ([0] if flat[0] else []) + np.diff([0, *ends]).tolist()


masks = hypothesis.extra.numpy.arrays(np.uint8, st.tuples(*[st.integers(1, 40)] * 2), elements=st.integers(0, 1))


@given(masks)
def test_boxes_of_masks_are_pycocotools(pixels):
    coded = mask.encode(np.asfortranarray(pixels))
    for counts in (coded["counts"].decode(), runs_of(pixels)):
        assert around({"size": list(pixels.shape), "counts": counts}, "") == mask.toBbox(coded).tolist()


@given(st.text(max_size=9) | st.lists(st.integers(-9, 9) | st.none()), st.lists(st.integers(-9, 9) | st.none()))
def test_broken_masks_are_named(counts, size):
    try:
        x, y, w, h = around({"size": size, "counts": counts}, "here")
    except DataError as error:
        assert "size and counts" in str(error) and "here" in str(error)
    else:
        assert min(x, y, w, h) >= 0 and y + h <= size[0] and x + w <= size[1]


def write_kitti(folder: Path, images: list, name="image {}") -> Path:
    """Pixels have numbers there, so that the last one of a box is its right end."""
    folder.mkdir(parents=True)
    for i, found in enumerate(images):
        lines = [f"{label} 0 0 -10 {x} {y} {x + w - 1} {y + h - 1} {REST}\n" for label, (x, y, w, h) in found]
        (folder / f"{name.format(i)}.txt").write_text("".join(lines))
    return folder


def write_yolo(folder: Path, images: list, name="image {}", polygons=False, listed="data.yaml") -> Path:
    """``labels``, with the names in the folder above."""
    (folder / "labels").mkdir(parents=True)
    names = "\n".join(CLASSES) if listed == "classes.txt" else f"names: {json.dumps(CLASSES)}\n"
    (folder / listed).write_text(names)
    for i, found in enumerate(images):
        lines = []
        for label, (x, y, w, h) in found:
            numbers = [(x + w / 2) / WIDTH, (y + h / 2) / HEIGHT, w / WIDTH, h / HEIGHT]
            if polygons:
                corners = [(x, y), (x + w, y), (x + w, y + h), (x, y + h)]
                numbers = [value for cx, cy in corners for value in (cx / WIDTH, cy / HEIGHT)]
            lines.append(" ".join(map(str, [CLASSES.index(label), *numbers])) + "\n")
        (folder / "labels" / f"{name.format(i)}.txt").write_text("".join(lines))
    return folder


@given(
    objects,
    st.sampled_from([int, float, str, lambda i: f"{i}.0"]),
    st.sampled_from([int, str, float, lambda _: 0, lambda _: None, lambda _: "0"]),
    st.sampled_from(["bbox", "polygons", "mask", "runs"]),
    st.sampled_from(["image {}", "some/where/image {}", "C:\\data\\image {}", "/abs/image {}"]),
    st.booleans(),
    st.sampled_from(["data.yaml", "classes.txt"]),
)
def test_the_same_objects_are_read_from_every_format(tmp_path_factory, images, id, size, shape, name, polygons, listed):
    assume(any(images))  # KITTI names no class without an object
    folder = tmp_path_factory.mktemp("labels")
    paths = (
        write_coco(folder / "c.json", images, name, id, size, shape),
        write_kitti(folder / "label_2", images),
        write_yolo(folder / "yolo", images, polygons=polygons, listed=listed),
        folder / "yolo" / "labels",
    )
    expected = [[CLASSES.index(label), x, y, x + w, y + h] for found in images for label, (x, y, w, h) in found]
    for path in paths:
        read = read_boxes(path, CELLS, target(len(images)))
        assert [len(each) for each in read.boxes] == [len(found) for found in images]
        boxes = [row for each in read.boxes for row in each.tolist()]
        names = [[CLASSES.index(read.classes[int(row[0])]), *row[1:]] for row in boxes]
        assert np.allclose(np.reshape(names, (-1, 5)), np.reshape(expected, (-1, 5)), atol=1e-4)


THREE = [[("rbc", (10, 10, 20, 20))], [], [("wbc", (5, 6, 7, 8)), ("rbc", (1, 2, 30, 40))]]


def pictures(folder: Path, names: list) -> Path:
    folder.mkdir(parents=True)
    for i, name in enumerate(names):
        Image.fromarray(np.full((HEIGHT, WIDTH, 3), 30 + i, np.uint8)).save(folder / name)
    return folder


def test_a_trial_reads_the_same_objects_from_every_format(tmp_path):
    names = [f"{i}.png" for i in range(3)]
    pictures(tmp_path / "coco" / "images", names)
    write_coco(tmp_path / "coco" / "annotations.json", THREE, "{}.png")
    pictures(tmp_path / "yolo" / "images", names)
    write_yolo(tmp_path / "yolo", THREE, "{}", polygons=True)
    pictures(tmp_path / "kitti" / "image_2", names)
    write_kitti(tmp_path / "kitti" / "label_2", THREE, "{}")
    coco, yolo, kitti = (read_set(tmp_path / name) for name in ("coco", "yolo", "kitti"))
    assert coco.classes == yolo.classes == kitti.classes == CLASSES and not coco.notes
    for one, other, pixels in zip(coco.examples, yolo.examples, kitti.examples, strict=True):
        assert np.allclose(one.boxes, other.boxes, atol=1e-4) and one.digest == other.digest == pixels.digest
        assert np.allclose(one.boxes - pixels.boxes, [0, 0, 1, 1])
        assert (one.classes == other.classes).all() and (one.classes == pixels.classes).all()
    assert read_set(tmp_path / "kitti" / "label_2").examples[2].boxes.tolist() == kitti.examples[2].boxes.tolist()


@pytest.mark.parametrize("given", ["out", "out/labels", "out/data.yaml"])
def test_generated_labels_of_yolo_are_read_back(given, tmp_path, discs):
    model = load_model(str(discs.file))
    generate_scenes(model, model.prior, 6, tmp_path / "out", format="yolo")
    generate_scenes(model, model.prior, 6, tmp_path / "coco", format="coco")
    images = ImageFolder(tmp_path / "out" / "images", model.canvas, model.channels)
    one, other = (read_partial_labels(tmp_path / path, model, images) for path in (given, "coco/annotations.json"))
    assert one.counts.tolist() == other.counts.tolist() and one.classes == other.classes == model.classes
    for a, b in zip(one.boxes, other.boxes, strict=True):
        assert np.allclose(a, b, atol=1e-3)
    alike = zip(read_set(tmp_path / given).examples, read_set(tmp_path / "coco").examples, strict=True)
    assert all(np.allclose(a.boxes, b.boxes, atol=1e-3) and a.digest == b.digest for a, b in alike)


def test_sets_of_yolo_that_are_split_in_folders(tmp_path):
    """As Ultralytics lays them out, and as Roboflow does; images of one name in both parts."""
    for images, labels in (("a/images/{}", "a/labels/{}"), ("b/{}/images", "b/{}/labels")):
        for part in ("train", "val"):
            pictures(tmp_path / images.format(part), ["0.png"])
            (tmp_path / labels.format(part)).mkdir(parents=True)
            line = "0 .5 .5 .5 .5 .4 .4 2 .6 .6 1\n" if part == "train" else ""
            (tmp_path / labels.format(part) / "0.txt").write_text(line)
        root = tmp_path / images[0]
        (root / "data.yaml").write_text("names:\n  0: rbc\n  1: wbc\nkpt_shape: [2, 3]\n")
        assert sorted(len(example.boxes) for example in read_set(root).examples) == [0, 1]
        for part, number in (("train", 1), ("val", 0)):
            (example,) = read_set(tmp_path / labels.format(part)).examples
            assert len(example.boxes) == number
            seen = ImageFolder(tmp_path / images.format(part), (HEIGHT, WIDTH), 3)
            assert [read_boxes(path, CELLS, seen).counts.tolist() for path in (root, root / "data.yaml")] == [
                [[number, 0]]
            ] * 2


def test_images_of_yolo_lie_beside_their_labels_in_any_folder(tmp_path):
    """Also where one above is called labels."""
    folder = pictures(tmp_path / "labels" / "mine", ["0.png", "1.png"])
    (folder / "classes.txt").write_text("rbc\nwbc\n")
    for i in range(2):
        (folder / f"{i}.txt").write_text("1 .5 .5 .5 .5\n" * i)
    assert [len(example.boxes) for example in read_set(folder).examples] == [0, 1]


YOLO = {
    "a score": ("0 .5 .5 .1 .1 .9", "line 2", "no score"),
    "three numbers": ("0 .5 .5 .1", "at least three corners", "got 4 numbers"),
    "odd corners": ("0 .1 .1 .2 .2 .3 .3 .4", "at least three corners"),
    "a word": ("0 .5 .5 .1 wide", "0 to 1", "wide"),
    "pixels": ("0 64 48 10 10", "0 to 1", "divide"),
    "no width": ("0 .5 .5 0 .1", "above 0"),
    "a class beyond": ("2 .5 .5 .1 .1", "0 to 1", "'2'"),
    "a class in words": ("rbc .5 .5 .1 .1", "number of a class", "'rbc'"),
    "beside": ("0 1.5 .5 .1 .1", "128x96", "line 2", "rbc"),
}


@pytest.mark.parametrize("fault", YOLO)
def test_faults_of_yolo(fault, tmp_path):
    wrong, *parts = YOLO[fault]
    folder = write_yolo(tmp_path / "yolo", [[], []])
    (folder / "labels" / "image 0.txt").write_text(f"1 .5 .5 .1 .1\n{wrong}\n")
    with pytest.raises(DataError, match=r"^expected .*image 0\.txt") as error:
        read_boxes(folder, CELLS, target(2))
    assert all(part in str(error.value) for part in parts), error.value


def test_names_of_yolos_classes_are_needed(tmp_path):
    folder = write_yolo(tmp_path / "a" / "b" / "yolo", THREE)
    for text, said in (
        ("names: 3", "got 3"),
        ("nc: 1", "got None"),
        ("a: [", "YAML"),
        ("names: {a: b}", "names"),
        ("names: [a]\nkpt_shape: 3", "kpt_shape.*got 3"),
        ("names: [a]\nkpt_shape: [2, x]", "kpt_shape"),
    ):
        (folder / "data.yaml").write_text(text)
        with pytest.raises(DataError, match=said) as error:
            read_boxes(folder, CELLS, target(3))
        assert "\n" not in str(error.value)
    (folder / "data.yaml").unlink()
    with pytest.raises(DataError, match=r"got 5; for YOLO's labels put their data\.yaml or classes\.txt beside"):
        read_boxes(folder / "labels", CELLS, target(3))


def test_a_run_records_what_yolos_classes_are_called(tmp_path):
    folder = write_yolo(tmp_path / "yolo", THREE)
    before = labels_record(folder)["sha256"]
    (folder / "data.yaml").write_text("names: [wbc, rbc]\n")
    assert labels_record(folder)["sha256"] != before


def changed(**of_first):
    return lambda whole: whole["images"][0].update(of_first)


def another(**entry):
    return lambda whole: whole["images"].append({"id": 9, "width": 9, "height": 9, **entry})


SPELT = {
    "a size of text": changed(width=" 128 ", height="96.0"),
    "an unknown size": changed(width=0, height=0),
    "no size": changed(width=None, height="?"),
    "another image": another(file_name="other.png"),
    "many others": lambda whole: [another(id=10 + i, file_name=f"{i}/x{i}.jpg")(whole) for i in range(20)],
    "an image of another folder": another(file_name="val/0.png"),
    "a Windows path": changed(file_name="D:\\photos\\images\\0.png"),
    "a folder": changed(file_name="images/0.png"),
    "a box of zeros": lambda whole: whole["annotations"][0].update(
        bbox=[0, 0, 0, 0], segmentation=[10, 10, 30, 10, 30, 30, 10, 30]
    ),
    "numbers as text": lambda whole: whole["annotations"][0].update(bbox=["10", "10", "20", "2e1"], iscrowd="0"),
}  # fmt: skip


@pytest.mark.parametrize("spelling", SPELT)
def test_every_command_reads_cocos_spellings(spelling, tmp_path):
    folder = pictures(tmp_path / "images", [f"{i}.png" for i in range(3)])
    path = write_coco(tmp_path / "annotations.json", THREE, "images/{}.png" if "another f" in spelling else "{}.png")
    whole = json.loads(path.read_text())
    SPELT[spelling](whole)
    path.write_text(json.dumps(whole))
    seen = ImageFolder(folder, (HEIGHT, WIDTH), 3)
    counts = [[1, 0], [0, 0], [1, 1]]
    few, labels, found = read_partial_labels(path, CELLS, seen), read_labels(path, CELLS, seen), read_set(tmp_path)
    assert few.counts.tolist() == labels.structures.counts.tolist() == counts
    assert [np.bincount(example.classes, minlength=2).tolist() for example in found.examples] == counts
    for one, example in zip(few.boxes, found.examples, strict=True):
        assert np.allclose(one[:, 1:], example.boxes)
    more = {"another image": "other.png.", "many others": "0/x0.jpg and 19 more."}.get(spelling)
    for notes in (few.notes, labels.notes, found.notes):
        said = [note for note in notes if note.startswith("Not read, since ")]
        assert len(said) == (spelling in ("another image", "many others", "an image of another folder"))
        assert more is None or said[0].endswith(f"images has no such image: {more}")


WRONG = {
    "another size": (changed(width=127), "0.png to be 127x96 as in images[0]", "got 128x96"),
    "an id twice": (changed(id="1"), "images[1]", "got 1;"),
    "no id": (changed(id=True), "images[0]", "got true"),
    "two entries": (another(file_name="0.png"), "second one of 0.png in images[3]"),
    "case": (changed(file_name="0.PNG"), "'0.PNG'", "did you mean '0.png'"),
    "no polygon": (lambda whole: whole["annotations"][0].update(bbox=None, segmentation=[[1, 2, 3]]), "three corners"),
    "no mask": (lambda whole: whole["annotations"][0].update(bbox=None, segmentation={"a": 1}), "size and counts"),
    "a mask of another size": (
        lambda whole: whole["annotations"][0].update(bbox=None, segmentation={"size": [2, 4], "counts": [1, 7]}),
        "a mask of 128x96 in annotations[0]",
        "got 4x2",
    ),
    "no box": (lambda whole: whole["annotations"][0].update(bbox=None), "annotations[0]", "got null"),
    "a class twice": (lambda whole: whole["categories"][0].update(name="wbc"), "'wbc' more than once"),
}


@pytest.mark.parametrize("fault", WRONG)
def test_every_command_refuses_a_fault_in_the_same_words(fault, tmp_path):
    how, *parts = WRONG[fault]
    seen = ImageFolder(pictures(tmp_path / "images", [f"{i}.png" for i in range(3)]), (HEIGHT, WIDTH), 3)
    path = write_coco(tmp_path / "annotations.json", THREE, "{}.png")
    whole = json.loads(path.read_text())
    how(whole)
    path.write_text(json.dumps(whole))
    said = []
    for read in (
        lambda: read_partial_labels(path, CELLS, seen),
        lambda: read_labels(path, CELLS, seen),
        lambda: read_set(tmp_path),
    ):
        with pytest.raises(DataError) as error:
            read()
        said.append(str(error.value))
    assert len(set(said)) == 1 and all(part in said[0] for part in parts), said
