"""Image files whose pixels are whole are read, whatever lies beside the pixels; others are named with their fault."""

import io
import itertools
import struct
import zlib
from contextlib import suppress

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image, PngImagePlugin

from probscene.dataset import ImageFolder
from probscene.decoding import MAX_PIXELS, decoded, read_rgb, stored, turned
from probscene.errors import DataError
from probscene.image_bytes import Fault, orientation_of

SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4}  # bytes, of TIFF's types
SHORT = 3


def encoded(image, kind: str, **options) -> bytes:
    file = io.BytesIO()
    (image if isinstance(image, Image.Image) else Image.fromarray(image)).save(file, kind, **options)
    return file.getvalue()


def exif(*tags: tuple[int, int, int, bytes], order: str = "<") -> bytes:
    """One directory of tag, type, number of values, and these."""
    directory, beyond = struct.pack(order + "H", len(tags)), b""
    for tag, kind, number, raw in sorted(tags):
        value = raw.ljust(4, b"\0")
        if len(raw) > 4:
            value = struct.pack(order + "I", 14 + 12 * len(tags) + len(beyond))
            beyond += raw
        directory += struct.pack(order + "HHI", tag, kind, number) + value
    start = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(order + "I", 8)
    return b"Exif\0\0" + start + directory + bytes(4) + beyond


def turn(value: int, order: str = "<") -> tuple[int, int, int, bytes]:
    return 0x0112, SHORT, 1, struct.pack(order + "H", value)


def segment(marker: int, contents: bytes) -> bytes:
    return struct.pack(">BBH", 0xFF, marker, len(contents) + 2) + contents


def chunk(kind: bytes, contents: bytes, whole: bool = True) -> bytes:
    checksum = zlib.crc32(kind + contents) ^ (0 if whole else 1)
    return struct.pack(">I", len(contents)) + kind + contents + struct.pack(">I", checksum)


@pytest.fixture(scope="module")
def photograph() -> np.ndarray:
    y, x = np.mgrid[:24, :32]
    return np.stack([6 * y, 7 * x, 4 * (x + y)], -1).astype(np.uint8)


@pytest.fixture(scope="module")
def jpeg(photograph) -> bytes:
    return encoded(photograph, "JPEG", quality=95)


@pytest.fixture(scope="module")
def png(photograph) -> bytes:
    return encoded(photograph, "PNG")


def with_segments(jpeg: bytes, *segments: bytes) -> bytes:
    return jpeg[:2] + b"".join(segments) + jpeg[2:]


def with_chunks(png: bytes, *chunks: bytes, last: bool = False) -> bytes:
    at = len(png) - 12 if last else 33  # before IEND, or after IHDR
    return png[:at] + b"".join(chunks) + png[at:]


def test_2520_exif_blocks_beside_an_orientation(jpeg):
    upright, rng, number = turned(stored(jpeg)[0], 6), np.random.default_rng(0), 0
    tags = (1, 2, 5, 282, 283, 305, 306, 315, 513, 514, 700, 33432, 0x8769, 34675, 0x8825, 37500, 0x9286, 40961, 0x9C9B,
            50341, 0xC4A5)  # fmt: skip
    for tag, kind, count, random in itertools.product(tags, (*SIZES, 0, 129), (0, 1, 2, 5), (False, True)):
        length, order = count * SIZES.get(kind, 1), "<>"[number % 2]
        block = exif(turn(6, order), (tag, kind, count, rng.bytes(length) if random else bytes(length)), order=order)
        found, size = stored(with_segments(jpeg, segment(0xE1, block)))
        assert size == (32, 24) and (found == upright).all(), (tag, kind, count, random)
        number += 1
    assert number == 2520


KINDS = (b"tEXt", b"iTXt", b"zTXt", b"iCCP", b"pHYs", b"gAMA", b"sRGB", b"cHRM", b"tIME", b"sBIT", b"bKGD", b"hIST",
         b"sPLT", b"eXIf", b"acTL", b"fcTL", b"oFFs", b"vpAg")  # fmt: skip


def test_504_chunks_beside_a_png(png, photograph):
    rng, number = np.random.default_rng(0), 0
    large = b"a\0\0" + zlib.compress(bytes(2**21))
    contents = (b"", b"\0", b"a\0", b"Comment\0text", large, rng.bytes(9), rng.bytes(70_000))
    for kind, inside, whole, last in itertools.product(KINDS, contents, (True, False), (True, False)):
        found, _ = stored(with_chunks(png, chunk(kind, inside, whole), last=last))
        assert (found == photograph).all(), (kind, inside[:9], whole, last)
        number += 1
    assert number == 504


