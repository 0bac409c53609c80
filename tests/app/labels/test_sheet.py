"""Which images are proposed, and the sheet: its pictures, its CSV, its page as a parser and an engine read it."""

import base64
import csv
import io
import json
import re
import shutil
import subprocess
from html.parser import HTMLParser
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from probscene.app.evaluation.estimate import class_counts
from probscene.app.labels.counts import read_table
from probscene.app.labels.partial_labels import read_partial_labels
from probscene.app.labels.selection import MIN_CLASS_IMAGES, PRESENT, propose
from probscene.app.labels.sheet import page, write_sheet
from probscene.app.style import DARK, LIGHT
from probscene.dataset import ImageFolder
from probscene.errors import DataError

MODEL = SimpleNamespace(name="cells <b>", classes=("red, big", "blue"))


def looks(number, seed=0, dimensions=5):
    return torch.randn(number, dimensions, generator=torch.Generator().manual_seed(seed))


@given(st.integers(1, 40), st.integers(1, 12), st.integers(0, 3), st.sets(st.integers(0, 39)), st.data())
def test_proposed_are_others_than_what_is_labelled(images, number, classes, labelled, data):
    """Each once, as many as asked for or as are left; the same for the same seed, whatever the order of the labels."""
    seen = sorted(row for row in labelled if row < images)
    counts = torch.randint(0, 4, (images, classes)).float() if classes else None
    given = [looks(images), counts]
    found = propose(number, *given, torch.tensor(seen, dtype=torch.int64), 7)
    assert len(found) == len(set(found)) == min(number, images - len(seen))
    assert not set(found) & set(seen) and all(0 <= row < images for row in found)
    assert propose(number, *given, torch.tensor(data.draw(st.permutations(seen)), dtype=torch.int64), 7) == found


def test_by_looks_alone_no_group_is_left_out():
    """Ten tight groups of very different sizes, and ten images."""
    sizes = [200, 100, 50, 20, 10, 5, 2, 1, 1, 1]
    middle = looks(10) * 100
    points = torch.cat([middle[i] + 0.01 * looks(size, i) for i, size in enumerate(sizes)])
    group = np.repeat(range(10), sizes)
    for seed in range(5):
        assert set(group[propose(10, points, seed=seed)]) == set(range(10))


@given(st.integers(1, 6), st.integers(0, 10**6))
def test_a_rare_class_is_among_the_first(rare, seed):
    rng = np.random.default_rng(seed)
    counts = np.stack([rng.poisson(5, 200), np.zeros(200)], 1)
    shown = rng.choice(200, rare, False)
    counts[shown, 1] = rng.uniform(PRESENT, 3, rare)
    found = propose(10, looks(200), torch.from_numpy(counts))
    assert len(set(found) & set(shown.tolist())) >= min(MIN_CLASS_IMAGES, rare)
    assert found[0] == int(counts[:, 1].argmax())


def test_images_that_are_all_the_same_can_be_proposed():
    assert len(set(propose(4, torch.zeros(9, 3)))) == 4
    assert len(set(propose(4, torch.zeros(9, 3), torch.zeros(9, 2)))) == 4


def test_what_features_count_is_read_by_name():
    model = SimpleNamespace(classes=("car", "tree", "mug"))
    found = class_counts(model, ("mug", "car 1", "direction_1", "car 2"), torch.tensor([[1.0, 2.5, 9.0, 0.25]]))
    assert found.tolist() == [[2.75, 1.0]]
    assert class_counts(model, ("efficientnet_0",), torch.zeros(2, 1)) is None


def table(path):
    return list(csv.reader(path.read_text().splitlines()))


