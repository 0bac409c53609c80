"""Digit sprites: the split, the choice of a specimen, and the IDX reader against files written here."""

import gzip
import struct
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from probscene.errors import DataError
from probscene.models.digits import Digits, fonts, idx, read_idx, shipped


def idx_bytes(array: np.ndarray) -> bytes:
    return struct.pack(f">BBBB{array.ndim}I", 0, 0, 8, array.ndim, *array.shape) + array.tobytes()


def write_pair(folder: Path, name: str, images: np.ndarray, labels: np.ndarray, end: str = "") -> None:
    squeeze = gzip.compress if end else bytes
    (folder / f"{name}-images-idx3-ubyte{end}").write_bytes(squeeze(idx_bytes(images)))
    (folder / f"{name}-labels-idx1-ubyte{end}").write_bytes(squeeze(idx_bytes(labels)))


def some_digits(number: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    labels = np.concatenate([np.arange(10), rng.integers(0, 10, number - 10)]).astype(np.uint8)
    return rng.integers(0, 256, (number, 28, 28), np.uint8), rng.permutation(labels)


@pytest.mark.parametrize(("held_out", "each"), [(False, 450), (True, 50)])
def test_shipped_digits_are_split_evenly(held_out, each):
    digits = shipped(held_out)
    assert digits.count.tolist() == [each] * 10
    assert digits.first.tolist() == [each * c for c in range(10)]
    assert len(digits.atlas) == 10 * each


def test_held_out_digits_are_in_no_model():
    drawn = {sprite.tobytes() for sprite in shipped(False).atlas.sprites}
    assert not drawn & {sprite.tobytes() for sprite in shipped(True).atlas.sprites}


def test_shipped_digits_are_handwriting_of_their_class():
    """The nearest class mean tells most of the held-out digits."""
    mean = np.stack(shipped(False).atlas.sprites)[..., 3].reshape(10, 450, 28, 28).mean(1)
    held_out = np.stack(shipped(True).atlas.sprites)[..., 3].astype(float)
    distance = ((held_out[:, None] - mean[None]) ** 2).sum((2, 3))
    assert (distance.argmin(1) == np.arange(500) // 50).mean() > 0.7


@pytest.mark.parametrize("source", [shipped, fonts])
def test_glyphs_are_white_with_ink_in_alpha(source):
    sprites = np.stack(source(True).atlas.sprites)
    assert sprites.shape[1:] == (28, 28, 4)
    assert (sprites[..., :3] == 255).all()
    assert (sprites[..., 3].max((1, 2)) > 128).all()


@given(st.lists(st.integers(0, 9), max_size=20), st.integers(0, 1023), st.integers(0, 9))
def test_an_exemplar_picks_a_sprite_of_its_digit(more, part, digit):
    labels = np.array([*range(10), *more])
    images = np.broadcast_to(np.arange(len(labels), dtype=np.uint8)[:, None, None], (len(labels), 28, 28))
    digits = Digits.from_arrays(images, labels)
    specimens = [i for i, label in enumerate(labels) if label == digit]
    index = digits.sprite(torch.tensor([[digit]]), torch.tensor([[part / 1024]])).item()
    assert digits.atlas.sprites[index][0, 0, 3] == specimens[part * len(specimens) // 1024]
    largest = torch.nextafter(torch.tensor([[1.0]]), torch.tensor(0.0))
    assert digits.atlas.sprites[digits.sprite(torch.tensor([[digit]]), largest).item()][0, 0, 3] == specimens[-1]


def test_a_missing_digit_is_a_fault():
    images, labels = some_digits(10)
    with pytest.raises(DataError, match="all digits 0..9"):
        Digits.from_arrays(images[labels != 3], labels[labels != 3])


@pytest.mark.parametrize("end", ["", ".gz"])
@pytest.mark.parametrize(("name", "held_out"), [("train", False), ("t10k", True)])
def test_idx_files_of_a_folder(tmp_path, end, name, held_out):
    images, labels = some_digits(40)
    write_pair(tmp_path, name, images, labels, end)
    digits = idx(tmp_path, held_out)
    want = [image for c in range(10) for image, label in zip(images, labels, strict=True) if label == c]
    assert all((sprite[..., 3] == image).all() for sprite, image in zip(digits.atlas.sprites, want, strict=True))
    assert digits.count.tolist() == [int((labels == c).sum()) for c in range(10)]
    with pytest.raises(DataError, match="got none"):
        idx(tmp_path, not held_out)


@given(st.integers(1, 3), st.data())
def test_an_idx_file_is_read_back_and_no_damaged_one_is(axes, data):
    shape = data.draw(st.tuples(*[st.integers(0, 4)] * axes))
    array = np.random.default_rng(0).integers(0, 256, shape, np.uint8)
    good = idx_bytes(array)
    squeeze = data.draw(st.sampled_from([bytes, gzip.compress]))
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "file"
        file.write_bytes(squeeze(good))
        assert (read_idx(file, axes) == array).all() and read_idx(file, axes).shape == shape
        whole = squeeze(good)
        bad = data.draw(
            st.one_of(
                st.integers(0, len(whole) - 1).map(lambda cut: whole[:cut]),
                st.just(squeeze(good + b"\0")),
                st.just(squeeze(b"\0\0\x09" + good[3:])),
                st.just(squeeze(good[:3] + bytes([axes + 1]) + good[4:])),
            )
        )
        file.write_bytes(bad)
        with pytest.raises(DataError, match="expected"):
            read_idx(file, axes)


def test_idx_files_that_do_not_belong_together(tmp_path):
    images, labels = some_digits(30)
    write_pair(tmp_path, "train", images, labels[:-1])
    with pytest.raises(DataError, match="got 30 and 29"):
        idx(tmp_path, False)
    write_pair(tmp_path, "train", images[:, :20], labels)
    with pytest.raises(DataError, match="28x28"):
        idx(tmp_path, False)
    write_pair(tmp_path, "train", images, labels + 5)
    with pytest.raises(DataError, match="all digits 0..9"):
        idx(tmp_path, False)


@pytest.mark.parametrize(("held_out", "number"), [(False, 60_000), (True, 10_000)])
def test_the_original_files(data_dir, held_out, number):
    if not (data_dir / "mnist").is_dir():
        pytest.skip(f"no folder mnist in {data_dir}")
    digits = partial(idx, data_dir / "mnist")(held_out)
    assert len(digits.atlas) == int(digits.count.sum()) == number
    assert digits.count[5] == (892 if held_out else 5421)  # the rarest digit of the published set


def test_fonts_depend_on_the_seed_alone():
    first, again, other = fonts.__wrapped__(False, 5, 1), fonts.__wrapped__(False, 5, 1), fonts(False, 5, 2)
    held_out = fonts(True, 5, 1)
    stack = [np.stack(digits.atlas.sprites) for digits in (first, again, other, held_out)]
    assert (stack[0] == stack[1]).all()
    assert (stack[0] != stack[2]).any() and (stack[0] != stack[3]).any()


def test_fonts_are_whole_and_centred():
    for sprite in fonts(False, 30).atlas.sprites:
        ink = sprite[..., 3]
        rows, columns = np.flatnonzero(ink.max(1) > 64), np.flatnonzero(ink.max(0) > 64)
        assert not ink[[0, -1]].any() and not ink[:, [0, -1]].any()
        assert 12 <= max(np.ptp(rows), np.ptp(columns)) + 1 <= 24
        assert abs(rows[0] + rows[-1] - 27) <= 4 and abs(columns[0] + columns[-1] - 27) <= 4


def test_importing_a_model_reads_no_digits():
    code = (
        "import probscene.models.multi_mnist as m; from probscene.models import digits as d; "
        "assert m.MODEL.target(0) and not any(f.cache_info().currsize for f in (d.shipped, d.idx, d.fonts))"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parents[2])
