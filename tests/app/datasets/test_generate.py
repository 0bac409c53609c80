"""Datasets: labels that are the renderer's, bytes that depend on the settings alone, and work that is never lost."""

import json
import multiprocessing
import os
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pyro
import pytest
import torch
from PIL import Image
from pycocotools.coco import COCO

import probscene
from probscene.app.chunks import png
from probscene.app.datasets.generate import DatasetOptions, generate, generate_scenes
from probscene.app.datasets.provenance import remake
from probscene.app.versions import versions_record
from probscene.dataset import ImageFolder
from probscene.errors import DataError, ProbsceneError

from .conftest import contents, lines


def rng_states() -> str:
    """The state of torch's, numpy's and Python's generators."""
    states = pyro.util.get_rng_state()
    return repr([states["torch"].tolist(), states["random"], states["numpy"][1].tolist(), states["numpy"][2:]])


@pytest.mark.filterwarnings("ignore:__array__ implementation doesn't accept a copy:DeprecationWarning")  # pycocotools
def test_coco_masks_and_boxes_are_the_renderers(model, tmp_path):
    generate_scenes(model, model.prior, 80, tmp_path / "out", seed=1)
    dataset = COCO(tmp_path / "out" / "annotations.json")
    assert [c["name"] for c in dataset.loadCats(dataset.getCatIds())] == ["mug", "plate"]
    assert sorted(dataset.getCatIds()) == [1, 2] and sorted(dataset.getImgIds()) == list(range(80))
    seen = set()
    for line in lines(tmp_path / "out"):
        image, batch = remake(model, line)
        info = dataset.loadImgs(line["index"])[0]
        assert line["image"] == f"images/{info['file_name']}" and (info["height"], info["width"]) == (64, 64)
        file = cv2.imread(str(tmp_path / "out" / line["image"]))
        assert (file[..., ::-1] == image.permute(1, 2, 0).numpy()).all()
        shown = np.setdiff1d(batch.instance[0].numpy(), 0)
        found = dataset.loadAnns(dataset.getAnnIds(line["index"]))
        assert len(found) == len(shown)
        for annotation, instance in zip(found, shown, strict=True):
            mask = batch.instance[0].numpy() == instance
            assert (dataset.annToMask(annotation) == mask).all()
            rows, columns = np.nonzero(mask)
            x, y, w, h = annotation["bbox"]
            extent = (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1)
            assert (x, y, x + w, y + h) == extent
            assert annotation["area"] == mask.sum() and annotation["iscrowd"] == 0
            kind = batch.kind[0, instance - 1]
            assert dataset.cats[annotation["category_id"]]["name"] == model.grammar.kinds[kind]
            X, Y, W, H = annotation["amodal_bbox"]
            assert X <= x and Y <= y and X + W >= x + w and Y + H >= y + h
            visible = annotation["visible_fraction"]
            assert 0 < visible <= 1 and abs(visible - float(batch.visible[0, instance - 1])) < 1e-6
            seen |= {("cut", visible < 1), ("beyond", X < 0 or Y < 0 or X + W > 64 or Y + H > 64)}
    assert len(dataset.getAnnIds()) == len(set(dataset.getAnnIds())) and min(dataset.getAnnIds()) == 1
    assert len(seen) == 4


def test_an_object_without_a_visible_pixel_has_no_annotation(model, tmp_path):
    generate_scenes(model, model.prior, 256, tmp_path / "out", seed=1)
    dataset = json.loads((tmp_path / "out" / "annotations.json").read_text())
    spelt = [line["derivation"] for line in lines(tmp_path / "out")]
    objects = sum(text.count("Plate -> plate") + text.count("Mugs -> mug") for text in spelt)
    assert 0 < len(dataset["annotations"]) < objects
    assert all(annotation["area"] > 0 for annotation in dataset["annotations"])


def test_grey_where_colour_carries_nothing(model, tmp_path):
    dull = replace(model, channels=1)
    generate_scenes(model, model.prior, 5, tmp_path / "colour", format="images")
    generate_scenes(dull, model.prior, 5, tmp_path / "grey", format="images")
    assert not (tmp_path / "grey" / "annotations.json").exists()
    assert not (tmp_path / "grey" / ".parts").exists()
    names = sorted(path.name for path in (tmp_path / "grey" / "images").iterdir())
    assert names == [f"00000{i}.png" for i in range(5)]
    colour = ImageFolder(tmp_path / "colour" / "images", (64, 64), 1)
    for i, line in enumerate(lines(tmp_path / "grey")):
        path = tmp_path / "grey" / line["image"]
        image, _ = remake(dull, line)
        assert png(image) == path.read_bytes() and (image == colour.load(i)).all()
        with Image.open(path) as pillow:
            assert pillow.mode == "L" and (np.asarray(pillow.convert("RGB")) == image[0, ..., None].numpy()).all()
        assert (cv2.imread(str(path)) == image[0, ..., None].numpy()).all()