class Reader(HTMLParser):
    """The elements with their attributes, and whether every one is closed."""

    def __init__(self, text):
        super().__init__()
        self.found, self.open, self.text = [], [], {}
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, dict(attrs)))
        if tag not in ("meta", "img", "input", "wbr"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text[self.open[-1] if self.open else ""] = self.text.get(self.open[-1] if self.open else "", "") + data

    def all(self, tag):
        return [attrs for name, attrs in self.found if name == tag]


@pytest.fixture
def folder(tmp_path):
    """Five images of 60 x 40 with a bright column; the canvas sees the middle 40."""
    (tmp_path / "photos").mkdir()
    for i in range(5):
        pixels = np.full((40, 60, 3), 40 * i, np.uint8)
        pixels[:, 5 + 10 * i] = 255
        Image.fromarray(pixels).save(tmp_path / "photos" / ("a,1.png", "b&2.png", "c.png", "d.png", "e.png")[i])
    return tmp_path / "photos"


def test_the_sheet_shows_what_the_model_sees(folder, tmp_path):
    target = ImageFolder(folder, (20, 20), 3)
    sheet = write_sheet(tmp_path / "out", target, [0, 1, 3], MODEL.classes, MODEL.name, {"e.png": ["2", "0"]})
    assert sheet.names == ("a,1.png", "b&2.png", "d.png")
    read = Reader(sheet.page.read_text())
    assert read.open == [] and "cells <b>" in read.text["title"]
    assert [each["data-image"] for each in read.all("section")] == list(sheet.names)
    assert len(read.all("input")) == 6 and all("id" not in each for each in read.all("input"))
    assert not any("src" in each for each in read.all("script")) and not read.all("link")
    used = set(re.findall(r"var\(--(\w+)\)", sheet.page.read_text()))
    assert used and used <= LIGHT.keys() & DARK.keys()
    assert "The file also holds 1 picture that was labelled before." in sheet.page.read_text()
    pictures = [base64.b64decode(each["src"].removeprefix("data:image/jpeg;base64,")) for each in read.all("img")]
    beside = sorted(path.name for path in (tmp_path / "out" / "images").iterdir())
    assert beside == ["a,1.png.jpg", "b&2.png.jpg", "d.png.jpg"]
    assert pictures[2] == (tmp_path / "out" / "images" / "d.png.jpg").read_bytes()
    shown = np.asarray(Image.open(io.BytesIO(pictures[2])))
    assert shown.shape == (40, 40, 3) and shown[20, 25].min() > 200 and abs(int(shown[20, 5, 0]) - 120) < 30
    rows = table(sheet.table)
    assert rows == [["image", *MODEL.classes], ["e.png", "2", "0"], *([name, "", ""] for name in sheet.names)]
    with pytest.raises(DataError, match="new or empty folder .* holds files"):
        write_sheet(tmp_path / "out", target, [0], MODEL.classes, MODEL.name)
    (tmp_path / "file").touch()
    with pytest.raises(DataError, match="is a file"):
        write_sheet(tmp_path / "file", target, [0], MODEL.classes, MODEL.name)


def test_the_spreadsheets_file_is_read_as_it_is_filled_in(folder, tmp_path):
    target = ImageFolder(folder, (20, 20), 3)
    sheet = write_sheet(tmp_path / "out", target, [0, 1, 3], MODEL.classes, MODEL.name, {"e.png": ["2", "0"]})
    text = sheet.table.read_text()
    with pytest.raises(DataError, match="at least 3 images"):
        read_partial_labels(sheet.table, MODEL, target)
    sheet.table.write_text(text.replace('"a,1.png",,', '"a,1.png",3,1').replace("d.png,,", "d.png,0,7"))
    few = read_partial_labels(sheet.table, MODEL, target)
    assert few.rows.tolist() == [0, 3, 4] and few.counts.tolist() == [[3, 1], [0, 7], [2, 0]]


BROWSER = """
const typed = JSON.parse(process.argv[2]);
const element = extra => Object.assign({ addEventListener() {}, className: "", append() {}, remove() {} }, extra);
const cells = typed.map(row => row.slice(1).map(value => element({ value })));
const parts = typed.map((row, i) => element({ dataset: { image: row[0] }, querySelectorAll: () => cells[i] }));
const elements = { about: element({ textContent: process.argv[3] }), said: element({}) };
elements.download = element({ addEventListener(kind, then) { this.then = then; } });
globalThis.localStorage = { setItem() {}, getItem: () => null };
globalThis.document = { getElementById: id => elements[id], addEventListener() {}, body: element({}),
  createElement: () => element({ click() {} }),
  querySelectorAll: what => ({ section: parts, input: cells.flat(), ".picture": [] })[what] };
let written = "";
globalThis.Blob = class { constructor(parts) { written = parts.join(""); } };
URL.createObjectURL = () => "";
"""
AFTER = """
cells.forEach((row, i) => row.forEach((input, c) => { input.value = typed[i][c + 1]; }));
look();
elements.download.then();
console.log(JSON.stringify({ written, said: elements.said.textContent, disabled: elements.download.disabled,
  classes: sections.map(each => each.className) }));
"""


@pytest.mark.skipif(shutil.which("node") is None, reason="no node to run the page's script with")
@pytest.mark.parametrize(
    ("cells", "said", "disabled", "classes"),
    [
        ((("3", "1"), ("", ""), ("0", "7")), "2 of 3 pictures are counted", False, ["whole", "", "whole"]),
        ((("", ""), ("", ""), ("", "")), "0 of 3 pictures are counted", True, ["", "", ""]),
        (
            (("3", ""), ("1", "1"), ("", "")),
            "a,1.png: count every class that you count elsewhere, or none",
            True,
            ["partly", "whole", ""],
        ),
        ((("3", "1"), ("1.5", "1"), ("", "")), 'b "2".png: whole numbers only', True, ["whole", "partly", ""]),
    ],
)
def test_the_page_gives_the_file_that_a_fit_takes(cells, said, disabled, classes, tmp_path):
    found, read = typed_into_the_page(tmp_path, cells, [["e.png", "2", "0"]])
    assert (found["said"], found["disabled"], found["classes"]) == (said, disabled, classes)
    if not disabled:
        assert read().rows == [0, 2, 3] and read().counts.tolist() == [[3, 1], [0, 7], [2, 0]]


@pytest.mark.skipif(shutil.which("node") is None, reason="no node to run the page's script with")
def test_a_class_may_be_left_out_of_the_page(tmp_path):
    found, read = typed_into_the_page(tmp_path, (("", "3"), ("", "0"), ("", "")), [])
    assert not found["disabled"] and found["classes"] == ["whole", "whole", ""]
    assert read().classes == ("blue",) and read().rows == [0, 1] and read().counts.tolist() == [[3], [0]]


def typed_into_the_page(folder, cells, before):
    """What the page says and does, and a reader of the file that it gives."""
    names = ("a,1.png", 'b "2".png', "d.png")
    text = page(names, [b""] * 3, MODEL.classes, MODEL.name, before)
    about, script = re.findall(r"<script[^>]*>(.*?)</script>", text, re.DOTALL)
    (folder / "page.js").write_text(f"{BROWSER}{{{script}{AFTER}}}")
    typed = json.dumps([[name, *row] for name, row in zip(names, cells, strict=True)])
    done = subprocess.run(["node", folder / "page.js", typed, about], capture_output=True, text=True, check=True)
    found = json.loads(done.stdout)
    (folder / "few.csv").write_text(found["written"])
    target = SimpleNamespace(path=folder, paths=[folder / name for name in (*names, "e.png")], bad={})
    return found, lambda: read_table(folder / "few.csv", MODEL.classes, target, allow_missing=True)


def test_a_run_proposes_by_what_it_reads(call, discs, fitted, target, tmp_path):
    few = tmp_path / "few.csv"
    few.write_text("\n".join(target.labels.read_text().splitlines()[:3]))
    words = [target.images, "--number", 6, "--labels", few]
    done = call("label", fitted, *words, "--out", tmp_path / "one")
    assert done.code == 0, done.err
    assert "Count the objects of 6 images" in done.out and "sheet.html" in done.out
    rows = table(tmp_path / "one" / "counts.csv")
    assert rows[1:3] == table(few)[1:] and len(rows) == 9
    assert not {"000000.png", "000001.png"} & {row[0] for row in rows[3:]}
    done = call("label", fitted, *words, "--out", tmp_path / "one")
    assert done.code == 2 and "new or empty folder" in done.err
    done = call("label", discs.file, target.images, "--out", tmp_path / "three", "--labels", target.labels)
    assert done.code == 2 and "got all 40 labelled" in done.err and not (tmp_path / "three").exists()
