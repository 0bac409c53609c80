"""KITTI's label files as the truth, against plain loops and torchvision's reader; every fault by file and line."""

import csv
import json
from collections import Counter
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torchvision
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from pycocotools.coco import COCO

from probscene.app.datasets.generate import generate_scenes
from probscene.app.evaluation.labels import VISIBLE_NOTE, read_labels
from probscene.app.evaluation.structure_counts import sample_counts
from probscene.app.evaluation.visible import MAX_RENDERED, Visibility, count_scenes, count_visible
from probscene.app.fitting.run import RunFolder
from probscene.app.labels.boxes import read_boxes
from probscene.app.labels.kitti import read_objects
from probscene.app.loading import load_model
from probscene.dataset import ImageFolder
from probscene.errors import DataError

STREET = SimpleNamespace(name="street", classes=("tree", "car", "pedestrian", "bike", "truck"))
CLASS = {"Car": "car", "Pedestrian": "pedestrian", "Person_sitting": "pedestrian", "Cyclist": "bike", "Truck": "truck"}
OTHERS = ("Van", "Tram", "Misc", "DontCare")
REST = "1.50 1.60 3.90 1.00 1.70 12.00 0.10"


def line(type, height=30.0, left=10.0, top=100.0) -> str:
    return f"{type} 0.00 0 0.02 {left:.2f} {top:.2f} {left + 40:.2f} {top + height:.2f} {REST}"


def images(folder, names) -> SimpleNamespace:
    """Of an ``ImageFolder``, the paths, the files' sizes, and that nothing is cut."""
    paths = [Path(folder, name) for name in names]
    alike = {"windows": [None] * len(names), "sizes": [(375, 1242)] * len(names), "canvas": (188, 621)}
    return SimpleNamespace(path=Path(folder), paths=paths, bad={}, **alike)


@given(st.lists(st.lists(st.sampled_from([*CLASS, *OTHERS])), min_size=1, max_size=9))
def test_counts_are_those_of_the_lines(tmp_path_factory, frames):
    folder = tmp_path_factory.mktemp("label_2")
    for i, types in enumerate([*frames, ["Car"]]):  # the last one is of no image
        (folder / f"{i:06d}.txt").write_text("".join(line(type) + "\n" for type in types))
    target = images("x", [f"{i:06d}.{('png', 'jpg')[i % 2]}" for i in range(len(frames))])
    read = read_boxes(folder, STREET, target)
    counts, classes, notes = read.counts, read.classes, read.notes
    assert classes == ("car", "pedestrian", "bike", "truck")  # nobody labels trees
    assert counts.tolist() == [[sum(CLASS.get(t) == c for t in types) for c in classes] for types in frames]
    out = Counter(type for types in frames for type in types if type in OTHERS)
    assert notes[0] == f"Not read, since x has no such image: {len(frames):06d}.txt."
    regions = out.pop("DontCare", 0)
    assert all(any(f"{number} {type}" in note for note in notes) for type, number in out.items())
    marked = sum("DontCare" in types for types in frames)
    assert (f"{marked} of {len(frames)} images have regions marked DontCare" in notes[-1]) == bool(regions)
    assert any("Cyclist as bike" in note for note in notes) == any("Cyclist" in types for types in frames)


def test_low_objects_are_counted_only_where_not_said_otherwise(tmp_path):
    (tmp_path / "a.txt").write_text("\n".join(line("Car", height) for height in (10, 24.9, 25, 60)))
    (tmp_path / "b.txt").write_text(line("DontCare", 3) + "\r\n\n")
    target = images("x", ["a.png", "b.png"])
    assert read_boxes(tmp_path, STREET, target).counts[:, 0].tolist() == [4, 0]
    read = read_boxes(tmp_path, STREET, target, min_height=25)
    counts, notes = read.counts, read.notes
    assert counts[:, 0].tolist() == [2, 0] and "2 objects of less than 25 pixels" in notes[-1]