def test_provenance_says_where_an_image_comes_from(run, undisturbed):
    for i, line in enumerate(lines(undisturbed)):
        assert line["index"] == i and line["seed"] == 3 and line["model"] == "plates"
        assert line["guide"] == run.guide_hash()
        assert line == line | versions_record()
        spelt = line["derivation"].split("; ")
        assert spelt == [str(run.model.grammar.rules[rule]) for rule in line["rules"]]
        nodes = {"plate": spelt.count("Plate -> plate(Mugs)"), "mug": spelt.count("Mugs -> mug Mugs")}
        for site, values in line["parameters"].items():
            assert len(values) == nodes.get(site.partition(".")[0], 1)


def test_every_image_is_made_again_from_its_line(run, undisturbed):
    for line in lines(undisturbed):
        image, batch = remake(run.model, line)
        assert png(image) == (undisturbed / line["image"]).read_bytes()
        assert image.shape == (3, 64, 64) and batch.instance.shape == (1, 64, 64)


def test_a_line_that_is_not_the_models_is_refused(run, undisturbed):
    line = next(line for line in lines(undisturbed) if len(line["parameters"]["plate.x"]) == 1)
    wrong = [
        {},
        "text",
        {**line, "rules": [99]},
        {**line, "rules": line["rules"][1:]},
        {**line, "rules": line["rules"][::-1], "derivation": "; ".join(line["derivation"].split("; ")[::-1])},
        {**line, "derivation": line["derivation"].replace("plate", "dish")},
        {**line, "parameters": {**line["parameters"], "plate.x": []}},
        {**line, "parameters": {**line["parameters"], "plate.x": ["left"]}},
        {**line, "parameters": {**line["parameters"], "cup.x": []}},
        {**line, "parameters": {site: v for site, v in line["parameters"].items() if site != "plate.x"}},
    ]
    for bad in wrong:
        with pytest.raises(DataError, match="expected"):
            remake(run.model, bad)


def test_same_bytes_for_two_workers(run, undisturbed, tmp_path):
    told = []
    made = generate(run, 130, tmp_path / "out", seed=3, workers=2, progress=lambda *now: told.append(now))
    assert made == (tmp_path / "out", 130, 130, True)
    assert contents(tmp_path / "out") == contents(undisturbed)
    assert told[0] == (0, 130) and told[-1] == (130, 130) and len(told) == 4
    assert not multiprocessing.active_children()


def test_same_bytes_whatever_the_process_does(run, undisturbed, tmp_path):
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        torch.rand(3)
        generate(run, 130, tmp_path / "out", seed=3)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(threads)
    assert contents(tmp_path / "out") == contents(undisturbed)


def test_the_callers_random_numbers_are_left_alone(model, tmp_path):
    before = rng_states()
    generate_scenes(model, model.prior, 1, tmp_path / "out")
    remake(model, lines(tmp_path / "out")[0])
    assert rng_states() == before


@pytest.mark.parametrize("num", [1, 64, 70])
def test_a_shorter_dataset_is_the_beginning_of_a_longer_one(run, undisturbed, tmp_path, num):
    generate(run, num, tmp_path / "out", seed=3)
    short, long = contents(tmp_path / "out"), contents(undisturbed)
    images = [name for name in short if name.startswith("images/")]
    assert len(images) == num and all(short[name] == long[name] for name in images)
    assert lines(tmp_path / "out") == lines(undisturbed)[:num]
    short, long = (json.loads(c["annotations.json"])["annotations"] for c in (short, long))
    assert short == [annotation for annotation in long if annotation["image_id"] < num]


def test_seeds_and_chunks_differ(run, undisturbed, tmp_path):
    generate(run, 64, tmp_path / "out", seed=4)
    first = [line["parameters"]["light"] for line in lines(undisturbed)]
    assert len(set(map(tuple, first))) == 130
    assert not set(map(tuple, first)) & {tuple(line["parameters"]["light"]) for line in lines(tmp_path / "out")}


