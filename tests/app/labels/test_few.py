"""A handful of labels: counts and boxes against plain loops and painted pictures; every fault by file and entry."""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import assume, given
from hypothesis import strategies as st

from probscene.app.datasets.generate import generate_scenes
from probscene.app.evaluation.labels import counts_of_dataset, read_labels
from probscene.app.labels.annotations import Annotation
from probscene.app.labels.boxes import on_canvas
from probscene.app.labels.counts import write_cells
from probscene.app.labels.partial_labels import (
    MIN_LABELLED_IMAGES,
    PartlyLabelledImages,
    labels_record,
    read_partial_labels,
)
from probscene.app.loading import load_model
from probscene.dataset import ImageFolder
from probscene.decoding import fitted, window
from probscene.errors import DataError
from probscene.image_array import ImageArray

CELLS = SimpleNamespace(name="cells", classes=("rbc", "wbc", "platelet"))
SIZE = (48, 64)


def pictures(number: int, size=SIZE, canvas=(24, 32)) -> ImageArray:
    """Images that are called ``image 0``, ``image 1``, ..."""
    return ImageArray(np.arange(number * size[0] * size[1], dtype=np.uint8).reshape(number, *size), canvas, 3)


def coco(path: Path, images: list, categories=("platelet", "rbc"), size=SIZE, other=None) -> Path:
    """A file with an entry for every item of ``images``: its name and its boxes as (category, x, y, w, h)."""
    entries, annotations = [], []
    for i, (name, boxes) in enumerate(images):
        entries.append({"id": 10 + i, "file_name": f"somewhere/{name}", "height": size[0], "width": size[1]})
        annotations += [{"image_id": 10 + i, "category_id": c, "bbox": box} for c, *box in boxes]
    whole = {"images": entries, "annotations": annotations}
    whole["categories"] = [{"id": i, "name": name} for i, name in enumerate(categories)]
    path.write_text(json.dumps(whole | (other or {})))
    return path


@st.composite
def boxes(draw):
    """A box of at least two pixels of an image, and the image's and the canvas's size."""
    size, canvas = draw(st.tuples(*[st.integers(16, 90)] * 2)), draw(st.tuples(*[st.integers(16, 90)] * 2))
    y, x = (sorted(draw(st.sets(st.integers(0, side), min_size=2, max_size=2))) for side in size)
    return size, canvas, (x[0], y[0], x[1], y[1])


@given(boxes())
def test_a_box_lies_where_its_pixels_are_seen(case):
    size, canvas, (x0, y0, x1, y1) = case
    assume(x1 - x0 >= 8 and y1 - y0 >= 8)
    picture = np.zeros(size, np.uint8)
    picture[y0:y1, x0:x1] = 255
    target = SimpleNamespace(sizes=[size], windows=[window(size, canvas)], canvas=canvas)
    (found,) = on_canvas(target, {0: [Annotation("a", x0, y0, x1, y1)]}, ("a",), ()).boxes
    assume(len(found))
    rows, columns = (fitted(picture, canvas)[0] > 127).nonzero()
    assume(len(rows))
    seen = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
    near = 1 + max(canvas[0] / size[0], canvas[1] / size[1])  # linear interpolation blurs where images grow
    assert np.allclose(found[0, 1:].numpy(), seen, atol=near)


@given(st.lists(st.none() | st.lists(st.integers(0, 1), max_size=4), min_size=MIN_LABELLED_IMAGES, max_size=8))
def test_counts_are_those_of_the_boxes(tmp_path_factory, each):
    """An image that is listed has as many as it has boxes; one that is not has no labels."""
    assume(sum(found is not None for found in each) >= MIN_LABELLED_IMAGES)
    listed = [
        (f"image {i}", [(c, 4 * k, 5, 3, 6) for k, c in enumerate(x)]) for i, x in enumerate(each) if x is not None
    ]
    path = coco(tmp_path_factory.mktemp("few") / "few.json", listed[::-1])
    few = read_partial_labels(path, CELLS, pictures(len(each)))
    assert few.classes == ("rbc", "platelet")
    assert few.rows.tolist() == [i for i, found in enumerate(each) if found is not None]
    known = [found for found in each if found is not None]
    assert few.counts.tolist() == [[found.count(1), found.count(0)] for found in known]
    for found, rows in zip(known, few.boxes, strict=True):
        assert rows[:, 0].tolist() == [1 - c for c in found]
        assert rows[:, 1:].tolist() == [[2 * k, 2.5, 2 * k + 1.5, 5.5] for k in range(len(found))]
    never = [name for name, c in (("rbc", 1), ("platelet", 0)) if not any(c in found for found in known)]
    assert any(all(name in note for name in never) for note in few.notes) == bool(never)


rows_of_counts = st.lists(st.none() | st.tuples(*[st.integers(0, 30)] * 3), min_size=MIN_LABELLED_IMAGES, max_size=9)


