"""Names of images in labels and on disk: composed otherwise, no UTF-8, with spaces, of macOS, of other folders."""

import csv
import io
import json
import os
import unicodedata
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from probscene.app.evaluation.evaluate import evaluate
from probscene.app.evaluation.labels import read_labels
from probscene.app.fitting.run import RunFolder
from probscene.app.labels.boxes import read_boxes
from probscene.app.labels.counts import read_table, write_counts
from probscene.app.labels.naming import Entry, labelled_classes, matched, printable
from probscene.app.labels.sheet import write_sheet
from probscene.app.trial.plan import only
from probscene.app.trial.sets import read_set
from probscene.app.views.report import write
from probscene.dataset import ImageFolder
from probscene.errors import DataError

from .test_reading import CELLS, CLASSES, HEIGHT, REST, WIDTH, pictures, write_coco, write_kitti, write_yolo
from .test_sheet import Reader

ONE = [[("rbc", (10, 10, 20, 20))] for _ in range(3)]
NAMES = {
    "é": ["é0", "é1", "é2"],
    "Hangul": ["한글0", "한글1", "한글2"],
    "stacked": ["ệ0", "ệ1", "ṩ2"],
}


def files_on(folder: Path, names: list[str]) -> ImageFolder:
    return ImageFolder(pictures(folder, [f"{name}.png" for name in names]), (HEIGHT, WIDTH), 3)


@pytest.mark.parametrize("names", NAMES.values(), ids=NAMES)
@pytest.mark.parametrize(("on_disk", "in_labels"), [("NFD", "NFC"), ("NFC", "NFD")])
def test_names_match_however_they_are_composed(names, on_disk, in_labels, tmp_path):
    """A zip of macOS has e and an accent, a label file é."""
    names = [unicodedata.normalize(on_disk, name) for name in names]
    said = [unicodedata.normalize(in_labels, name) for name in names]
    assert not set(said) & set(names)
    folder = tmp_path / "set"
    seen = files_on(folder / "images", names)
    paths = [
        write_coco(folder / "annotations.json", ONE),
        write_kitti(folder / "label_2", ONE),
        write_yolo(folder / "yolo", ONE),
    ]
    for i, name in enumerate(said):
        paths[0].write_text(paths[0].read_text().replace(f'"image {i}"', json.dumps(f"{name}.png")))
        for at in (paths[1], paths[2] / "labels"):
            (at / f"image {i}.txt").rename(at / f"{name}.txt")
    for path in paths:
        assert read_boxes(path, CELLS, seen).counts[:, 0].tolist() == [1, 1, 1]
    (folder / "counts.csv").write_text("image,rbc\n" + "".join(f"{name}.png,{i}\n" for i, name in enumerate(said)))
    assert read_table(folder / "counts.csv", CLASSES, seen).counts[:, 0].tolist() == [
        names.index(path.stem) for path in seen.paths
    ]
    found = read_set(folder)
    assert [len(example.boxes) for example in found.examples] == [1, 1, 1]
    (folder / "list.txt").write_text(said[1])
    assert only(found, folder / "list.txt").examples[0].path.stem == names[1]


def test_files_that_differ_in_composition_alone_are_two(tmp_path):
    both = [unicodedata.normalize(form, "é.png") for form in ("NFC", "NFD")]
    files = [tmp_path / name for name in both]
    assert matched([Entry(name, "") for name in both], files, tmp_path).entries == {0: 0, 1: 1}
    with pytest.raises(DataError, match="second one"):
        matched([Entry(name, "") for name in both], files[:1], tmp_path)


def test_classes_match_however_they_are_composed():
    found, notes = labelled_classes([unicodedata.normalize("NFD", "café"), "tea"], ("café",), "classes", Path("x"))
    assert list(found.values()) == ["café"] and "tea" in notes[0]


LATIN = [b"caf\xe9_0", b"na\xefve\r", b"\xff\n\xfe"]