def test_folders_that_cannot_take_a_dataset(run, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / ".hidden").write_text("")
    (tmp_path / "out" / "thesis.tex").write_text("")
    with pytest.raises(DataError, match="new or empty folder for the dataset.*thesis.tex"):
        generate(run, 1, tmp_path / "out")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [".hidden", "thesis.tex"]
    with pytest.raises(DataError, match="a file in the way"):
        generate(run, 1, tmp_path / "out" / "thesis.tex")
    (tmp_path / "out" / "provenance.jsonl").write_text("a poem\n")
    with pytest.raises(DataError, match="lines of provenance"):
        generate(run, 1, tmp_path / "out")
    (tmp_path / "new").mkdir()
    (tmp_path / "new" / ".hidden").write_text("")
    assert generate(run, 1, tmp_path / "new" / "deeper" / "out").made == 1


@pytest.mark.parametrize(
    "wrong, message",
    [
        ({"num": 0}, "positive number of images, got 0"),
        ({"num": -3}, "positive number of images, got -3"),
        ({"workers": 0}, "positive number of workers, got 0"),
        ({"seed": -1}, "seed of 0 or more, got -1"),
        ({"format": "voc"}, "formats among coco, panoptic, yolo, .*, images, got 'voc'"),
    ],
)
def test_wrong_numbers(run, tmp_path, wrong, message):
    with pytest.raises(ProbsceneError, match=message) as error:
        generate(run, **{"num": 1, "out": tmp_path / "out", **wrong})
    assert error.value.exit_code == 2 and not (tmp_path / "out").exists()


def test_memory_is_flat(model, tmp_path):
    if not Path("/proc/self/statm").exists():
        pytest.skip("no /proc on this machine")
    large = replace(model, canvas=(256, 256))  # a chunk's renders are 21 MB
    resident = []

    def measure(done, num):
        resident.append(int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20)

    generate_scenes(large, model.prior, 20 * 64, tmp_path / "out", progress=measure)
    assert max(resident) - resident[4] < 100


@pytest.mark.parametrize("flat", [False, True])
def test_many_images_share_folders_of_a_thousand_unless_one_is_asked_for(run, tmp_path, monkeypatch, flat):
    monkeypatch.setattr("probscene.app.datasets.folder.MAX_FLAT_IMAGES", 100)
    monkeypatch.setattr("probscene.app.datasets.provenance.SHARED", 50)
    out = tmp_path / "out"
    formats = "coco,yolo,webdataset"
    generate(run, 130, out, seed=3, format=formats, options=DatasetOptions(flat=flat))
    assert generate(run, 130, out, seed=3, format=formats, options=DatasetOptions(flat=flat)).made == 0
    names = [f"{i:06d}" if flat else f"{i // 50:04d}/{i:06d}" for i in range(130)]
    found = {file.relative_to(out / "images").with_suffix("").as_posix() for file in (out / "images").rglob("*.png")}
    assert found == set(names)
    texts = (out / "labels").rglob("*.txt")
    assert {file.relative_to(out / "labels").with_suffix("").as_posix() for file in texts} == found
    images = json.loads((out / "annotations.json").read_text())["images"]
    assert [image["file_name"] for image in images] == [f"{name}.png" for name in names]
    lines = [json.loads(line) for line in (out / "provenance.jsonl").read_text().splitlines()]
    assert [line["image"] for line in lines] == [f"images/{name}.png" for name in names]
    with pytest.raises(DataError, match=rf"begun with \(flat {flat}\)"):
        generate(run, 130, out, seed=3, format=formats, options=DatasetOptions(flat=not flat))
    monkeypatch.setattr("probscene.app.datasets.folder.MAX_FLAT_IMAGES", 1000)
    generate(run, 130, tmp_path / "usual", seed=3, format=formats)
    for name in names:
        usual = tmp_path / "usual" / "images" / f"{name.rpartition('/')[2]}.png"
        assert (out / "images" / f"{name}.png").read_bytes() == usual.read_bytes()


def test_a_models_images_are_in_one_folder_where_that_is_asked_for(run, tmp_path, monkeypatch):
    monkeypatch.setattr("probscene.app.datasets.folder.MAX_FLAT_IMAGES", 3)
    for flat in (False, True):
        probscene.generate(run.model, 4, tmp_path / str(flat), "images", DatasetOptions(flat=flat), progress=False)
        assert (tmp_path / str(flat) / "images" / "000003.png").exists() == flat
