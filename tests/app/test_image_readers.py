"""Whoever reads image files, a fit, ``label``, ``evaluate``, a trial or ``ps.fit`` of a list, sees the same pixels."""

import io
import json
import struct
import sys
import zlib
from contextlib import ExitStack

import numpy as np
import pytest
import torch
from PIL import Image

from probscene.app.arguments import range_given
from probscene.app.fitting.begin import FitRequest, ModelFile, begin, resume
from probscene.app.fitting.pipeline import open_target
from probscene.app.fitting.presets import QUICK
from probscene.app.fitting.run import RunFolder
from probscene.app.labels.sheet import write_sheet
from probscene.app.progress import Display
from probscene.app.targets import TargetImages
from probscene.app.trial.jobs import Job
from probscene.app.trial.sets import read_set
from probscene.app.trial.training import Pictures
from probscene.app.trial.trial import TrialOptions, trial
from probscene.dataset import ImageFolder
from probscene.decoding import read_rgb
from probscene.errors import DataError, ProbsceneError, RunError
from probscene.image_array import ImageArray

CANVAS = (24, 32)


def encoded(image, kind: str, **options) -> bytes:
    file = io.BytesIO()
    image.save(file, kind, **options)
    return file.getvalue()


def exif(orientation: int, *more: bytes) -> bytes:
    entry = struct.pack("<HHIHH", 0x0112, 3, 1, orientation, 0)
    return b"Exif\0\0II*\0" + struct.pack("<IH", 8, 1 + len(more)) + entry + b"".join(more) + bytes(4)


def beside(data: bytes, block: bytes) -> bytes:
    """A JPEG with an EXIF block."""
    return data[:2] + struct.pack(">BBH", 0xFF, 0xE1, len(block) + 2) + block + data[2:]


def chunk(kind: bytes, contents: bytes, checksum: int | None = None) -> bytes:
    found = zlib.crc32(kind + contents) if checksum is None else checksum
    return struct.pack(">I", len(contents)) + kind + contents + struct.pack(">I", found)


def odd_files() -> dict[str, bytes]:
    """By name, files that show upright what is red at the upper left, as phones, editors and microscopes write them."""
    y, x = np.mgrid[: CANVAS[0], : CANVAS[1]]
    pixels = np.stack([4 * x, 6 * y, 3 * (x + y)], -1).astype(np.uint8)
    pixels[:8, :8] = (250, 20, 20)
    whole, lying = Image.fromarray(pixels), Image.fromarray(np.rot90(pixels).copy())
    opacity = Image.fromarray(np.where(x < 16, 255, 0).astype(np.uint8))
    clear = whole.copy()
    clear.putalpha(opacity)
    png, wide = encoded(whole, "PNG"), pixels[..., 0].astype(np.uint16) * 16
    turned, sideways = encoded(whole.transpose(Image.Transpose.ROTATE_180), "JPEG"), encoded(lying, "JPEG")
    return {
        "plain.png": png,
        "turned.jpg": beside(turned, exif(3)),
        "lying.jpg": beside(sideways, exif(6)),
        "odd_exif.jpg": beside(sideways, exif(6, struct.pack("<HHII", 0x011A, 2, 5, 10**6))),
        "unknown.jpg": beside(encoded(whole, "JPEG"), exif(9)),
        "beyond.jpg": beside(encoded(whole, "JPEG"), exif(65535)),
        "lying.tif": encoded(lying, "TIFF", exif=exif(6)),
        "comment.png": png[:33] + chunk(b"tEXt", b"Comment\0lost", 7) + png[33:],
        "short.png": png[:33] + chunk(b"pHYs", b"\0") + chunk(b"gAMA", b"\0\0") + png[33:],
        "clear.png": encoded(clear, "PNG"),
        "palette.png": encoded(whole.quantize(20), "PNG", transparency=3),
        "CAPITALS.PNG": png,
        "cmyk.jpg": encoded(whole.convert("CMYK"), "JPEG"),
        "sixteen.png": encoded(Image.fromarray(wide), "PNG"),
        "sixteen.tiff": encoded(Image.fromarray(wide), "TIFF"),
    }


FILES = odd_files()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("odd")
    for name, data in FILES.items():
        (path / name).write_bytes(data)
        (path / f"._{name}").write_bytes(b"\0\5\x16\7 left by another system")
    return path


def pixels(images, i: int) -> np.ndarray:
    return images.load(i).permute(1, 2, 0).numpy()


def test_all_read_the_same_pixels(folder):
    target = ImageFolder(folder, CANVAS, 3)
    assert len(target) == len(FILES) and set(target.sizes) == {CANVAS} and target.value_range == (0, 4095)
    listed, shown = ImageFolder(target.paths, CANVAS, 3), Pictures(CANVAS, target.value_range)
    for i, file in enumerate(target.paths):
        expected = pixels(target, i)
        assert (pixels(listed, i) == expected).all(), file.name
        assert (read_rgb(file, target.value_range) == expected).all(), file.name
        example = read_set_of(file)
        assert (shown(example)[0] == expected).all() and example.size == CANVAS
        assert expected[4, 4, 0] > 200, file.name


