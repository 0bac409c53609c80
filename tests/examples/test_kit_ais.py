"""Crops of frames against slices of frames that another library has scaled, and their labels against brute force."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from probscene.app.evaluation.labels import read_labels
from probscene.app.loading import load_model
from probscene.dataset import ImageFolder

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "kit_ais.py"
CARS = [(100, 90), (355, 150), (601, 299), (612, 20), (20, 200)]  # middles, pixels of the frame


def label(file, size, cars=CARS, length=30):
    """Cars and, as another class, a bus."""
    width, height = size
    rows = [f"0 {x / width} {y / height} {length / width} {14 / height}" for x, y in cars]
    file.write_text("\n".join([*rows, "2 0.5 0.5 0.2 0.1", ""]))


@pytest.fixture
def frames(tmp_path):
    """Two frames of one sequence, 700 x 320, and one of another, 640 x 560."""
    rng = np.random.default_rng(0)
    folder = tmp_path / "frames"
    folder.mkdir()
    for name, (width, height) in {"A9": (700, 320), "A10": (700, 320), "B3": (640, 560)}.items():
        coarse = rng.integers(0, 256, (height // 20, width // 20, 3), np.uint8)
        Image.fromarray(coarse).resize((width, height), Image.Resampling.BICUBIC).save(folder / f"{name}.png")
        label(folder / f"{name}.txt", (width, height))
    return folder


def test_crops_and_their_counts(frames, tmp_path, script):
    done = script(EXAMPLE, frames, "--out", tmp_path / "out", "--stride", "100", "--held-out", "B3")
    assert done.returncode == 0, done.stderr
    # 18 / 30 would make the first sequence's frames 192 pixels high, so they become 256; the second's become 336.
    for part, names, scale in (("fit", ["A9", "A10"], 256 / 320), ("held_out", ["B3"], 18 / 30)):
        whole = {name: Image.open(frames / f"{name}.png").convert("RGB") for name in names}
        size = tuple(round(side * scale) for side in whole[names[0]].size)
        corners = [(x, y) for y in range(0, size[1] - 255, 100) for x in range(0, size[0] - 255, 100)]
        written = {file.name for file in (tmp_path / "out" / part / "images").iterdir()}
        assert written == {f"{name}-{x}-{y}.png" for name in names for x, y in corners}
        rows = dict(row.split(",") for row in (tmp_path / "out" / part / "counts.csv").read_text().split())
        assert rows.pop("image") == "car" and rows.keys() == written
        for name in names:
            resized = np.asarray(whole[name].resize(size, Image.Resampling.BOX), np.int16)
            for x, y in corners:
                crop = cv2.imread(str(tmp_path / "out" / part / "images" / f"{name}-{x}-{y}.png"))[..., ::-1]
                assert crop.shape == (256, 256, 3)
                there = resized[y : y + 256, x : x + 256]
                assert np.abs(crop - there).mean() < 0.5 * np.abs(crop[:, 1:] - there[:, :-1]).mean()
                inside = [x <= a * scale < x + 256 and y <= b * scale < y + 256 for a, b in CARS]
                assert int(rows[f"{name}-{x}-{y}.png"]) == sum(inside)
    assert "A9: 2 frames times 0.800" in done.stdout and "B3: 1 frames times 0.600" in done.stdout


FAULTS = {
    "no frames": (lambda folder: [file.unlink() for file in folder.iterdir()], "expected frames"),
    "no labels": (lambda folder: (folder / "A10.txt").unlink(), "A10.txt"),
    "no YOLO": (lambda folder: (folder / "A9.txt").write_text("0 0.5 0.5\n"), "line 1"),
    "no image": (lambda folder: (folder / "B3.png").write_bytes(b"no image"), "B3.png"),
    "one sequence": (lambda folder: (folder / "B3.png").unlink(), "--held-out"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_bad_frames_are_named(fault, frames, tmp_path, script):
    spoil, part = FAULTS[fault]
    spoil(frames)
    done = script(EXAMPLE, frames, "--out", tmp_path / "out", "--held-out", "B3")
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert part in done.stderr and done.stderr.startswith("kit_ais: expected ")


def test_the_real_frames(data_dir, tmp_path, script):
    data = data_dir / "aerial" / "kit_ais"
    if not data.is_dir():
        pytest.skip(f"no KIT AIS frames in {data}")
    done = script(EXAMPLE, data, "--out", tmp_path, "--stride", "256")
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("frames times") == 3
    model = load_model("aerial2d")
    for part, prefixes in (("fit", {"MOS"}), ("held_out", {"MunichStreet02"})):
        images = ImageFolder(tmp_path / part / "images", model.canvas, model.channels)
        assert {file.name.split("-")[0].rstrip("0123456789") or "MOS" for file in images.paths} == {
            prefix.rstrip("0123456789") for prefix in prefixes
        } and not images.resized
        truth = read_labels(tmp_path / part / "counts.csv", model, images)
        assert truth.classes == ("car",) and 8 < truth.structures.counts.mean() < 20