def not_utf8(folder: Path, images: list[Path]) -> list[str]:
    """Files copied under names of Latin-1."""
    folder.mkdir(parents=True)
    for i, file in enumerate(images):
        name = LATIN[i] if i < len(LATIN) else str(i).encode()
        (folder / os.fsdecode(name + b".png")).write_bytes(file.read_bytes())
    return sorted(file.name for file in folder.iterdir())


def test_a_sheet_reads_back_names_that_are_no_utf8(tmp_path):
    names = not_utf8(tmp_path / "photos", sorted(pictures(tmp_path / "few", ["0.png", "1.png", "2.png"]).iterdir()))
    seen = ImageFolder(tmp_path / "photos", (HEIGHT, WIDTH), 3)
    before = {names[2]: ["4", "5"]}
    sheet = write_sheet(tmp_path / "sheet", seen, [0, 1], CLASSES, "cells", before)
    page = Reader(sheet.page.read_text(encoding="utf-8"))
    assert [each["data-image"] for each in page.all("section")] == list(sheet.names) == [*map(printable, names[:2])]
    assert json.loads(page.text["script"].partition("\n")[0])["before"] == [[printable(names[2]), "4", "5"]]
    read_back(sheet, seen, [[4, 5]])


def read_back(sheet, seen: ImageFolder, done: list) -> None:
    """Fill a sheet in as a spreadsheet does, and read it."""
    rows = list(csv.reader(io.StringIO(sheet.table.read_text(encoding="utf-8"), newline="")))
    for number, row in enumerate(rows[1 + len(done) :]):
        row[1:] = [str(number), "7"]
    text = io.StringIO()
    csv.writer(text).writerows(rows)
    sheet.table.write_bytes(text.getvalue().encode())
    table = read_table(sheet.table, CLASSES, seen)
    number = len(seen) - len(done)
    assert table.counts.tolist() == [*([i, 7] for i in range(number)), *done] and not table.notes


SPACES = [" lead.png", "trail .png", "\ttab.png", "a  b.png", "\u00a0hard.png"]


def test_a_sheet_reads_back_names_with_spaces(tmp_path):
    seen = ImageFolder(pictures(tmp_path / "photos", SPACES), (HEIGHT, WIDTH), 3)
    sheet = write_sheet(tmp_path / "sheet", seen, list(range(len(SPACES))), CLASSES, "cells")
    page = Reader(sheet.page.read_text(encoding="utf-8"))
    assert [each["data-image"] for each in page.all("section")] == [path.name for path in seen.paths]
    read_back(sheet, seen, [])


def test_spaces_around_a_cell_are_no_part_of_a_name(tmp_path):
    """Unless a file has them."""
    files = [tmp_path / name for name in ("a.png", " a.png", " b.png")]
    said = ["b.png ", "a.png", " a.png"]
    assert matched([Entry(name, "") for name in said], files, tmp_path).entries == {0: 1, 1: 2, 2: 0}
    with pytest.raises(DataError, match="2 files"):
        matched([Entry("  a.png", "")], files[:2], tmp_path)


names = st.text(
    st.characters(codec="utf-8", exclude_characters="/\0\\") | st.sampled_from("\udce9\udcff ,;\t\r\n\"'e\u0301"),
    min_size=1,
    max_size=6,
).filter(lambda name: name not in (".", ".."))


@given(st.lists(names, min_size=1, max_size=5, unique_by=lambda name: unicodedata.normalize("NFC", name).strip()))
def test_counts_are_read_back_under_any_name(tmp_path_factory, each):
    path = tmp_path_factory.mktemp("names") / "c.csv"
    counts = np.arange(2 * len(each)).reshape(-1, 2)
    write_counts(path, each, counts, CLASSES)
    sizes = {"path": Path("x"), "paths": [Path(name) for name in each], "bad": {}}
    assert read_table(path, CLASSES, SimpleNamespace(**sizes)).counts.tolist() == counts.tolist()