@pytest.mark.filterwarnings("ignore")  # Pillow's, on odd EXIF
@pytest.mark.parametrize("load", [False, True])
def test_so_do_lists_of_what_pillow_opens(folder, load):
    files = [folder / name for name in FILES if name not in ("comment.png", "short.png")]  # these it does not open
    with ExitStack() as stack:
        opened = [stack.enter_context(Image.open(file)) for file in files]
        for image in opened if load else ():
            image.load()
        images = ImageArray(opened, CANVAS, 3)
    target = ImageFolder(files, CANVAS, 3)
    for i, file in enumerate(files):
        assert (pixels(images, i) == pixels(target, i)).all(), file.name
    assert images.sizes == target.sizes and images.value_range == target.value_range


def read_set_of(file):
    """The only image of a trial's set."""
    record = {
        "images": [{"id": 1, "file_name": file.name, "width": CANVAS[1], "height": CANVAS[0]}],
        "annotations": [{"id": 1, "image_id": 1, "category_id": 1, "bbox": [0, 0, 8, 8]}],
        "categories": [{"id": 1, "name": "square"}],
    }
    labels = file.parent / f".{file.name}.json"
    labels.write_text(json.dumps(record))
    return read_set(labels).examples[0]


def test_transparent_pixels_are_black_and_others_stand_upright(folder):
    seen = {name: read_rgb(folder / name, (0, 4095)).astype(int) for name in FILES}
    assert not seen["clear.png"][:, 16:].any() and (seen["clear.png"] == seen["plain.png"])[:, :16].all()
    for name in ("turned.jpg", "lying.jpg", "odd_exif.jpg", "unknown.jpg", "beyond.jpg"):
        assert abs(seen[name] - seen["plain.png"]).mean() < 6, name
    for name in ("comment.png", "short.png", "lying.tif"):
        assert (seen[name] == seen["plain.png"]).all(), name
    assert (seen["sixteen.png"] == seen["plain.png"][..., :1]).all()


def test_the_sheet_shows_them_so(folder, tmp_path):
    target = ImageFolder(folder, CANVAS, 3)
    write_sheet(tmp_path / "sheet", target, list(range(len(target))), ("square",), "squares")
    for i, file in enumerate(target.paths):
        beside_it = file.name if file.suffix == ".jpg" else f"{file.name}.jpg"
        shown = np.asarray(Image.open(tmp_path / "sheet" / "images" / beside_it)).astype(int)
        assert abs(shown - pixels(target, i)).mean() < 9, file.name


