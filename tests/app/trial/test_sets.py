"""Labelled sets: what is read, and that what is wrong is said before anything is trained."""

import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from probscene.app.trial.margins import looser
from probscene.app.trial.plan import Part, chosen, only, plan, split
from probscene.app.trial.sets import BEYOND, EASY, HARD, MODERATE, read_set
from probscene.errors import DataError, ProbsceneError

from .conftest import SIDE, change, draw_set

LINE = "{} {} {} -10 {} {} {} {} -1 -1 -1 -1000 -1000 -1000 -10"


@pytest.fixture
def folder(tmp_path) -> Path:
    return draw_set(tmp_path / "set", 3, 5)


def test_a_folder_and_its_file_are_the_same_set(drawn):
    whole, by_file = read_set(drawn / "train"), read_set(drawn / "train" / "annotations.json")
    assert whole.classes == by_file.classes == ("disc", "square")
    for one, other in zip(whole.examples, by_file.examples, strict=True):
        assert one.digest == other.digest and (one.boxes == other.boxes).all() and (one.classes == other.classes).all()
        assert one.size == (SIDE, SIDE) and one.real.all() and (one.levels == EASY).all()
        assert (one.boxes[:, :2] >= 0).all() and (one.boxes[:, 2:] <= SIDE).all()


def test_classes_are_chosen_by_name_whatever_their_order(folder):
    def swap(record):
        record["categories"].reverse()

    before = read_set(folder)
    after = read_set(change(folder, swap), ("square", "disc"))
    assert after.classes == before.classes and all(
        (a.classes == b.classes).all() for a, b in zip(after.examples, before.examples, strict=True)
    )
    alone = read_set(folder, ("square",))
    assert sum(len(e.classes) for e in alone.examples) == sum((e.classes == 1).sum() for e in before.examples)


def test_crowds_are_regions(folder):
    change(folder, lambda record: record["annotations"][0].update(iscrowd=1))
    first = read_set(folder).examples[0]
    assert first.classes[0] == -1 and not first.real[0]


def spoiled(key: str, index: int, **values):
    return lambda record: record[key][index].update(**values)


@pytest.mark.parametrize(
    ("how", "said"),
    [
        (spoiled("annotations", 0, bbox=[1, 2, 0, 3]), r"above 0 in annotations\[0\]"),
        (spoiled("annotations", 0, bbox=[1, 2, float("nan"), 3]), r"bbox.*annotations\[0\]"),
        (spoiled("annotations", 0, bbox="box"), r"bbox.*annotations\[0\]"),
        (spoiled("annotations", 0, bbox=[90, 2, 5, 5]), r"boxes on the image.*000\.png.*64x64 in annotations\[0\]"),
        (spoiled("annotations", 0, image_id=77), r"image_id.*annotations\[0\].*77"),
        (spoiled("annotations", 0, category_id=9), r"category_id.*annotations\[0\].*9"),
        (spoiled("images", 1, file_name="000.png"), r"second one of 000\.png in images\[1\]"),
        (spoiled("images", 1, id=0), r"id that no other.*images\[1\].*got 0;"),
        (spoiled("categories", 1, name="disc"), r"'disc' more than once"),
        (spoiled("images", 0, height=65), r"64x65 as in images\[0\].*got 64x64"),
        (lambda record: record.pop("images"), r"lists of images, annotations, categories.*got none of images\."),
        (lambda record: record.update(images=[], annotations=[]), r"expected labelled images.*got none of them"),
    ],
)
def test_faults_of_coco_are_named(folder, how, said):
    with pytest.raises(DataError, match=said):
        read_set(change(folder, how))


def test_images_that_do_not_decode_are_named(folder):
    (folder / "images" / "001.png").write_bytes(b"no image")
    (folder / "images" / "002.png").write_bytes(b"")
    said = r"got 2 of 3 bad: 001\.png is not a PNG, JPEG or TIFF image, 002\.png is empty; fix or delete them\."
    with pytest.raises(DataError, match=said):
        read_set(folder)


def test_images_are_the_same_by_all_their_bits(folder):
    """Of 16 bits, not by those that are shown; a grey image is one in colours, too."""
    wide = np.arange(SIDE * SIDE, dtype=np.uint16).reshape(SIDE, SIDE) * 16
    for i, image in enumerate((wide, np.dstack([wide] * 3), wide + 1)):
        cv2.imwrite(str(folder / "images" / f"{i:03d}.png"), image)
    one, same, other = (example.digest for example in read_set(folder).examples)
    assert one == same != other


def test_classes_that_differ_are_named_and_case_is(folder):
    with pytest.raises(
        DataError, match=r"expected the classes Disc.*got disc, square.*'disc' differs in case.*--classes"
    ):
        read_set(folder, ("Disc",))
    with pytest.raises(DataError, match="got none of them"):
        read_set(folder / "images")