def test_files_of_macos_beside_images_and_labels_are_not_read(tmp_path):
    names = ["000000.png", "000001.PNG", "000002.JPG"]
    for images, labels in (("kitti/image_2", "kitti/label_2"), ("yolo/images", "yolo/labels")):
        folder = pictures(tmp_path / images, names)
        (folder / "._000000.png").write_bytes(b"\0\5\x16\7")
        write = write_kitti if labels.endswith("label_2") else write_yolo
        write(tmp_path / (labels if write is write_kitti else "yolo"), ONE, "00000{}")
        (tmp_path / labels / "._000000.txt").write_bytes(b"\0\5\x16\7")
        found = read_set(tmp_path / Path(images).parent)
        assert [example.path.name for example in found.examples] == names and not found.notes
        seen = ImageFolder(folder, (HEIGHT, WIDTH), 3)
        assert len(read_boxes(tmp_path / labels, CELLS, seen).rows) == 3


def test_an_image_without_a_label_file_is_named(tmp_path):
    pictures(tmp_path / "kitti" / "image_2", ["0.png", "1.png", "2.png", "3.png"])
    write_kitti(tmp_path / "kitti" / "label_2", ONE, "{}")
    with pytest.raises(DataError, match=r"label file for each image in .*label_2, got none of .*3\.png"):
        read_set(tmp_path / "kitti")
    (tmp_path / "kitti" / "image_2" / "3.png").unlink()
    (tmp_path / "kitti" / "label_2" / "9.txt").write_text(f"rbc 0 0 0 1 1 5 5 {REST}")
    folder = tmp_path / "kitti" / "image_2"
    assert read_set(tmp_path / "kitti").notes == (f"Not read, since {folder} has no such image: 9.txt.",)


def test_the_folder_tells_images_of_one_name(tmp_path):
    files = [tmp_path / "train" / "0.png", tmp_path / "val" / "0.png"]
    said = [Entry("set/val/0.png", "first"), Entry("C:\\set\\train\\0.png", "second")]
    assert matched(said, files, tmp_path).entries == {0: 1, 1: 0}
    found = matched(said, files[:1], tmp_path)
    assert found.entries == {0: 1} and found.notes == (f"Not read, since {tmp_path} has no such image: set/val/0.png.",)


def test_commands_take_images_whose_names_are_no_utf8(call, fitted, target, tmp_path):
    """``label``, ``evaluate`` and ``report``."""
    names = not_utf8(tmp_path / "photos", sorted(target.images.iterdir())[:10])
    done = call("label", fitted, tmp_path / "photos", "--out", tmp_path / "sheet", "--number", 9)
    assert done.code == 0, done.err
    rows = list(csv.reader((tmp_path / "sheet" / "counts.csv").read_text(encoding="utf-8").splitlines()))
    assert len(rows) == 10 and {row[0] for row in rows[1:]} < {printable(name) for name in names}
    (tmp_path / "few.csv").write_text("image,red\n" + "".join(f"{row[0]},30\n" for row in rows[1:]))
    words = ["--target", tmp_path / "photos", "--labels", tmp_path / "few.csv", "--some-labels", "--num", 50]
    done = call("evaluate", fitted, *words, "--scenes", 0, "--json", tmp_path / "e.json")
    assert done.code == 0, done.err
    assert json.loads((tmp_path / "e.json").read_text())["count_errors"]["red"]["images"] == 9
    run, seen = RunFolder.at(fitted), ImageFolder(tmp_path / "photos", (64, 64), 3)
    truth = read_labels(tmp_path / "few.csv", run.model, seen, True)
    page = write(run, evaluate(run, seen, truth, lambda *_: None, num=50), seen, tmp_path / "r.html")
    assert "9 of 9 images show more than" in page.read_text(encoding="utf-8")
