"""What pixels need of a PNG, JPEG or TIFF file, and which way up they are; all else in the file is left out.

Decoders stumble over metadata that has nothing to do with pixels: odd EXIF types, large profiles, wrong checksums of
comments. Here a file is taken apart, its pixels' parts are checked as far as the format allows, and what is given to a
decoder is a file of these parts alone.
"""

import re
import struct
import zlib
from typing import NamedTuple

_PNG, _JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff"
_TIFF = {b"II*\0": "<", b"MM\0*": ">"}  # the byte order, as struct has it
_BIG_TIFF = (b"II+\0", b"MM\0+")
_OTHERS = {
    "GIF": rb"GIF8", "BMP": rb"BM", "WebP": rb"RIFF.{4}WEBP", "HEIC": rb".{4}ftyp(hei|hev|mif1|msf1)",
    "AVIF": rb".{4}ftypavi[fs]", "JPEG 2000": rb".{4}jP  |\xff\x4f\xff\x51", "JPEG XL": rb"\xff\x0a|.{4}JXL ",
    "PDF": rb"%PDF", "SVG": rb"\s*(<\?xml[^>]*>\s*)?<svg",
}  # fmt: skip
_PIXELS = (b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"IEND")  # chunks of a PNG
_GREY, _RGB, _PALETTE = 0, 2, 3  # colour types of a PNG
_RAW_PROFILE = b"Raw profile type exif"  # where older ImageMagick puts EXIF in a PNG
_LARGEST_PROFILE = 2**20  # bytes; EXIF has at most 64 KiB in a JPEG
_MARKER = re.compile(rb"\xff+([^\xff])", re.DOTALL)  # of a JPEG's segment
ORIENTATION = 0x0112  # EXIF tag
_INTEGERS = {1: "B", 3: "H", 4: "I"}  # EXIF's and TIFF's types
_BITS, _COMPRESSION, _PHOTOMETRIC, _SAMPLE_FORMAT, _REDUCED = 258, 259, 262, 339, 254  # TIFF tags
_PLANAR, _EXTRA = 284, 338  # and how channels lie, and what those beyond colours are
_OPACITY = 2  # beside colours, and not multiplied with them
_PLACES = ((273, 279), (324, 325))  # of strips or tiles: their offsets and their lengths
_TIFF_PIXELS = {256, 257, _BITS, _COMPRESSION, _PHOTOMETRIC, 266, 273, 277, 278, 279, _PLANAR, 292, 293, 317, 320, 322,
                323, 324, 325, 332, _EXTRA, _SAMPLE_FORMAT, 347, 529, 530, 531, 532}  # fmt: skip


class Fault(Exception):
    """A file that cannot be read as an image; the text completes 'a file that ...'."""


class PixelFile(NamedTuple):
    """A file's pixels as they are stored.

    Attributes:
        format: PNG, JPEG or TIFF.
        data: a file of this format with nothing beside its pixels.
        orientation: 1 to 8, as EXIF has them; 1 where the file says nothing that can be understood.
        bits: a channel, 8 or fewer, or 16.
        transparent: of a PNG of 16 bits, the grey or red, green and blue that stand for transparency; empty where none.
        opacity: whether a fourth channel of 16 bits is opacity that colours are to be multiplied with.
    """

    format: str
    data: bytes
    orientation: int
    bits: int
    transparent: tuple[int, ...] = ()
    opacity: bool = True


def pixel_file(data: bytes) -> PixelFile:
    """Of a file's bytes.

    Raises:
        Fault: they are no PNG, JPEG or TIFF file, or are cut or damaged where pixels are.
    """
    if not data:
        raise Fault("is empty")
    if data.startswith(_PNG):
        return _png(data)
    if data.startswith(_JPEG):
        return _jpeg(data)
    if data[:4] in _TIFF:
        return _tiff(data)
    if any(start.startswith(data) for start in (_PNG, _JPEG, *_TIFF)):
        raise Fault("is truncated")
    if data[:4] in _BIG_TIFF:
        raise Fault("is a BigTIFF; save it as TIFF or PNG")
    for name, start in _OTHERS.items():
        if re.match(start, data[:512], re.DOTALL):
            raise Fault(f"is a {name} file, whatever its name; save it as PNG, JPEG or TIFF")
    raise Fault("is not a PNG, JPEG or TIFF image")


def may_have_16_bits(start: bytes) -> bool:
    """Whether a file can have 16 bits a channel, by its first 26 bytes."""
    return (start.startswith(_PNG) and start[24:25] == b"\x10") or start[:4] in _TIFF