@given(st.lists(st.tuples(st.sampled_from([*range(0xE0, 0xF0), 0xFE]), st.binary(max_size=40)), max_size=5))
def test_segments_beside_a_jpeg(jpeg, segments):
    assert (stored(with_segments(jpeg, *(segment(*each) for each in segments)))[0] == stored(jpeg)[0]).all()


@given(st.binary(max_size=60), st.integers(0, 60))
def test_any_exif_is_read_as_some_orientation(noise, end):
    assert orientation_of(noise) in range(1, 9)
    assert orientation_of(b"II*\0" + noise) in range(1, 9)
    cut = exif(turn(6), (282, 5, 1, bytes(8)))
    assert orientation_of(cut[:end]) == (6 if end >= 28 else 1)  # the rest of the directory may be missing


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize("value", [*range(10), 255, 65535])
def test_only_1_to_8_turn(photograph, png, value, order):
    known = value if 1 <= value <= 8 else 1
    block = exif(turn(value, order), order=order)
    reference = {1: None, 2: "FLIP_LEFT_RIGHT", 3: "ROTATE_180", 4: "FLIP_TOP_BOTTOM", 5: "TRANSPOSE",
                 6: "ROTATE_270", 7: "TRANSVERSE", 8: "ROTATE_90"}[known]  # fmt: skip
    image = Image.fromarray(photograph)
    expected = np.asarray(image.transpose(Image.Transpose[reference]) if reference else image)
    for inside in (block, block[6:]):
        found, size = stored(with_chunks(png, chunk(b"eXIf", inside)))
        assert (found == expected).all() and size == expected.shape[:2]


@pytest.mark.parametrize(
    "tag, expected",
    {
        "byte": ((0x0112, 1, 1, b"\x06"), 6),
        "long": ((0x0112, 4, 1, struct.pack("<I", 8)), 8),
        "too long": ((0x0112, 4, 1, struct.pack("<I", 2**16 + 6)), 1),
        "text": ((0x0112, 2, 2, b"6\0"), 1),
        "two": ((0x0112, 3, 2, struct.pack("<HH", 6, 6)), 1),
        "none": ((0x0112, 3, 0, b""), 1),
        "undefined": ((0x0112, 7, 1, b"\x06"), 1),
        "negative": ((0x0112, 8, 1, struct.pack("<h", -1)), 1),
        "real": ((0x0112, 11, 1, struct.pack("<f", 6)), 1),
    }.values(),
)
def test_an_orientation_of_another_type(tag, expected):
    assert orientation_of(exif(tag)) == expected


def test_exif_where_imagemagick_puts_it(png, photograph):
    block = exif(turn(8))
    text = f"\nexif\n{len(block):8}\n{block.hex()}\n".encode()
    name = b"Raw profile type exif\0"
    for each in (chunk(b"tEXt", name + text), chunk(b"zTXt", name + b"\0" + zlib.compress(text))):
        assert (stored(with_chunks(png, each))[0] == turned(photograph, 8)).all()
    for text in (b"\nexif\n 2\nno hexadecimal", b"", b"\xff"):
        assert (
            stored(with_chunks(png, chunk(b"tEXt", name + text), chunk(b"zTXt", name + text)))[0] == photograph
        ).all()


def test_a_large_profile_and_a_comment_beside_other_colours(photograph):
    for mode in ("1", "L", "P", "LA", "RGBA"):
        image = Image.fromarray(photograph).convert(mode)
        text = PngImagePlugin.PngInfo()
        text.add_text("Comment", "a" * 2**21, zip=True)
        plain, much = encoded(image, "PNG"), encoded(image, "PNG", pnginfo=text, dpi=(72, 72))
        assert (stored(plain)[0] == stored(much)[0]).all()
    adobe = encoded(Image.fromarray(photograph).convert("CMYK"), "JPEG", quality=95)
    assert (
        stored(with_segments(adobe, segment(0xE2, b"ICC_PROFILE\0\1\1" + bytes(60_000))))[0] == stored(adobe)[0]
    ).all()