@given(rows_of_counts, st.sampled_from(",;\t"), st.integers(0, 2), st.randoms(use_true_random=False))
def test_a_sheet_may_be_filled_in_partly(tmp_path_factory, each, delimiter, without, rng):
    """Rows without any count are not labelled, nor is a class whose column is empty; spreadsheets change commas."""
    assume(sum(found is not None for found in each) >= MIN_LABELLED_IMAGES)
    path, classes = tmp_path_factory.mktemp("few") / "few.csv", CELLS.classes
    rows = [
        [f"image {i}", *("" if x is None or c == without else str(x[c]) for c in range(3))] for i, x in enumerate(each)
    ]
    rng.shuffle(rows)
    write_cells(path, rows, classes)
    path.write_text(path.read_text().replace(",", delimiter) + delimiter * 3 + "\n")
    few = read_partial_labels(path, CELLS, pictures(len(each)))
    left = [c for c in range(3) if c != without]
    assert few.classes == tuple(classes[c] for c in left) and few.boxes is None
    assert few.rows.tolist() == [i for i, found in enumerate(each) if found is not None]
    assert few.counts.tolist() == [[found[c] for c in left] for found in each if found is not None]
    assert any(classes[without] in note and "empty" in note for note in few.notes)


GOOD = [(f"image {i}", [(0, 5, 5, 9, 9), (1, 8, 8, 9, 9)]) for i in range(MIN_LABELLED_IMAGES)]
TWICE = [{"id": 1, "name": "rbc"}, {"id": 1, "name": "wbc"}]
JSON = {
    "no json": ("{", "COCO's JSON"),
    "a list": ("[]", "images, annotations, categories"),
    "too few": (dict(images=GOOD[:2]), "at least 3 images", "got 2", "probscene label"),
    "unknown images": (dict(images=[("image 9", []), ("image 8", [])]), "'image 9' in images[0]", "and 1 more"),
    "another case of an image": (dict(images=[*GOOD, ("Image 3", [])]), "did you mean 'image 3'"),
    "an image twice": (dict(images=[*GOOD, GOOD[1]]), "second one of image 1", "images[3]"),
    "another case": (dict(images=GOOD, categories=("platelet", "RBC")), "'RBC'", "did you mean 'rbc'"),
    "a plural": (dict(images=GOOD, categories=("Platelets", "rbc")), "did you mean 'platelet'"),
    "no class": (dict(images=GOOD, categories=("cat", "dog")), "rbc, wbc, platelet", "cat, dog"),
    "beside": (dict(images=[*GOOD[1:], ("image 0", [(1, 64, 5, 5, 5)])]), "annotations[4]", "64x48", "rbc"),
    "above": (dict(images=[*GOOD[1:], ("image 0", [(1, 4, -5, 5, 5)])]), "annotations[4]"),
    "no width": (dict(images=[*GOOD[1:], ("image 0", [(1, 4, 5, 0, 5)])]), "annotations[4]", "above 0"),
    "three numbers": (dict(images=[*GOOD[1:], ("image 0", [(1, 4, 5, 5)])]), "annotations[4]", "[4, 5, 5]"),
    "no number": (dict(images=[*GOOD[1:], ("image 0", [(1, 4, float("nan"), 5, 5)])]), "annotations[4]"),
    "an unknown category": (dict(images=[*GOOD[1:], ("image 0", [(7, 4, 5, 5, 5)])]), "category_id", "got 7"),
    "another size": (dict(images=GOOD, size=(480, 640)), "images[0]", "640x480", "got 64x48"),
    "an id twice": (dict(images=GOOD, other={"categories": TWICE}), "categories[1]", "got 1;"),
}  # fmt: skip


@pytest.mark.parametrize("fault", JSON)
def test_faults_of_coco(fault, tmp_path):
    given, *parts = JSON[fault]
    path = tmp_path / "few.json"
    if isinstance(given, str):
        path.write_text(given)
    else:
        coco(path, **given)
    with pytest.raises(DataError) as error:
        read_partial_labels(path, CELLS, pictures(5))
    assert all(part in str(error.value) for part in [*parts, "few.json"]), error.value
    assert str(error.value).startswith("expected ") and "\n" not in str(error.value)


CSV = {
    "a fraction": ("image 0,1,2,.5", "line 2", "'platelet' of image 0", "'.5'", "whole number"),
    "a part of a row": ("image 0,1,,2", "line 2", "'wbc' of image 0", "leave the whole row empty"),
    "twice": ("image 1,1,2,3", "second one of image 1"),
}


@pytest.mark.parametrize("fault", CSV)
def test_faults_of_a_sheet(fault, tmp_path):
    first, *parts = CSV[fault]
    path = tmp_path / "few.csv"
    path.write_text("\n".join(["image,rbc,wbc,platelet", first, *(f"image {i},1,1,1" for i in range(1, 5))]))
    with pytest.raises(DataError) as error:
        read_partial_labels(path, CELLS, pictures(5))
    assert all(part in str(error.value) for part in [*parts, "few.csv"]), error.value