def orientation_of(exif: bytes) -> int:
    """What EXIF's bytes say of which way up an image is, 1 to 8; 1 where that cannot be understood."""
    exif = exif.removeprefix(b"Exif\0\0")
    order = _TIFF.get(exif[:4], "")
    if not order:
        return 1
    try:
        (at,) = struct.unpack_from(order + "I", exif, 4)
        (number,) = struct.unpack_from(order + "H", exif, at)
        for entry in range(at + 2, at + 2 + 12 * number, 12):  # one by one: what comes after may be cut
            tag, kind, number, value = struct.unpack_from(order + "HHI4s", exif, entry)
            if tag == ORIENTATION and kind in _INTEGERS and number == 1:
                (found,) = struct.unpack_from(order + _INTEGERS[kind], value)
                return found if 1 <= found <= 8 else 1
    except struct.error:
        pass
    return 1


def _png(data: bytes) -> PixelFile:
    """Chunks: length, type, contents, checksum of type and contents."""
    kept, exif, at, kind = [_PNG], b"", len(_PNG), b""
    bits = colour = colours = 0
    transparent = b""
    while kind != b"IEND":
        if len(data) < at + 12:
            raise Fault("is truncated")
        length, kind = struct.unpack_from(">I4s", data, at)
        end = at + 12 + length
        if end > len(data):
            raise Fault("is truncated")
        contents, whole = (
            data[at + 8 : end - 4],
            zlib.crc32(data[at + 4 : end - 4]) == int.from_bytes(data[end - 4 : end]),
        )
        if not whole and kind in _PIXELS:
            raise Fault(f"is damaged: the checksum of its {kind.decode()} chunk is wrong")
        if not kind.isalpha() or (kind[:1].isupper() and kind not in _PIXELS):
            raise Fault(f"is damaged: it has a chunk {kind!r}")
        if (len(kept) == 1) != (kind == b"IHDR") or (kind == b"IHDR" and length != 13):
            raise Fault("is damaged: its IHDR chunk is not where it belongs")
        if kind == b"IHDR":
            bits, colour = contents[8:10]
        elif kind == b"PLTE":
            colours = length // 3
        if kind in (b"IHDR", b"IDAT", b"IEND") or (kind == b"PLTE" and colour == _PALETTE):
            kept.append(data[at:end])
        elif kind == b"tRNS" and _fits(length, colour, colours):
            transparent = contents
            if bits <= 8:
                kept.append(data[at:end])
        elif kind == b"eXIf" and whole:
            exif = contents
        elif kind in (b"tEXt", b"zTXt") and whole and contents.startswith(_RAW_PROFILE + b"\0"):
            exif = exif or _raw_profile(contents[len(_RAW_PROFILE) + 1 :], kind == b"zTXt")
        at = end
    if colour == _PALETTE and not colours:
        raise Fault("is damaged: it has no palette")
    values = struct.unpack(f">{len(transparent) // 2}H", transparent) if bits == 16 else ()
    return PixelFile("PNG", b"".join(kept), orientation_of(exif), bits, values)


def _fits(length: int, colour: int, colours: int) -> bool:
    """Whether a tRNS chunk is as long as its colour type has it; others are ignored, as libpng does."""
    return 1 <= length <= colours if colour == _PALETTE else length == {_GREY: 2, _RGB: 6}.get(colour)


def _raw_profile(text: bytes, compressed: bool) -> bytes:
    """EXIF that is written as text: a name, a length, and the bytes in hexadecimal."""
    try:
        if compressed:
            text = zlib.decompressobj().decompress(text[1:], _LARGEST_PROFILE)
        return bytes.fromhex("".join(text.decode("ascii").split()[2:]))
    except (zlib.error, ValueError):
        return b""