def a_street(folder: Path) -> Path:
    """Two frames of KITTI's format."""
    (folder / "image_2").mkdir(parents=True)
    (folder / "label_2").mkdir()
    for i in range(2):
        cv2.imwrite(str(folder / "image_2" / f"{i:06d}.png"), np.full((120, 200, 3), 90 + i, np.uint8))
    lines = [
        LINE.format("Car", 0.0, 0, 10, 10, 60, 60),
        LINE.format("Car", 0.2, 1, 70, 10, 99, 40),
        LINE.format("Car", 0.4, 2, 10, 70, 60, 100),
        LINE.format("Car", 0.0, 0, 10, 100, 30, 110),
        LINE.format("Van", 0.0, 0, 100, 10, 150, 60),
        LINE.format("DontCare", -1, -1, 150, 60, 199, 110),
        LINE.format("Pedestrian", 0.0, 0, 160, 10, 170, 58),
    ]
    (folder / "label_2" / "000000.txt").write_text("\n".join(lines))
    (folder / "label_2" / "000001.txt").write_text("")
    return folder


def test_kitti_has_levels_and_regions_and_what_is_alike(tmp_path):
    found = read_set(a_street(tmp_path), ("car",))
    first, second = found.examples
    assert found.kitti and len(second.boxes) == 0
    assert first.levels.tolist() == [EASY, MODERATE, HARD, BEYOND, BEYOND, BEYOND]
    assert first.classes.tolist() == [0, 0, 0, 0, 0, -1]
    assert first.real.tolist() == [True, True, True, True, False, False]
    both = read_set(tmp_path, ("car", "van")).examples[0]
    assert [(both.classes[i], both.real[i]) for i in range(4, 6)] == [(1, True), (0, False)]


def test_a_set_in_parts(drawn):
    found = read_set(drawn / "train")
    ten, five = (chosen(found, Part("x", n), seed=3) for n in (5, 3))
    assert ten[:3] == five and len({e.path for e in ten}) == 5
    assert chosen(found, Part("x", 5), seed=4) != ten
    assert chosen(found, Part("x"), seed=4) == found.examples
    rest, test = split(found, 3, seed=0)
    assert len(test.examples) == 3 and {e.path for e in rest.examples + test.examples} == {
        e.path for e in found.examples
    }
    with pytest.raises(ProbsceneError, match="1 to 7"):
        split(found, 8, seed=0)


def test_a_list_of_images(drawn, tmp_path):
    found, names = read_set(drawn / "train"), tmp_path / "names.txt"
    names.write_text("003\n001\n")
    assert [e.path.stem for e in only(found, names).examples] == ["003", "001"]
    for text, said in (("003 999", "'999'"), ("", "got none")):
        names.write_text(text)
        with pytest.raises(DataError, match=said):
            only(found, names)


def test_what_a_plan_understands(drawn):
    folder = str(drawn / "train")
    said = {"a": folder, "b": f"{folder}:2", "c": "a,real:3", "d": f"learnt+{folder}", "e": "c,b", "f": Path(folder)}
    found = plan(said, ("real", "learnt"), (10, None))
    rows = {row.name: row for row in found.rows}
    assert list(rows) == ["real 10", "real all", "learnt", *said]
    assert rows["b"].stages == ((Part(folder, 2),),) and rows["f"].stages == rows["a"].stages
    assert rows["c"].stages == ((Part(folder),), (Part("real", 3),))
    assert rows["d"].stages == ((Part("learnt"), Part(folder)),)
    assert rows["e"].stages == (*rows["c"].stages, *rows["b"].stages)
    assert [rows[name].photographs for name in ("real 10", "real all", "c")] == [10, -1, None]
    assert found.paths == {folder: Path(folder)}


@pytest.mark.parametrize(
    ("sets", "said"),
    [
        ({}, "got none"),
        ({"a": "nowhere/at/all"}, "'nowhere/at/all'"),
        ({"learnt": "real"}, "'learnt' twice"),
        ({"a/b": "real"}, "can be a file's"),
        ({"a": "real:0"}, "positive number"),
        ({"a": "real:x"}, "positive number"),
        ({"a": "real,real", "b": "a+real"}, "one stage"),
    ],
)
def test_what_a_plan_refuses(sets, said):
    with pytest.raises(ProbsceneError, match=re.escape(said)):
        plan(sets, ("learnt", "real") if sets else (), ())


def loosened(folder: Path, pixels: int, side: int = SIDE) -> Path:
    """A set whose boxes leave room around objects."""

    def loosen(record):
        for one in record["annotations"]:
            x, y, w, h = one["bbox"]
            one["bbox"] = [x - pixels, y - pixels, w + 2 * pixels, h + 2 * pixels]

    return change(draw_set(folder, 60, 6, side=side), loosen)


@pytest.mark.parametrize(
    ("pixels", "side", "given", "wanted"),
    [
        (0, SIDE, 0, None),
        (4, SIDE, 0, "disc=4,square=4"),
        (4, 2 * SIDE, 0, "disc=2,square=2"),  # in pixels of generated images
        (4, SIDE, 2, "disc=6,square=6"),
        (4, SIDE, {"disc": 1}, "disc=5,square=4"),
    ],
)
def test_labels_that_leave_more_room_than_generated_ones_are_said(tmp_path, pixels, side, given, wanted):
    """With the margin that would be the same."""
    made = read_set(draw_set(tmp_path / "made", 60, 5))
    said = looser(read_set(loosened(tmp_path / "photographs", pixels, side)), made, given)
    assert (said is None) == (wanted is None)
    assert said is None or said.endswith(f"--box-margin {wanted}.")