def test_what_is_of_no_class_is_left_out_with_a_note(tmp_path):
    listed = [(name, [*found, (2, 1, 1, 5, 5)]) for name, found in GOOD]
    few = read_partial_labels(coco(tmp_path / "few.json", listed, ("platelet", "rbc", "dust")), CELLS, pictures(4))
    assert few.classes == ("rbc", "platelet") and few.counts.tolist() == [[1, 1]] * 3
    assert any("no such class: dust" in note for note in few.notes)
    (tmp_path / "few.csv").write_text("image,rbc,dust\n" + "".join(f"image {i},1,2\n" for i in range(3)))
    few = read_partial_labels(tmp_path / "few.csv", CELLS, pictures(4))
    assert few.classes == ("rbc",) and any("dust" in note for note in few.notes)


def test_what_sticks_out_is_clipped_and_what_is_cut_away_is_left_out(tmp_path):
    """Of 48 x 64 a canvas of 24 x 24 sees the middle 48 columns."""
    listed = [*GOOD[:2], ("image 2", [(1, -9, -3, 30, 8), (1, 0, 20, 14, 8), (1, 40, 40, 20, 20)])]
    few = read_partial_labels(coco(tmp_path / "few.json", listed), CELLS, pictures(4, canvas=(24, 24)))
    assert few.boxes[2].tolist() == [[0, 0, 0, 6.5, 2.5], [0, 16, 20, 24, 24]]
    assert "1 objects that lie where images are cut are not counted." in few.notes


def test_a_crowd_has_no_count(tmp_path):
    listed = [(f"image {i}", [(1, 5, 5, 9, 9)]) for i in range(4)]
    path = coco(tmp_path / "few.json", listed)
    whole = json.loads(path.read_text())
    whole["annotations"][1]["iscrowd"] = 1
    path.write_text(json.dumps(whole))
    few = read_partial_labels(path, CELLS, pictures(4))
    assert few.rows.tolist() == [0, 2, 3] and any("crowd" in note and "image 1" in note for note in few.notes)
    assert len(read_labels(path, CELLS, pictures(4)).structures) == 3  # no --some-labels needed


def test_structures_are_no_few_labels_and_one_image_is_too_few(tmp_path):
    (tmp_path / "few.jsonl").write_text("")
    with pytest.raises(DataError, match="whole structures"):
        read_partial_labels(tmp_path / "few.jsonl", CELLS, pictures(4))
    (tmp_path / "few.csv").write_text("image,rbc\nimage 0,1\n")
    with pytest.raises(DataError, match="at least 3 images .* got 1; add images"):
        read_partial_labels(tmp_path / "few.csv", CELLS, pictures(1))


def test_two_files_of_one_name_cannot_be_told_apart(tmp_path):
    (tmp_path / "few.csv").write_text("image,rbc\nimage 0,1\n")
    target = pictures(4)
    target.paths[1] = Path("other/image 0")
    with pytest.raises(DataError, match="2 files"):
        read_partial_labels(tmp_path / "few.csv", CELLS, target)


def test_a_generated_dataset_is_read_back(tmp_path, discs):
    model = load_model(str(discs.file))
    generate_scenes(model, model.prior, 6, tmp_path / "set", format="coco")
    names, counts = counts_of_dataset(model, tmp_path / "set")
    target = ImageFolder(tmp_path / "set" / "images", model.canvas, model.channels)
    (path,) = (tmp_path / "set").glob("*.json")
    few = read_partial_labels(path, model, target)
    assert (few.counts.numpy() <= counts).all() and few.counts.sum() > 0.8 * counts.sum()  # discs hide discs
    assert few.classes == model.classes and few.rows.tolist() == list(range(6))
    labelled = PartlyLabelledImages(target, few).labelled
    assert torch.equal(labelled.images[2], target.load(2)) and torch.equal(labelled.counts, few.counts)
    assert PartlyLabelledImages(target, None).labelled is None


def test_a_record_changes_with_what_labels_say(tmp_path):
    file, folder = tmp_path / "few.csv", tmp_path / "label_2"
    folder.mkdir()
    digests = set()
    for text in ("image,rbc\n", "image,wbc\n"):
        file.write_text(text)
        (folder / "a.txt").write_text(text)
        digests |= {labels_record(path)["sha256"] for path in (file, folder)}
    assert len(digests) == 4 and labels_record(file)["path"] == str(file)
    with pytest.raises(DataError, match="none.csv, got none"):
        labels_record(tmp_path / "none.csv")


def test_boxes_and_counts_of_blood_agree(data_dir):
    """But for a red cell of two images, which is in one file alone."""
    blood = data_dir / "blood"
    target = ImageFolder(blood / "images", (120, 160), 3)
    boxes, counts = (read_partial_labels(blood / name, CELLS, target) for name in ("annotations.json", "counts.csv"))
    assert (boxes.counts - counts.counts).abs().sum(0).tolist() == [2, 0, 0]
    assert torch.equal(boxes.rows, counts.rows) and len(counts.rows) == 292
    found = torch.cat(boxes.boxes)
    assert (found[:, 3:] > found[:, 1:3]).all() and found[:, 1:].min() >= 0 and found[:, 3].max() <= 160