NOISE = encoded(Image.fromarray(np.random.default_rng(0).integers(0, 256, (*CANVAS, 3), dtype=np.uint8)), "JPEG")
BROKEN = {
    "cut.jpg": (NOISE[: len(NOISE) * 6 // 10], "is truncated"),
    "cut.png": (FILES["plain.png"][:-30], "is truncated"),
    "cut.tif": (FILES["lying.tif"][:-30], "is truncated"),
    "web.jpg": (encoded(Image.new("RGB", (9, 9)), "WEBP"), "is a WebP file"),
    "moving.jpg": (encoded(Image.new("RGB", (9, 9)), "GIF"), "is a GIF file"),
    "altered.png": (FILES["plain.png"][:70] + b"\1\2" + FILES["plain.png"][72:], "is damaged"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_all_refuse_the_same_files(tmp_path, name):
    data, fault = BROKEN[name]
    (tmp_path / name).write_bytes(data)
    readers = [lambda file: ImageFolder(file.parent, CANVAS, 3), lambda file: ImageFolder([file], CANVAS, 3),
               read_rgb, read_set_of]  # fmt: skip
    for reader in readers:
        with pytest.raises(DataError, match=rf"{name}.*{fault}"):
            reader(tmp_path / name)
    if not name.startswith(("web", "moving")):
        said = f"expected image 0 .*got one that {fault}"
        with Image.open(tmp_path / name) as opened, pytest.raises(DataError, match=said):
            ImageArray([opened], CANVAS, 3)


def test_pillow_images_that_no_file_has():
    shown = Image.fromarray(np.arange(24 * 32, dtype=np.uint16).reshape(CANVAS) * 5)
    images = ImageArray([shown, Image.new("RGBA", (32, 24), (9, 9, 9, 0)), shown.convert("I")], CANVAS, 3)
    assert images.value_range == (0, 4095) and not images.load(1).any() and (images.load(0) == images.load(2)).all()
    assert "2 of 3 images have 16 bits" in images.notes[0]
    for wrong, fault in ((Image.new("F", (4, 4)), "floating-point"), (Image.new("I", (4, 4), 70_000), "70000")):
        with pytest.raises(DataError, match=f"expected image 0 to have pixels of 8 or 16 bits, got one.*{fault}"):
            ImageArray([wrong], CANVAS, 3)


def test_arrays_of_16_bits():
    wide = (np.arange(2 * 24 * 32).reshape(2, *CANVAS) % 1000).astype(np.uint16)
    images = ImageArray(wide, CANVAS, 1)
    assert images.value_range == (0, 1023) and (images.load(1)[0].numpy() == wide[1] >> 2).all()
    given = ImageArray(np.stack([wide] * 3, -1), CANVAS, 3, (0, 65535))
    assert (given.load(0).permute(1, 2, 0).numpy() == wide[0, ..., None] >> 8).all()


@pytest.mark.parametrize(
    "one",
    [np.zeros((24, 32, 3), np.uint8), np.zeros((24, 32, 1), np.uint8), torch.zeros(3, 24, 32, dtype=torch.uint8)],
)
def test_an_array_of_one_image_is_none_of_several(one):
    with pytest.raises(DataError, match=r"looks like one image. Give array\[None\]"):
        ImageArray(one, CANVAS, 3)
    images = ImageArray(one[None], CANVAS, 3)
    assert len(images) == 1 and images.sizes == [CANVAS]


def test_a_run_keeps_its_range(discs, tmp_path):
    show, rng = Display(), np.random.default_rng(0)
    (tmp_path / "images").mkdir()
    for i in range(40):
        Image.fromarray(rng.integers(0, 4000, (64, 64), np.uint16)).save(tmp_path / "images" / f"{i}.png")
    target = TargetImages(tmp_path / "images", value_range=(0, 4095))
    request = FitRequest(ModelFile(str(discs.file)), target, QUICK, threads=1)
    run, images, *_ = begin(request, tmp_path / "run", show)
    assert run.record["value_range"] == [0, 4095] and images.value_range == (0, 4095)
    assert ImageFolder(tmp_path / "images", (64, 64), 3).fingerprint == images.fingerprint
    again = RunFolder.at(tmp_path / "run")
    for file in (tmp_path / "images").iterdir():  # what is found later makes no difference
        Image.fromarray(np.full((64, 64), 100, np.uint16)).save(file)
    assert int(open_target(again, lambda *_: None).load(0).max()) == 100 >> 4
    resume(FitRequest(target=TargetImages(None, value_range=(0, 4095))), tmp_path / "run", show)
    with pytest.raises(RunError, match=r"value_range that the run.*\[0.0, 4095.0\].*got \[0.0, 255.0\]"):
        resume(FitRequest(target=TargetImages(None, value_range=(0, 255))), tmp_path / "run", show)


def test_a_trial_reads_all_its_sets_over_one_range(folder, tmp_path, monkeypatch):
    jobs = []
    monkeypatch.setattr(Job, "run", lambda job, *_: jobs.append(job) or sys.exit())
    for name, value in (("dim", 900), ("bright", 4000)):
        (tmp_path / name).mkdir()
        for i in range(2):
            Image.fromarray(np.full((64, 64), value + i, np.uint16)).save(tmp_path / name / f"{i}.png")
        images = [{"id": i, "file_name": f"{i}.png"} for i in range(2)]
        boxes = [{"id": i, "image_id": i, "category_id": 1, "bbox": [1, 1, 9, 9]} for i in range(2)]
        record = {"images": images, "annotations": boxes, "categories": [{"id": 1, "name": "square"}]}
        (tmp_path / name / "annotations.json").write_text(json.dumps(record))
    said = []
    for given, used in ((None, [0, 4095]), ((500, 5000), [500, 5000])):
        out = tmp_path / f"out {given}"
        with pytest.raises(SystemExit):
            options = TrialOptions(value_range=given)
            trial(tmp_path / "bright", out, {"dim": tmp_path / "dim"}, options, callback=said.append)
        assert json.loads((out / "trial.json").read_text())["value_range"] == used == list(jobs.pop().value_range)
    assert "Note: 4 of 4 images have 16 bits" in said[0] and "500 to 5000" in said[1]


def test_a_run_on_images_of_8_bits_has_no_range(target, discs, tmp_path):
    request = FitRequest(ModelFile(str(discs.file)), TargetImages(target.images), QUICK, threads=1)
    run = begin(request, tmp_path / "run", Display()).run
    assert "value_range" not in run.record


def test_the_words_of_a_range():
    assert range_given(None) is None and range_given("0,4095") == (0, 4095) and range_given(" 1.5, 2e3") == (1.5, 2000)
    for wrong in ("4095", "a,b", "1,2,3", ""):
        with pytest.raises(ProbsceneError, match="expected --range LOW,HIGH"):
            range_given(wrong)
