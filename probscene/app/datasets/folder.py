"""A dataset's folder, written chunk by chunk, that goes on where it stopped.

    images/000000.png ...   and the other files of an image, each whole or absent
    .parts/settings.json    what the dataset was begun with
    .parts/000000.json      one record a chunk, written after the chunk's files
    .parts/images           the images where they stay in shards alone
    provenance.jsonl        and the other files of labels: written, whole, when every chunk is there; then .parts goes

``provenance.jsonl`` comes last: it says that the dataset is finished, and each of its lines names the settings. Several
processes, of several hosts, may write chunks of their own to one folder at once.
"""

import json
import os
import shutil
import socket
import time
import uuid
import zlib
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from probscene.errors import DataError, MachineError, ProbsceneError

from ..chunks import CHUNK
from ..files import machine_error, make_folder, write_json, write_text, write_whole
from .formats import found
from .provenance import image_name

LINES = "provenance.jsonl"
SEEN = 20  # seconds
UNSAID = {"min_visible": 0.0}
"""Settings that are recorded only where they have another value than this."""


class Shard(NamedTuple):
    """One of ``shards`` processes that make a dataset together, each every ``shards``-th chunk; numbers begin at 0."""

    number: int
    shards: int

    @staticmethod
    def of(text: str) -> "Shard":
        """Of ``"I/N"``.

        Raises:
            ProbsceneError: another text, or I is not in 0..N-1.
        """
        number, _, shards = text.partition("/")
        if not (number.isdecimal() and shards.isdecimal() and int(number) < int(shards)):
            raise ProbsceneError(f"Expected a shard I/N with I from 0 to N - 1, such as 0/8 to 7/8, actual {text!r}.")
        return Shard(int(number), int(shards))


WHOLE = Shard(0, 1)