@pytest.mark.parametrize(
    "change, fault",
    {
        "pixels": (lambda d: d[:60] + bytes([d[60] ^ 1]) + d[61:], "the checksum of its IDAT chunk is wrong"),
        "size": (lambda d: d[:20] + b"\1" + d[21:], "the checksum of its IHDR chunk is wrong"),
        "transparency": (lambda d: with_chunks(d, chunk(b"tRNS", bytes(6), False)), "checksum of its tRNS"),
        "a critical chunk": (lambda d: with_chunks(d, chunk(b"CgBI", b"")), "it has a chunk b'CgBI'"),
        "no chunk": (lambda d: with_chunks(d, chunk(b"\0\1\2\3", b"")), "it has a chunk"),
        "two headers": (lambda d: d[:33] + d[8:], "IHDR chunk is not where it belongs"),
        "no pixels": (lambda d: d[:33] + d[-12:], "."),
        "no end": (lambda d: d[:-12], "is truncated"),
    }.values(),
)
def test_what_pixels_need_is_checked(png, change, fault):
    with pytest.raises(Fault, match=fault):
        stored(change(png))


def test_transparency_that_fits_nothing_is_ignored(png, photograph):
    for wrong in (b"", b"\0\0", bytes(300)):
        assert (stored(with_chunks(png, chunk(b"tRNS", wrong)))[0] == photograph).all()
    found = stored(with_chunks(png, chunk(b"tRNS", struct.pack(">3H", *photograph[5, 7]))))[0]
    assert not found[5, 7].any() and (found[6:] == photograph[6:]).all()


@pytest.mark.parametrize(
    "start, name",
    [(b"GIF89a", "GIF"), (b"RIFF\0\0\0\0WEBPVP8 ", "WebP"), (b"BM", "BMP"), (b"\0\0\0\x18ftypheic", "HEIC"),
     (b"\0\0\0\x18ftypavif", "AVIF"), (b"%PDF-1.4", "PDF"), (b"\0\0\0\x0cjP  \r\n", "JPEG 2000"),
     (b"<?xml version='1.0'?>\n<svg", "SVG"), (b"II+\0\x08", "BigTIFF")],
)  # fmt: skip
def test_another_format_is_named(tmp_path, start, name):
    file = tmp_path / "photo.jpg"
    file.write_bytes(start + bytes(100))
    with pytest.raises(DataError, match=f"photo.jpg, got a file that is a {name}.* save it as"):
        read_rgb(file)


def test_an_image_that_is_too_large_is_said_to_be(tmp_path):
    side = 13378
    rows = zlib.compressobj()
    row = bytes(1 + side // 8 + 1)
    pixels = b"".join([*(rows.compress(row) for _ in range(side)), rows.flush()])
    header = struct.pack(">IIBBBBB", side, side, 1, 0, 0, 0, 0)
    parts = [chunk(b"IHDR", header), chunk(b"IDAT", pixels), chunk(b"IEND", b"")]
    (tmp_path / "ortho.png").write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(parts))
    assert side**2 > MAX_PIXELS
    wide = encoded(np.zeros((1, 1), np.uint8), "JPEG")
    at = wide.index(b"\xff\xc0") + 5
    (tmp_path / "wide.jpg").write_bytes(wide[:at] + struct.pack(">HH", 60_000, 60_000) + wide[at + 4 :])
    for read in (lambda: ImageFolder(tmp_path, (9, 9), 3), lambda: read_rgb(tmp_path / "wide.jpg")):
        with pytest.raises(DataError, match="has 60000x60000 pixels.*cut it into parts, or make it smaller"):
            read()
    with pytest.raises(DataError, match="ortho.png has 13378x13378 pixels, where at most 178,956,970 are read: cut it"):
        ImageFolder(tmp_path, (9, 9), 3)


TIFFS = {
    "plain": ("RGB", {}),
    "lzw": ("RGB", {"compression": "tiff_lzw"}),
    "deflate": ("L", {"compression": "tiff_deflate"}),
    "grey": ("L", {}),
    "palette": ("P", {}),
    "two colours": ("1", {}),
}


@pytest.mark.parametrize("mode, options", TIFFS.values(), ids=TIFFS)
def test_tiffs_of_8_bits(photograph, mode, options):
    image = Image.fromarray(photograph).convert(mode)
    whole = encoded(image, "TIFF", **options)
    expected = np.asarray(image if mode in ("L", "RGB") else image.convert("RGB"))
    assert (stored(whole)[0] == expected).all()
    again = encoded(image, "TIFF", exif=exif(turn(6)), **options)
    assert (stored(again)[0] == turned(expected, 6)).all()
    for end in range(len(whole)):
        with pytest.raises(Fault):
            stored(whole[:end])


