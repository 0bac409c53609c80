"""A folder of images reads as what was written to it, and every fault is one clear message."""

import io
import os
import shutil

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from PIL import Image

from probscene.dataset import ImageFolder, grey
from probscene.decoding import eight_bit, full_range, window
from probscene.errors import DataError


def encoded(pixels, kind="PNG", mode=None, **options) -> bytes:
    image = pixels if isinstance(pixels, Image.Image) else Image.fromarray(pixels)
    buffer = io.BytesIO()
    (image.convert(mode) if mode else image).save(buffer, kind, **options)
    return buffer.getvalue()


def read(folder, data: bytes, canvas, channels=3, name="a.png", **options) -> np.ndarray:
    """One file's pixels ``(H, W, C)`` as the folder gives them."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    (folder / name).write_bytes(data)
    return ImageFolder(folder, canvas, channels, **options).load(0).permute(1, 2, 0).numpy()


@pytest.fixture
def noise() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (40, 30, 3), dtype=np.uint8)


@pytest.fixture
def smooth() -> np.ndarray:
    y, x = np.mgrid[:40, :30]
    return np.stack([6 * y, 8 * x, 3 * (x + y)], -1).astype(np.uint8)


@given(arrays(np.uint8, (5, 7, 3)))
def test_png_pixels_come_back(tmp_path_factory, pixels):
    folder = tmp_path_factory.mktemp("images")
    assert (read(folder, encoded(pixels), (5, 7)) == pixels).all()
    assert (read(folder, encoded(pixels[..., 0]), (5, 7), 1)[..., 0] == pixels[..., 0]).all()
    assert (read(folder, encoded(pixels[..., 0]), (5, 7), 3) == pixels[..., :1]).all()


@given(arrays(np.uint8, (2, 3, 4, 5)))
def test_grey_is_what_the_folder_reads(tmp_path_factory, pixels):
    luma = grey(torch.from_numpy(pixels))
    for one, expected in zip(pixels, luma, strict=True):
        got = read(tmp_path_factory.mktemp("images"), encoded(one.transpose(1, 2, 0).copy()), (4, 5), 1)
        assert (got[..., 0] == expected[0].numpy()).all()


@given(arrays(np.uint8, (2, 1, 4, 5)))
def test_grey_stays_as_it_is(pixels):
    image = torch.from_numpy(pixels)
    assert (grey(image.expand(2, 3, 4, 5)) == image).all()
    off = image.repeat(1, 3, 1, 1)
    off[0, 0, 0, 0] += 1
    assert (grey(off)[1] == image[1]).all()


def test_every_kind_of_file(tmp_path, noise, smooth):
    folder, canvas = tmp_path / "images", (40, 30)
    few = Image.fromarray(noise).quantize(9)
    assert (read(folder, encoded(few), canvas) == np.asarray(few.convert("RGB"))).all()
    black = Image.fromarray(noise[..., 0] > 99)
    assert (read(folder, encoded(black), canvas) == 255 * (noise[..., :1] > 99)).all()
    deep = noise[..., 0].astype(np.uint16) * 257
    assert (read(folder, encoded(deep), canvas) == noise[..., :1]).all()
    deep = cv2.imencode(".png", noise[..., ::-1].astype(np.uint16) * 257)[1].tobytes()
    assert (read(folder, deep, canvas) == noise).all()
    for quality in ({"mode": "CMYK"}, {"mode": "L"}, {"progressive": True}, {}):
        got = read(folder, encoded(smooth, "JPEG", quality=98, **quality), canvas, name="a.JpEg")
        wanted = np.asarray(Image.fromarray(smooth).convert("L"))[..., None] if "L" in quality.values() else smooth
        assert abs(got.astype(int) - wanted).max() <= 12


def test_transparent_pixels_lie_on_black(tmp_path, noise):
    folder, canvas = tmp_path / "images", (40, 30)
    alpha = np.random.default_rng(1).integers(0, 256, (40, 30, 1), dtype=np.uint8)
    expected = noise * (alpha / 255)
    got = read(folder, encoded(np.concatenate([noise, alpha], -1)), canvas)
    assert abs(got - expected).max() <= 1
    got = read(folder, encoded(np.concatenate([noise[..., :1], alpha], -1)), canvas)
    assert abs(got - expected[..., :1]).max() <= 1
    palette = Image.fromarray(noise).quantize(9)
    got = read(folder, encoded(palette, transparency=0), canvas)
    assert not got[np.asarray(palette) == 0].any()
    assert (got[np.asarray(palette) > 0] == np.asarray(palette.convert("RGB"))[np.asarray(palette) > 0]).all()


def test_photos_stand_upright(tmp_path, smooth):
    exif = Image.Exif()
    exif[0x0112] = 6  # the camera was turned: the first row is the right-hand side
    data = encoded(np.rot90(smooth).copy(), "JPEG", quality=98, exif=exif)
    assert abs(read(tmp_path / "images", data, (40, 30), name="a.jpg").astype(int) - smooth).max() <= 12
    assert ImageFolder(tmp_path / "images", (40, 30), 3).resized == 0


@given(st.tuples(*[st.integers(1, 90)] * 4), st.sampled_from(["PNG", "JPEG"]))
def test_of_another_size_the_middle_fills_the_canvas(tmp_path_factory, sizes, kind):
    height, width, h, w = sizes
    ramp = np.broadcast_to(np.linspace(0, 255, w)[None, :, None], (h, w, 3)).astype(np.uint8)
    folder = tmp_path_factory.mktemp("images") / "x"
    got = read(folder, encoded(ramp, kind), (height, width), name="a.jpg")
    assert got.shape == (height, width, 3)
    assert abs(got.mean() - ramp.mean()) < 255 / min(w, 8)
    images = ImageFolder(folder, (height, width), 3)
    assert images.resized == ((h, w) != (height, width))
    assert images.cropped == (images.windows[0] is not None)
    assert len(images.notes) == images.resized + images.cropped


@given(st.tuples(*[st.integers(1, 3000)] * 4))
def test_what_is_seen_is_the_most_in_the_middle_that_has_the_canvas_shape(sizes):
    height, width, h, w = sizes
    seen, turned = window((h, w), (height, width)), window((w, h), (width, height))
    if seen is None:
        assert turned is None
        one, other = w * height, h * width
        assert max(one, other) <= 1.02 * min(one, other) or abs(one - other) <= max(height, width)
        return
    assert (turned.left, turned.top, turned.width, turned.height) == seen
    assert min(seen.height, seen.width) >= 1 and min(seen.top, seen.left) >= 0
    assert (seen.height == h) != (seen.width == w)
    assert h - seen.height - 2 * seen.top in (0, 1) and w - seen.width - 2 * seen.left in (0, 1)
    exact = (h, h * width / height) if w * height > h * width else (w * height / width, w)
    assert abs(seen.height - exact[0]) <= 0.5 or exact[0] < 1
    assert abs(seen.width - exact[1]) <= 0.5 or exact[1] < 1


def test_kittis_sizes_are_seen_whole_and_a_flat_screens_are_not():
    for size in ((375, 1242), (370, 1224), (374, 1238), (376, 1241)):
        assert window(size, (375, 1242)) is window(size, (188, 621)) is None
    assert window((360, 480), (188, 621)) == (107, 0, 145, 480)


def test_the_middle_is_cut_before_it_is_resized(tmp_path, noise):
    got = read(tmp_path / "images", encoded(noise), (40, 10))  # columns 10 to 20 of 30
    assert (got == noise[:, 10:20]).all()
    got = read(tmp_path / "images", encoded(np.repeat(noise[:, :, :1], 3, 2)[::2, :18].copy()), (5, 9), 1)
    assert (got[..., 0] == cv2.resize(noise[::2, :18, 0][5:15], (9, 5), interpolation=cv2.INTER_AREA)).all()


def test_a_large_jpeg_is_cut_where_a_small_one_is(tmp_path):
    y, x = np.mgrid[:1200, :900]
    whole = np.stack([y // 5, x // 4, (x + y) // 9], -1).astype(np.uint8)
    got = read(tmp_path / "images", encoded(whole, "JPEG", quality=98), (60, 90), name="a.jpg")  # decoded at an eighth
    expected = whole[300:900].reshape(60, 10, 90, 10, 3).mean((1, 3))
    assert abs(got - expected).max() <= 3


def test_area_interpolation_where_it_shrinks(tmp_path, noise):
    got = read(tmp_path / "images", encoded(noise), (10, 10))
    blocks = noise[5:35].reshape(10, 3, 10, 3, 3).mean((1, 3))
    assert abs(got - blocks).max() <= 1


def test_names_are_sorted_and_the_rest_is_left_out(tmp_path, noise):
    for name in ("b.PNG", "a.jpg", "c.jpeg", ".hidden.png"):
        (tmp_path / name).write_bytes(encoded(noise, "JPEG"))
    (tmp_path / "labels.csv").write_text("1,2")
    (tmp_path / "d.png").mkdir()
    images = ImageFolder(tmp_path, (20, 30), 1)
    assert [path.name for path in images.paths] == ["a.jpg", "b.PNG", "c.jpeg"] and len(images) == 3
    assert images.resized == 3
    resized, cropped, others = images.notes
    assert "3 of 3 images" in resized and "most often 30x40" in resized and "resized to 30x20" in resized
    assert "3 of 3 images" in cropped and "30x20 of 30x40" in cropped and images.cropped == 3
    assert "1 files" in others and "labels.csv" in others


@given(st.integers(0, 5), st.integers(1, 9))
def test_a_view_is_a_part_of_the_image(tmp_path_factory, i, view):
    folder = tmp_path_factory.mktemp("images")
    y, x = np.mgrid[:60, :80]
    ramp = encoded(np.stack([4 * y, 3 * x, 0 * x], -1).astype(np.uint8))
    for k in range(6):
        (folder / f"{k}.png").write_bytes(ramp)
    images = ImageFolder(folder, (30, 40), 3)
    part = images.load(i, view).numpy().astype(float)
    assert torch.equal(images.load(i, view), ImageFolder(folder, (30, 40), 3).load(i, view))
    assert part.shape == (3, 30, 40) and part.dtype == float
    for channel, axis, step, size in ((0, 0, 4, 60), (1, 1, 3, 80)):
        line = part[channel].mean(1 - axis) / step  # where in the image each row or column comes from
        share = (line[-1] - line[0]) / (len(line) - 1) * len(line) / size
        assert 0.75 - 2 / size <= share <= 1 + 2 / size
        assert np.allclose(np.diff(line), share * size / len(line), atol=0.6)
        assert -0.5 <= line[0] and line[-1] <= size - 0.5


def test_views_differ_and_the_first_is_the_image(tmp_path, noise):
    for k in range(5):
        (tmp_path / f"{k}.png").write_bytes(encoded(noise))
    images = ImageFolder(tmp_path, (40, 30), 3)
    seen = {images.load(i, view).numpy().tobytes() for i in range(5) for view in range(1, 5)}
    assert len(seen) >= 15 and (images.load(3).permute(1, 2, 0).numpy() == noise).all()
    for view in (0, 2):
        whole = torch.cat(list(images.batches(2, view)))
        assert torch.equal(whole, torch.stack([images.load(i, view) for i in range(5)]))


@given(st.integers(1, 9), st.integers(1, 12))
def test_batches_are_the_images_in_order(tmp_path_factory, number, size):
    folder = tmp_path_factory.mktemp("images")
    for i in range(number):
        (folder / f"{i}.png").write_bytes(encoded(np.full((2, 3), i, np.uint8)))
    images = ImageFolder(folder, (2, 3), 1)
    batches = list(images.batches(size))
    assert all(len(batch) == size for batch in batches[:-1]) and len(batches) == -(-number // size)
    whole = torch.cat(batches)
    assert whole.dtype == torch.uint8 and whole.shape == (number, 1, 2, 3)
    assert (whole[:, 0, 0, 0] == torch.arange(number)).all() and not images.notes
    with pytest.raises(DataError, match="positive batch size, got 0"):
        next(images.batches(0))


def test_the_fingerprint_is_of_names_bytes_and_shape(tmp_path, noise):
    def fingerprint(folder="one", canvas=(40, 30), channels=3):
        return ImageFolder(tmp_path / folder, canvas, channels).fingerprint

    (tmp_path / "one").mkdir()
    (tmp_path / "one" / "a.png").write_bytes(encoded(noise))
    (tmp_path / "one" / "b.png").write_bytes(encoded(noise[::-1].copy()))
    first = fingerprint()
    shutil.copytree(tmp_path / "one", tmp_path / "two")
    os.utime(tmp_path / "two" / "a.png", (1, 1))
    (tmp_path / "two" / "notes.txt").write_text("x")
    assert fingerprint("two") == first
    (tmp_path / "two" / "a.png").rename(tmp_path / "two" / "c.png")
    renamed = fingerprint("two")
    (tmp_path / "one" / "a.png").write_bytes(encoded(noise + 1))
    assert len({first, renamed, fingerprint(), fingerprint(canvas=(4, 3)), fingerprint(channels=1)}) == 5


KINDS = [("PNG", "L", {}), ("PNG", "RGB", {}), ("PNG", "P", {}), ("PNG", "1", {}),
         ("JPEG", "L", {}), ("JPEG", "RGB", {}), ("JPEG", "RGB", {"progressive": True})]  # fmt: skip


@pytest.mark.parametrize("kind, mode, options", KINDS)
def test_every_truncation_is_found(tmp_path, smooth, kind, mode, options):
    data = encoded(smooth[:16, :16].copy(), kind, mode, **options)
    (tmp_path / "good.png").write_bytes(data)
    for end in range(len(data)):
        (tmp_path / "cut.png").write_bytes(data[:end])
        images = ImageFolder(tmp_path, (16, 16), 1, skip_bad=True)
        assert [path.name for path in images.paths] == ["good.png"], end


def test_altered_bytes_of_a_png_are_found(tmp_path, smooth):
    data = encoded(smooth)
    (tmp_path / "good.png").write_bytes(data)
    for at in range(0, len(data) - 12, 3):  # the last twelve bytes carry nothing
        (tmp_path / "bad.png").write_bytes(data[:at] + bytes([data[at] ^ 0x55]) + data[at + 1 :])
        assert len(ImageFolder(tmp_path, (40, 30), 3, skip_bad=True)) == 1, at


def test_bad_files_are_named_and_skipped_only_when_asked(tmp_path, noise):
    data = encoded(noise)
    (tmp_path / "good.png").write_bytes(data)
    whole = ImageFolder(tmp_path, (40, 30), 3).fingerprint
    (tmp_path / "cut.png").write_bytes(data[:-20])
    (tmp_path / "empty.jpg").write_bytes(b"")
    (tmp_path / "text.jpeg").write_text("not an image")
    (tmp_path / "web.png").write_bytes(encoded(noise, "WEBP"))
    (tmp_path / "gone.png").symlink_to(tmp_path / "nowhere")
    with pytest.raises(DataError, match="5 of 6 bad.*--skip-bad") as error:
        ImageFolder(tmp_path, (40, 30), 3)
    named = ("cut.png is truncated", "empty.jpg is empty", "text.jpeg is not a PNG, JPEG or TIFF image",
             "web.png is a WebP file, whatever its name", "gone.png cannot be read")  # fmt: skip
    assert all(fault in str(error.value) for fault in named)
    images = ImageFolder(tmp_path, (40, 30), 3, skip_bad=True)
    assert len(images) == 1 and (images.load(0).permute(1, 2, 0).numpy() == noise).all()
    assert images.fingerprint == whole
    assert "5 bad files" in images.notes[0] and "cut.png is truncated" in images.notes[0]
    assert {path.name for path in images.bad} == {"cut.png", "empty.jpg", "text.jpeg", "web.png", "gone.png"}
    (tmp_path / "good.png").unlink()
    with pytest.raises(DataError, match="5 of 5 bad.*no other image in the folder"):
        ImageFolder(tmp_path, (40, 30), 3, skip_bad=True)


def test_many_bad_files_make_a_short_message(tmp_path):
    for i in range(300):
        (tmp_path / f"{i:03}.png").write_bytes(b"")
    with pytest.raises(DataError, match="004.png is empty and 295 more") as error:
        ImageFolder(tmp_path, (4, 4), 3)
    assert len(str(error.value)) < 500


def test_folders_that_cannot_be_used(tmp_path, noise):
    def message(path):
        with pytest.raises(DataError) as error:
            ImageFolder(path, (4, 4), 3)
        return str(error.value)

    assert "which is not there" in message(tmp_path / "missing")
    (tmp_path / "a.png").write_bytes(encoded(noise))
    assert "which is a file" in message(tmp_path / "a.png")
    (tmp_path / "empty").mkdir()
    assert "got an empty folder" in message(tmp_path / "empty")
    (tmp_path / "notes" / "images").mkdir(parents=True)
    (tmp_path / "notes" / "annotations.json").write_text("{}")
    assert "only images/, annotations.json; images in subfolders are not read" in message(tmp_path / "notes")


def test_a_file_that_goes_bad_later_is_named(tmp_path, noise):
    (tmp_path / "a.png").write_bytes(encoded(noise))
    images = ImageFolder(tmp_path, (40, 30), 3)
    (tmp_path / "a.png").write_bytes(b"")
    with pytest.raises(DataError, match="a.png as it was, got a file that is empty"):
        next(images.batches(8))


def test_progress_is_told_of_every_file(tmp_path, noise):
    for i in range(3):
        (tmp_path / f"{i}.png").write_bytes(encoded(noise))
    seen = []
    ImageFolder(tmp_path, (4, 4), 3, progress=lambda done, total: seen.append((done, total)))
    assert seen == [(1, 3), (2, 3), (3, 3)]


def sixteen(values: np.ndarray) -> bytes:
    return cv2.imencode(".png", values.astype(np.uint16))[1].tobytes()


def test_images_of_16_bits_are_read_over_one_range(tmp_path, noise):
    wide = noise[..., 0].astype(np.uint16) * 16  # of 12 bits
    (tmp_path / "bright.png").write_bytes(sixteen(wide))
    (tmp_path / "dim.TIF").write_bytes(cv2.imencode(".tif", wide // 16)[1].tobytes())
    (tmp_path / "black.png").write_bytes(sixteen(wide * 0))
    (tmp_path / "plain.png").write_bytes(encoded(noise))
    images = ImageFolder(tmp_path, (40, 30), 3)
    black, bright, dim, plain = (image.permute(1, 2, 0).numpy() for image in next(images.batches(4)))
    assert images.value_range == (0, 4095)
    assert "3 of 4 images have 16 bits a channel and values up to 4080; 0 to 4095 are read" in images.notes[0]
    assert (bright == noise[..., :1]).all() and (dim == noise[..., :1] // 16).all()
    assert not black.any() and (plain == noise).all()
    again = ImageFolder(tmp_path, (40, 30), 3, value_range=[0, 4095])
    other = ImageFolder(tmp_path, (40, 30), 3, value_range=(160, 2000.0))
    assert images.fingerprint == again.fingerprint != other.fingerprint and "160 to 2000 are read" in other.notes[0]
    seen = other.load(1)[0].numpy()
    assert not seen[wide <= 160].any() and (seen[wide >= 2000] == 255).all() and (other.load(3) == images.load(3)).all()
    assert (np.diff(seen.reshape(-1)[wide.reshape(-1).argsort()].astype(int)) >= 0).all()


@given(st.integers(0, 2**16 - 1), st.integers(8, 16))
def test_a_full_range_leaves_the_upper_bits(value, bits):
    pixels = np.full((1, 1), value, np.uint16)
    seen = int(eight_bit(pixels, (0, 2**bits - 1))[0, 0])
    assert seen == min(value >> (bits - 8), 255)
    low, high = full_range(value)
    assert low == 0 and value <= high and (high == 255 or value > high / 2) and int(high) & int(high) + 1 == 0


@given(st.data())
def test_any_range_rises_from_black_to_white(data):
    low = data.draw(st.integers(0, 2**16 - 2))
    high = data.draw(st.integers(low + 1, 2**16 - 1))
    seen = eight_bit(np.arange(2**16, dtype=np.uint16)[None], (low, high))[0]
    assert (np.diff(seen.astype(int)) >= 0).all() and seen[low] == 0 and seen[high] == 255
    steps = np.bincount(seen[low:high], minlength=256)
    assert steps.max() - steps.min() <= 1


@pytest.mark.parametrize("wrong", [(5, 5), (7, 3), (-1, 9), (0, 65536), (0, float("nan")), (1,), "ab", 7])
def test_ranges_that_are_none(tmp_path, noise, wrong):
    (tmp_path / "a.png").write_bytes(encoded(noise))
    with pytest.raises(DataError, match="two values from 0 to 65535, the lower first"):
        ImageFolder(tmp_path, (4, 4), 3, value_range=wrong)


def test_a_range_leaves_images_of_8_bits_as_they_are(tmp_path, noise):
    (tmp_path / "a.png").write_bytes(encoded(noise))
    plain, given_one = ImageFolder(tmp_path, (40, 30), 3), ImageFolder(tmp_path, (40, 30), 3, value_range=(3, 9))
    assert plain.fingerprint == given_one.fingerprint and plain.value_range is None and not given_one.notes
    assert (plain.load(0) == given_one.load(0)).all() and given_one.value_range == (3, 9)


def test_images_in_subfolders_are_said_to_be_left_out(tmp_path, noise):
    for name in ("a.png", "._a.png", "one/b.PNG", "one/._b.png", "two/deep/c.jpg", "two/d.tiff", ".three/e.png"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(encoded(noise))
    (tmp_path / "four").mkdir()
    (tmp_path / "four" / "notes.txt").touch()
    images = ImageFolder(tmp_path, (40, 30), 3)
    assert [file.name for file in images.paths] == ["a.png"] and len(images.notes) == 1
    assert f"3 images in subfolders of {tmp_path} are not read: one/ (1), two/ (2)" in images.notes[0]