def test_regions_count_as_marked_where_an_object_in_them_could_be_counted(tmp_path):
    for name, height in (("a", 24.9), ("b", 25), ("c", 60)):
        (tmp_path / f"{name}.txt").write_text(f"{line('Car')}\n{line('DontCare', height)}\n{line('DontCare', 3)}\n")
    target = images("x", ["a.png", "b.png", "c.png"])
    *_, note = read_boxes(tmp_path, STREET, target, min_height=25).notes
    assert note == (
        "2 of 3 images have regions marked DontCare that are at least 25 pixels high; objects there are not labelled, "
        "so that these images may show more than their labels say."
    )
    assert "3 of 3 images have regions marked DontCare; objects" in read_boxes(tmp_path, STREET, target).notes[-1]
    assert "DontCare" not in " ".join(read_boxes(tmp_path, STREET, target, min_height=61).notes)


def test_objects_whose_middle_is_cut_away_are_not_counted(tmp_path):
    Image.fromarray(np.zeros((300, 400, 3), np.uint8)).save(tmp_path / "a.png")
    target = ImageFolder(tmp_path, (50, 100), 3)
    assert tuple(target.windows[0]) == (50, 0, 200, 400)
    middles = (48, 49.4, 49.5, 150, 249.4, 249.5, 260)  # the upper row's own is 0
    (tmp_path / "a.txt").write_text("\n".join(f"Car 0 0 0 10 {y - 4} 50 {y + 4} {REST}" for y in middles))
    read = read_boxes(tmp_path, STREET, target)
    counts, notes = read.counts, read.notes
    assert counts[0, 0] == 3
    assert notes == ("4 objects that lie where images are cut are not counted.",)


def test_boxes_of_images_of_another_size_are_refused(tmp_path):
    """Cut boxes end beyond an image, those of its labels begin within it."""
    target = images("x", ["a.png"])
    for left, height, error in ((1230, 400, False), (1242, 20, True), (-80, 20, True), (-39, 20, False)):
        (tmp_path / "a.txt").write_text(line("Car") + "\n" + line("Car", height, left))
        if error:
            with pytest.raises(DataError, match=r"image of 1242x375 in .*a\.txt, got .*of another size"):
                read_boxes(tmp_path, STREET, target)
        else:
            assert read_boxes(tmp_path, STREET, target).counts[0, 0] == 2


def test_names_of_the_model_go_first(tmp_path):
    (tmp_path / "a.txt").write_text("\n".join(map(line, ("Pedestrian", "Person_sitting", "Person_sitting"))))
    model = SimpleNamespace(name="m", classes=("person", "Person_Sitting"))
    assert read_boxes(tmp_path, model, images("x", ["a.png"])).counts.tolist() == [[1, 2]]


def test_images_without_a_file_are_left_out_only_where_some_are_labelled(tmp_path):
    (tmp_path / "b.txt").write_text(line("Car"))
    target = images("x", ["a.png", "b.png", "c.png"])
    with pytest.raises(DataError, match="got none of a.png and 1 more"):
        read_boxes(tmp_path, STREET, target)
    assert read_boxes(tmp_path, STREET, target, allow_missing=True).counts.tolist() == [[1, 0, 0, 0]]
    (tmp_path / "b.txt").unlink()
    with pytest.raises(DataError, match="got none; label at least one"):
        read_boxes(tmp_path, STREET, target, allow_missing=True)