@pytest.mark.parametrize("kind", [".png", ".tif"])
@pytest.mark.parametrize("shape", [(24, 32), (24, 32, 3), (24, 32, 4)])
def test_16_bits_come_back(kind, shape):
    pixels = np.random.default_rng(0).integers(0, 2**16, shape, dtype=np.uint16)
    bgr = pixels if pixels.ndim == 2 else pixels[..., [2, 1, 0, 3][: shape[2]]]
    data = cv2.imencode(kind, bgr)[1].tobytes()
    found, size = stored(data)
    assert found.dtype == np.uint16 and (found == pixels).all() and size == (24, 32)
    upper = (pixels >> 8).astype(np.uint8)
    seen, _ = decoded(data, (24, 32), 3, value_range=(0, 65535))
    if shape[2:] != (4,):
        assert (seen == (upper[None] if upper.ndim == 2 else upper.transpose(2, 0, 1))).all()
    else:
        assert abs(seen.transpose(1, 2, 0) - upper[..., :3] * (upper[..., 3:] / 255)).max() <= 1


def short(tag: int, *values: int) -> tuple[int, int, int, bytes]:
    return tag, SHORT, len(values), struct.pack(f"<{len(values)}H", *values)


def wide_tiff(pixels: np.ndarray, *more: tuple[int, int, int, bytes]) -> bytes:
    """Colours of 16 bits, not compressed, with some tags more."""
    height, width, channels = pixels.shape
    data = pixels.astype("<u2").tobytes()
    tags = (short(256, width), short(257, height), short(258, *[16] * channels), short(259, 1), short(262, 2),
            short(277, channels), short(278, height), short(279, len(data)), *more)  # fmt: skip
    return exif(*tags, short(273, len(exif(*tags, short(273, 0))) - 6))[6:] + data


@pytest.mark.parametrize("extra", [0, 1, 2])
def test_a_fourth_channel_of_a_tiff_hides_only_where_it_is_opacity_beside_colours(extra):
    """As of 8 bits: 0 is of another meaning, 1 opacity that colours are multiplied with already, 2 opacity."""
    pixels = np.full((4, 5, 4), 40_000, np.uint16)
    pixels[..., 3] = 0
    data = wide_tiff(pixels, short(338, extra))
    assert (decoded(data, (4, 5), 3, value_range=(0, 65535))[0] == (0 if extra == 2 else 40_000 >> 8)).all()


def test_channels_of_16_bits_that_lie_one_after_the_other_are_refused():
    """OpenCV reads them as if they lay side by side."""
    pixels = np.arange(60).reshape(4, 5, 3)
    assert (stored(wide_tiff(pixels, short(284, 1)))[0] == pixels).all()
    with pytest.raises(Fault, match="planar"):
        stored(wide_tiff(pixels, short(284, 2)))


@given(st.integers(0, 11), st.sampled_from([0, 1, 2, 2**31, 2**32 - 1]))
def test_tags_of_another_number_of_values_end_in_no_other_error(entry, number):
    data = wide_tiff(np.arange(60).reshape(4, 5, 3), short(284, 1), short(338, 0), short(339, 1))
    at = 10 + 12 * entry + 4
    with suppress(Fault):
        stored(data[:at] + struct.pack("<I", number) + data[at + 4 :])


def test_a_transparent_colour_of_16_bits():
    grey = (np.arange(6).reshape(2, 3) * 9000).astype(">u2")
    rows = b"".join(b"\0" + row.tobytes() for row in grey)
    parts = [chunk(b"IHDR", struct.pack(">IIBBBBB", 3, 2, 16, 0, 0, 0, 0)), chunk(b"tRNS", struct.pack(">H", 18000)),
             chunk(b"IDAT", zlib.compress(rows)), chunk(b"IEND", b"")]  # fmt: skip
    seen, _ = decoded(b"\x89PNG\r\n\x1a\n" + b"".join(parts), (2, 3), 1, value_range=(0, 65535))
    assert seen.tolist() == [[[0, 9000 >> 8, 0], [27000 >> 8, 36000 >> 8, 45000 >> 8]]]


@pytest.mark.parametrize(
    "image, options, fault",
    {
        "floating point": (Image.new("F", (3, 3)), {}, "floating-point numbers a channel; save it with 8 or 16 bits"),
        "32 bits": (Image.new("I", (3, 3)), {}, "TIFF with 32 signed bits"),
        "pages": (Image.new("L", (3, 3)), {"save_all": True, "append_images": [Image.new("L", (3, 3))]}, "of 2 pages"),
    }.values(),
)
def test_tiffs_that_are_no_photographs(image, options, fault):
    with pytest.raises(Fault, match=fault):
        stored(encoded(image, "TIFF", **options))
