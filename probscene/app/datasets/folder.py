"""A dataset's folder, or address, written chunk by chunk, that goes on where it stopped.

    images/000000.png ...   and the other files of an image, each whole or absent
    .parts/settings.json    what the dataset was begun with
    .parts/000000.json      one record a chunk, written after the chunk's files
    .parts/images           the images where they stay in shards alone
    provenance.jsonl        and the other files of labels: written, whole, when every chunk is there; then .parts goes

``provenance.jsonl`` comes last: it says that the dataset is finished, and each of its lines names the settings. Several
processes, of several hosts, may write chunks of their own to one folder at once.
"""

import json
import time
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from probscene.errors import DataError, MachineError, ProbsceneError

from ..chunks import CHUNK
from .formats import detect_formats
from .places import PARTS, place_at
from .provenance import image_name

LINES, SETTINGS = "provenance.jsonl", f"{PARTS}/settings.json"
VISIBLE_TIMEOUT = 20  # seconds
MAX_FLAT_IMAGES = 10_000  # images
DEFAULT_SETTINGS = {"min_visible": 0.0, "box_margin": 0, "flat": True, "amodal": False, "values": ""}
"""Settings that are recorded only where they have another value than this."""


class Shard(NamedTuple):
    """One of ``shards`` processes that make a dataset together, each every ``shards``-th chunk; numbers begin at 0."""

    number: int
    shards: int

    @staticmethod
    def from_text(text: str) -> "Shard":
        """Of ``"I/N"``.

        Raises:
            ProbsceneError: another text, or I is not in 0..N-1.
        """
        number, _, shards = text.partition("/")
        if not (number.isdecimal() and shards.isdecimal() and int(number) < int(shards)):
            raise ProbsceneError(f"expected a shard I/N with I from 0 to N - 1, such as 0/8 to 7/8, got {text!r}.")
        return Shard(int(number), int(shards))


WHOLE = Shard(0, 1)