FAULTS = {
    "fourteen columns": (line("Car").rsplit(" ", 1)[0], "15 columns", "got 14; fix the line"),
    "a score": (line("Car") + " 0.93", "15 columns", "got 16; ", "no score"),
    "two words": (line("Person sitting"), "15 columns", "got 16"),
    "seventeen columns": (line("Car") + " 0.93 1", "15 columns", "got 17; fix the line"),
    "a number with a gap": (line("Car").replace("12.00", "1_2"), "a number for z", "'1_2'"),
    "a word": (line("Car").replace("12.00", "far"), "a number for z", "'far'"),
    "not a number": (line("Car").replace("130.00", "nan"), "a number for bottom", "'nan'"),
    "without end": (line("Car").replace("1.60", "inf"), "a number for width", "'inf'"),
    "a box that is turned": (line("Car", -3), "top to bottom", "10.00 100.00 50.00 97.00"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_wrong_lines_are_named(fault, tmp_path):
    wrong, *parts = FAULTS[fault]
    (tmp_path / "000007.txt").write_text("\n".join([line("Car"), "", wrong, line("Van")]))
    with pytest.raises(DataError, match=r"^expected .* in line 3 of .*000007\.txt") as error:
        read_boxes(tmp_path, STREET, images("x", ["000007.png"]))
    assert all(part in str(error.value) for part in parts) and "\n" not in str(error.value)


def test_what_is_no_text_or_has_no_class(tmp_path):
    (tmp_path / "a.txt").write_bytes(b"Car \xff")
    with pytest.raises(DataError, match="UTF-8"):
        read_boxes(tmp_path, STREET, images("x", ["a.png"]))
    (tmp_path / "a.txt").write_text(line("Car"))
    model = SimpleNamespace(name="digits", classes=("0", "1"))
    with pytest.raises(DataError, match=r"'digits' has classes for \(0, 1\), got Car"):
        read_boxes(tmp_path, model, images("x", ["a.png"]))


def test_a_written_dataset_is_read_back(tmp_path):
    model = load_model(str(Path(__file__).parents[1] / "plates.py"))
    generate_scenes(model, model.prior, 40, tmp_path / "out", seed=1, format="kitti,coco")
    dataset = COCO(tmp_path / "out" / "annotations.json")
    seen = [Counter(dataset.cats[a["category_id"]]["name"] for a in dataset.imgToAnns[i]) for i in range(40)]
    target = ImageFolder(tmp_path / "out" / "images", model.canvas, model.channels)
    read = read_labels(tmp_path / "out" / "Kitti" / "raw" / "training" / "label_2", model, target)
    assert read.classes == model.classes and read.notes == (VISIBLE_NOTE,)
    assert read.structures.counts.tolist() == [[found[name] for name in model.classes] for found in seen]


@pytest.mark.parametrize("file", ["plates.py", "lots.py"])
def test_scenes_are_counted_as_the_labels_that_would_be_written_of_them(file, tmp_path):
    model = load_model(str(Path(__file__).parents[1] / file))
    generate_scenes(model, model.prior, 70, tmp_path / "out", seed=4, format="kitti")
    double = tmp_path / "double"  # images that are shown at half of their size
    double.mkdir()
    for path in (tmp_path / "out" / "images").iterdir():
        with Image.open(path) as image:
            image.resize((2 * image.width, 2 * image.height)).save(double / path.name)
    folder, seen = tmp_path / "out" / "Kitti" / "raw" / "training" / "label_2", 0
    for low in (0.0, 5.505, 11.505):
        target = ImageFolder(tmp_path / "out" / "images", model.canvas, model.channels)
        labels = read_labels(folder, model, target, min_height=low)
        told = []
        counts = count_visible(model, model.prior, 70, 4, Visibility(labels.min_height), told.append)
        assert told == [64, 6] and labels.classes == model.classes
        assert np.array_equal(counts, labels.structures.counts)
        assert np.array_equal(count_scenes(model, model.prior, 70, 4, Visibility(labels.min_height)).counts, counts)
        assert counts.sum() != seen
        seen = counts.sum()
        target = ImageFolder(double, model.canvas, model.channels)
        assert read_labels(folder, model, target, min_height=2 * low).min_height == pytest.approx(low)
    assert (
        sample_counts(model, model.prior, 200, 4).counts.mean()
        > count_visible(model, model.prior, 200, 4, Visibility()).mean()
    )


def test_no_more_scenes_are_rendered_than_it_takes(monkeypatch, discs):
    model, asked = load_model(str(discs.file)), []
    none = np.zeros((1, 2), np.int64)
    monkeypatch.setattr("probscene.app.evaluation.visible.count_visible", lambda *given: asked.append(given[2]) or none)
    for num in (5, 10_000):
        count_scenes(model, model.prior, num, 0, Visibility())
    assert asked == [5, MAX_RENDERED]
    assert len(count_scenes(model, model.prior, 50, 0, None)) == 50


@pytest.fixture
def labelled(target, tmp_path):
    """The target's labels as KITTI writes them, with types in capitals, one object of each image 8 pixels high."""
    (tmp_path / "label_2").mkdir()
    names = sorted(path.stem for path in target.images.iterdir())
    for name, row in zip(names, target.counts, strict=True):
        types = ["Red"] * row[0] + ["BLUE"] * row[1]
        lines = [line(type, 8 if k == 0 else 40, top=10.0) for k, type in enumerate(types)] + [line("DontCare")]
        (tmp_path / "label_2" / f"{name}.txt").write_text("\n".join(lines))
    return tmp_path / "label_2"


def test_the_commands_take_the_folder(call, fitted, target, labelled, tmp_path):
    words = ["--target", target.images, "--labels", labelled, "--num", 100, "--json", tmp_path / "e.json"]
    for command, more in (("evaluate", ["--scenes", 0]), ("compare", ["--out", tmp_path / "c.png"])):
        done = call(command, fitted, *words, *more)
        assert done.code == 0, done.err
        record = json.loads((tmp_path / "e.json").read_text())
        assert record["sources"]["truth"]["mean_number"] == target.counts.sum() / 40
        model = RunFolder.at(fitted).model
        assert (
            record["sources"]["prior"]["mean_number"]
            == count_visible(model, model.prior, 100, 0, Visibility()).sum() / 100
        )
        assert VISIBLE_NOTE in record["notes"] and VISIBLE_NOTE in done.out
        said = "40 of 40 images have regions marked DontCare"
        assert said in record["notes"][-1] and said in " ".join(done.out.split())
        done = call(command, fitted, *words, *more, "--min-height", 9)
        assert done.code == 0, done.err
        record = json.loads((tmp_path / "e.json").read_text())
        assert record["sources"]["truth"]["mean_number"] == np.maximum(target.counts.sum(1) - 1, 0).mean()
    refused = call("evaluate", fitted, *words[:2], "--labels", target.labels, "--min-height", 9)
    assert refused.code == 2 and "least height" in refused.err and str(target.labels) in refused.err
    (labelled / "000003.txt").write_text("Car 1 2\n")
    refused = call("evaluate", fitted, *words)
    assert refused.code == 2 and "line 1 of" in refused.err.splitlines()[-1] and "000003.txt" in refused.err


def test_the_benchmarks_own_labels(data_dir, tmp_path):
    folder = data_dir / "kitti"
    if not (folder / "label_2").is_dir():
        pytest.skip(f"no KITTI labels in {folder}")
    with open(folder / "counts_7481.csv", encoding="utf-8") as file:
        known = {row["frame"]: row for row in csv.DictReader(file)}
    frames = sorted(path.stem for path in (folder / "label_2").iterdir())
    model = SimpleNamespace(name="kitti", classes=("Car", "Van", "Truck", "Pedestrian", "Person_sitting", "Cyclist"))
    read = read_boxes(folder / "label_2", model, images("x", [f"{frame}.jpg" for frame in frames]))
    counts, classes = read.counts, read.classes
    assert counts.tolist() == [[int(known[frame][name]) for name in classes] for frame in frames]
    (tmp_path / "Kitti" / "raw").mkdir(parents=True)
    (tmp_path / "Kitti" / "raw" / "training").symlink_to(folder)
    dataset = torchvision.datasets.Kitti(tmp_path)
    for k in range(0, len(frames), 9):
        image, read = dataset[k]
        image.close()
        own = read_objects(folder / "label_2" / f"{Path(dataset.images[k]).stem}.txt")
        assert [(one["type"], *one["bbox"], one["truncated"], one["occluded"]) for one in read] == [
            (one.name, one.left, one.top, one.right, one.bottom, one.truncated, one.occluded) for one in own
        ]