class DatasetFolder:
    """The folder of a dataset.

    Args:
        out: the folder.
        origin: the settings that every line of provenance names.
        num: how many images.
        formats: see ``formats.chosen``.
    """

    def __init__(self, out: Path, origin: dict[str, Any], num: int, formats: tuple[str, ...]):
        self.out, self.num = Path(out), num
        self.settings = {**origin, "num": num, "format": ",".join(formats)}
        self._kept = formats != ("webdataset",)
        self._origin, self._parts = origin, self.out / ".parts"

    def missing(self, shard: Shard = WHOLE) -> list[int]:
        """Make the folder ready; the chunks of a shard that it lacks, none where the dataset is finished.

        Raises:
            DataError: other files, or a dataset of other settings.
            MachineError: the folder cannot be written.
        """
        make_folder(self.out)
        if self.finished:
            self._compare(self._finished_settings())
            return []
        record = self._parts / "settings.json"
        others = sorted(entry.name for entry in self.out.iterdir() if not entry.name.startswith("."))
        if others and not record.exists():  # in this order: what else is there may be what another process has begun
            raise DataError(
                f"Expected a new or empty folder for the dataset, actual {self.out} with {', '.join(others[:5])} in "
                "it; name another folder."
            )
        make_folder(self._parts)
        self._begin(record)
        try:
            self._compare(json.loads(record.read_text(encoding="utf-8")))
        except FileNotFoundError:  # another process has finished the dataset
            return self.missing(shard)
        return [chunk for chunk in self.of(shard) if not self._done(chunk)]

    def of(self, shard: Shard) -> range:
        """The chunks of a shard."""
        return range(shard.number, len(self._chunks()), shard.shards)

    @property
    def finished(self) -> bool:
        """Whether the labels are written."""
        return (self.out / LINES).exists()

    def size(self, chunk: int) -> int:
        """How many images a chunk gives; the last one may give fewer than it draws."""
        return min(CHUNK, self.num - chunk * CHUNK)

    def image(self, index: int) -> str:
        """Where the file of image number ``index`` is while the work goes on, relative to the folder."""
        return image_name(index) if self._kept else f"{self._parts.name}/{image_name(index)}"

    def write(self, chunk: int, files: dict[str, bytes], links: dict[str, str], record: dict[str, Any]) -> None:
        """Write a chunk: its files, then its record.

        Args:
            files: contents by name, relative to the folder.
            links: further names, each with the file of this chunk that it is another name of.

        Raises:
            MachineError: the disk is full.
        """
        try:
            self._write(chunk, files, links, record)
        except MachineError:
            if not self.finished:
                raise
        if self.finished:  # by another process, which has made this chunk, too
            shutil.rmtree(self._parts, ignore_errors=True)

    def records(self, chunks: range | None = None) -> Iterator[dict[str, Any]]:
        """The chunks' records in order, one at a time; of all chunks where not said otherwise."""
        for chunk in self._chunks() if chunks is None else chunks:
            yield json.loads(self._part(chunk).read_text(encoding="utf-8"))

    def finish(self, write: dict[str, Callable[[Path], Any]]) -> None:
        """Write files of labels, by name, ``provenance.jsonl`` the last of them, and drop the records.

        Raises:
            MachineError: the disk is full.
        """
        if not self.finished:
            for name, contents in write.items():
                write_whole(self._parts / name, contents)
            for name in write:
                _move(self._parts / name, self.out / name)
        shutil.rmtree(self._parts, ignore_errors=True)

    def chunks(self, number: int) -> list[range]:
        """All chunks, ``number`` at a time."""
        whole = self._chunks()
        return [whole[i : i + number] for i in range(0, len(whole), number)]

    def _chunks(self) -> range:
        return range(-(-self.num // CHUNK))

    def _part(self, chunk: int) -> Path:
        return self._parts / f"{chunk:06d}.json"

    def _write(self, chunk: int, files: dict[str, bytes], links: dict[str, str], record: dict[str, Any]) -> None:
        for folder in {(self.out / name).parent for name in (*files, *links)}:
            make_folder(folder)
        for name, data in files.items():
            self._put(name, lambda temporary, data=data: temporary.write_bytes(data))
        for name, other in links.items():
            self._put(name, partial(_link, self.out / other))
        sums = {name: zlib.crc32(files[links.get(name, name)]) for name in (*files, *links)}
        write_text(self._part(chunk), json.dumps({"crc32": sums, **record}))

    def _done(self, chunk: int) -> bool:
        """Whether a chunk's record is there and its files hold what it says."""
        try:
            sums = json.loads(self._part(chunk).read_text(encoding="utf-8"))["crc32"]
            return all(zlib.crc32((self.out / name).read_bytes()) == found for name, found in sums.items())
        except (OSError, ValueError, KeyError, AttributeError):
            return False

    def _begin(self, record: Path) -> None:
        """Write the settings, unless another process has done so."""
        if record.exists():
            return
        temporary = self._aside(record.name)
        write_json(temporary, self.settings)
        try:
            if hasattr(os, "link"):
                with suppress(OSError):
                    os.link(temporary, record)
            if not record.exists():  # the file system has no second names: the last process's stay
                _move(temporary, record)
        finally:
            temporary.unlink(missing_ok=True)

    def _put(self, name: str, write: Callable[[Path], Any]) -> None:
        """A file of an image by ``write(temporary path)``."""
        path = self.out / name
        temporary = self._aside(path.name)
        try:
            write(temporary)
            os.replace(temporary, path)
        except OSError as error:
            temporary.unlink(missing_ok=True)
            raise machine_error(error, path) from error

    def _aside(self, name: str) -> Path:
        """A path that no other process takes, of any host."""
        return self._parts / f"{name}.{socket.gethostname()}.{uuid.uuid4().hex}"

    def _finished_settings(self) -> dict[str, Any]:
        try:
            with open(self.out / LINES, encoding="utf-8") as file:
                line = json.loads(next(file))
                num = 1 + sum(1 for _ in file)
            settings = {key: line[key] for key in self._origin.keys() - UNSAID}
            settings |= {key: line.get(key, usual) for key, usual in UNSAID.items()}
        except (OSError, StopIteration, ValueError, KeyError, TypeError) as error:
            raise DataError(
                f"Expected lines of provenance in {self.out / LINES}, actual something else; name another folder."
            ) from error
        return {**settings, "num": num, "format": ",".join(found(self.out))}

    def _compare(self, before: dict[str, Any]) -> None:
        before, settings = UNSAID | before, UNSAID | self.settings
        differing = [key for key in settings if before.get(key) != settings[key]]
        if differing:
            was, now = (", ".join(f"{key} {s.get(key)}" for key in differing) for s in (before, settings))
            raise DataError(
                f"Expected the settings that the dataset in {self.out} was begun with ({was}), actual {now}; "
                "give the same, or name another folder; this one is left as it is."
            )


def check_begun(out: Path) -> None:
    """See that a dataset which another machine has begun is seen here, too.

    Raises:
        DataError: it is not.
    """
    for _ in range(SEEN):  # a network's file system may be some seconds behind
        if (out / ".parts" / "settings.json").exists():
            return
        time.sleep(1)
    raise DataError(
        f"Expected the folder {out} of the machine that runs the command, actual another or none; write to a folder "
        "that all nodes share."
    )


def _link(other: Path, path: Path) -> None:
    """Make ``path`` another name of a file, or a copy of it where the file system has no second names."""
    if hasattr(os, "link"):
        with suppress(OSError):
            os.link(other, path)
            return
    shutil.copyfile(other, path)


def _move(file: Path, path: Path) -> None:
    try:
        os.replace(file, path)
    except OSError as error:
        raise machine_error(error, path) from error