class DatasetFolder:
    """The folder of a dataset.

    Args:
        out: the folder, or an address of a file system that fsspec knows.
        origin: the settings that every line of provenance names.
        num: how many images.
        formats: see ``formats.chosen``.
        flat: all images in one folder; of more than ``MAX_FLAT_IMAGES``, a thousand share one otherwise.

    Attributes:
        flat: whether they are.
    """

    def __init__(self, out: Path | str, origin: dict[str, Any], num: int, formats: tuple[str, ...], flat: bool = False):
        self.place, self.num = place_at(out), num
        self.flat = flat or num <= MAX_FLAT_IMAGES
        self.settings = {**origin, "num": num, "format": ",".join(formats), "flat": self.flat}
        self._kept = formats != ("webdataset",)
        self._origin = origin

    def missing(self, shard: Shard = WHOLE) -> list[int]:
        """Make the folder ready; the chunks of a shard that it lacks, none where the dataset is finished.

        Raises:
            DataError: other files, or a dataset of other settings.
            MachineError: the folder cannot be written.
        """
        if self.finished:
            self._compare(self._finished_settings())
            return []
        others = sorted(name for name in self.place.names() if not name.startswith("."))
        begun = self.place.exists(SETTINGS)  # in this order: what else is there may be what another process has begun
        if others and not begun:
            raise DataError(
                f"expected a new or empty folder for the dataset, got {self.place} with {', '.join(others[:5])} in "
                "it; name another folder."
            )
        self.place.make()
        self.place.begin(SETTINGS, (json.dumps(self.settings, indent=1, sort_keys=True) + "\n").encode())
        try:
            self._compare(json.loads(self.place.read(SETTINGS)))
        except FileNotFoundError:  # another process has finished the dataset
            return self.missing(shard)
        return [chunk for chunk in self.chunks_of(shard) if not self._done(chunk)]

    def chunks_of(self, shard: Shard) -> range:
        """The chunks of a shard."""
        return range(shard.number, len(self._chunks()), shard.shards)

    @property
    def finished(self) -> bool:
        """Whether the labels are written."""
        return self.place.exists(LINES)

    def size(self, chunk: int) -> int:
        """How many images a chunk gives; the last one may give fewer than it draws."""
        return min(CHUNK, self.num - chunk * CHUNK)

    def image(self, index: int) -> str:
        """Where the file of image number ``index`` is while the work goes on, relative to the folder."""
        name = image_name(index, self.flat)
        return name if self._kept else f"{PARTS}/{name}"

    def write(self, chunk: int, files: dict[str, bytes], links: dict[str, str], record: dict[str, Any]) -> None:
        """Write a chunk: its files, then its record.

        Args:
            files: contents by name, relative to the folder.
            links: further names, each with the file of this chunk that it is another name of.

        Raises:
            MachineError: the disk is full.
        """
        sums = {name: zlib.crc32(files[links.get(name, name)]) for name in (*files, *links)}
        try:
            self.place.put(files, links)
            self.place.put({self._part(chunk): json.dumps({"crc32": sums, **record}).encode()}, {})
        except MachineError:
            if not self.finished:
                raise
        if self.finished:  # by another process, which has made this chunk, too
            self.place.remove_parts()

    def records(self, chunks: range | None = None) -> Iterator[dict[str, Any]]:
        """The chunks' records in order, one at a time; of all chunks where not said otherwise."""
        for chunk in self._chunks() if chunks is None else chunks:
            yield json.loads(self.place.read(self._part(chunk)))

    def finish(self, write: dict[str, Callable[[Path], Any]]) -> None:
        """Write files of labels, by name, ``provenance.jsonl`` the last of them, and drop the records.

        Raises:
            MachineError: the disk is full.
        """
        if not self.finished:
            self.place.write(write)
        self.place.remove_parts()

    def chunks(self, number: int) -> list[range]:
        """All chunks, ``number`` at a time."""
        whole = self._chunks()
        return [whole[i : i + number] for i in range(0, len(whole), number)]

    def _chunks(self) -> range:
        return range(-(-self.num // CHUNK))

    def _part(self, chunk: int) -> str:
        return f"{PARTS}/{chunk:06d}.json"

    def _done(self, chunk: int) -> bool:
        """Whether a chunk's record is there and its files hold what it says."""
        try:
            sums = json.loads(self.place.read(self._part(chunk)))["crc32"]
            files = self.place.read_all([*sums])
            return all(zlib.crc32(data) == known for data, known in zip(files, sums.values(), strict=True))
        except (OSError, ValueError, KeyError, AttributeError):
            return False

    def _finished_settings(self) -> dict[str, Any]:
        try:
            lines = self.place.lines(LINES)
            line = json.loads(next(lines))
            num = 1 + sum(1 for _ in lines)
            settings = {key: line[key] for key in self._origin.keys() - DEFAULT_SETTINGS}
            settings |= {key: line.get(key, usual) for key, usual in DEFAULT_SETTINGS.items()}
        except (OSError, StopIteration, ValueError, KeyError, TypeError) as error:
            raise DataError(
                f"expected lines of provenance in {self.place}/{LINES}, got something else; name another folder."
            ) from error
        settings |= {"num": num, "format": ",".join(detect_formats(self.place.exists))}
        return settings | {"flat": line["image"] == image_name(line["index"], True)}

    def _compare(self, before: dict[str, Any]) -> None:
        before, settings = DEFAULT_SETTINGS | before, DEFAULT_SETTINGS | self.settings
        differing = [key for key in settings if before.get(key) != settings[key]]
        if differing:
            was, now = (", ".join(f"{key} {s.get(key)}" for key in differing) for s in (before, settings))
            raise DataError(
                f"expected the settings that the dataset in {self.place} was begun with ({was}), got {now}; "
                "give the same, or name another folder; this one is left as it is."
            )


def check_begun(out: Path | str) -> None:
    """See that a dataset which another machine has begun is seen here, too.

    Raises:
        DataError: it is not.
    """
    place = place_at(out)
    for _ in range(VISIBLE_TIMEOUT):  # a network's file system may be some seconds behind
        if place.exists(SETTINGS):
            return
        time.sleep(1)
    raise DataError(
        f"expected the folder {out} of the machine that runs the command, got another or none; write to a folder "
        "that all nodes share, or to an address such as s3://."
    )