def _jpeg(data: bytes) -> PixelFile:
    """Segments, each a marker, its length and contents, as far as the first scan; all from there on is pixels."""
    kept, exif, at = [b"\xff\xd8"], b"", 2
    while True:
        found = _MARKER.search(data, at)  # between segments anything else is skipped
        if found is None:
            raise Fault("is truncated")
        marker, start = found[1][0], found.end()
        if marker in (0x00, 0x01) or 0xD0 <= marker <= 0xD8:  # these have no contents
            at = start
            continue
        length = int.from_bytes(data[start : start + 2])
        if marker == 0xD9 or len(data) < start + max(length, 2):
            raise Fault("is truncated")
        contents, at = data[start + 2 : start + length], start + max(length, 2)
        if marker == 0xDA:
            return PixelFile("JPEG", b"".join([*kept, b"\xff", data[start - 1 :]]), orientation_of(exif), 8)
        if marker == 0xE1 and contents.startswith(b"Exif\0\0"):
            exif += contents[6:]  # long EXIF goes on in another segment
        # JFIF and Adobe say how colours are coded.
        is_metadata = 0xE0 <= marker <= 0xEF or marker == 0xFE
        is_jfif = marker == 0xE0 and contents.startswith(b"JFIF\0") and len(contents) >= 14
        is_adobe = marker == 0xEE and contents.startswith(b"Adobe") and len(contents) >= 12
        if not is_metadata or is_jfif or is_adobe:
            kept.append(b"\xff" + data[start - 1 : at])


def _tiff(data: bytes) -> PixelFile:
    """A directory of tags, whose values lie anywhere in the file."""
    order = _TIFF[data[:4]]

    def values(tag: int, default: int) -> tuple[int, ...]:
        if tag not in of:
            return (default,)
        kind, number, value = of[tag]
        if kind not in _INTEGERS or not number:
            raise Fault(f"is a TIFF with a damaged tag {tag}")
        form = f"{order}{number}{_INTEGERS[kind]}"
        if struct.calcsize(form) <= 4:
            return struct.unpack_from(form, value)
        return struct.unpack_from(form, data, struct.unpack(order + "I", value)[0])

    try:
        entries, after = _entries(data, order, struct.unpack_from(order + "I", data, 4)[0])
        of = {tag: (kind, number, value) for tag, kind, number, value in reversed(entries)}
        bits, formats, light, planar = (values(tag, 1) for tag in (_BITS, _SAMPLE_FORMAT, _PHOTOMETRIC, _PLANAR))
        extra, channels = values(_EXTRA, _OPACITY), len(bits)
        places = [at + size for a, b in _PLACES for at, size in zip(values(a, 0), values(b, 0), strict=False)]
    except struct.error as error:
        raise Fault("is truncated") from error
    if max(places) > len(data):
        raise Fault("is truncated")
    if not max(places):
        raise Fault("is a TIFF without pixels")
    if pages := _further_pages(data, order, after):
        raise Fault(f"is a TIFF of {1 + pages} pages; save each as a file of its own")
    if set(formats) - {1, 4} or len(set(bits)) > 1 or (bits[0] != 16 and bits[0] > 8):
        signed = "" if set(formats) <= {1, 4} else "signed "
        kind = "floating-point numbers" if 3 in formats else f"{max(bits)} {signed}bits"
        raise Fault(f"is a TIFF with {kind} a channel; save it with 8 or 16 bits, unsigned")
    if bits[0] == 16 and light[0] not in (1, 2):
        raise Fault("is a TIFF of 16 bits that is neither grey, black being 0, nor RGB; save it as one of these")
    if bits[0] == 16 and channels > 1 and planar[0] != 1:
        raise Fault(
            "is a TIFF of 16 bits whose channels lie one after the other (planar); save it with them side by side"
        )
    turned = orientation_of(data)
    kept = [struct.pack(order + "HHI", *entry[:3]) + entry[3] for entry in entries if entry[0] in _TIFF_PIXELS]
    directory = struct.pack(order + "H", len(kept)) + b"".join(kept) + bytes(4)
    data += bytes(len(data) % 2)
    data = data[:4] + struct.pack(order + "I", len(data)) + data[8:] + directory
    return PixelFile("TIFF", data, turned, bits[0], opacity=extra[0] == _OPACITY)


def _entries(data: bytes, order: str, at: int) -> tuple[list[tuple[int, int, int, bytes]], int]:
    """A directory's entries, each of tag, type, number of values, and the value or where it is; where the next is."""
    (number,) = struct.unpack_from(order + "H", data, at)
    entries = [struct.unpack_from(order + "HHI4s", data, at + 2 + 12 * i) for i in range(number)]
    return entries, struct.unpack_from(order + "I", data, at + 2 + 12 * number)[0]


def _further_pages(data: bytes, order: str, at: int) -> int:
    """How many pages follow that are no small copies of the first."""
    pages, visited = 0, set()
    try:
        while at and at not in visited:
            visited.add(at)
            entries, at = _entries(data, order, at)
            reduced = next((value for tag, _, _, value in entries if tag == _REDUCED), bytes(4))
            pages += not struct.unpack(order + "I", reduced)[0] & 1
    except struct.error:
        pass
    return pages
