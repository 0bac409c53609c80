"""A dataset's folder, written chunk by chunk, that goes on where it stopped.

    images/000000.png ...   each whole or absent
    .parts/settings.json    what the dataset was begun with
    .parts/000000.json      one record a chunk, written after the chunk's images
    provenance.jsonl        and the other files of labels: written, whole, when every chunk is there; then .parts goes

``provenance.jsonl`` comes last: it says that the dataset is finished, and each of its lines names the settings.
"""

import json
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from probscene.app.files import machine_error, make_folder, write_json, write_text, write_whole
from probscene.app.provenance import CHUNK, image_name
from probscene.errors import DataError

LINES = "provenance.jsonl"
LABELS = "annotations.json"


class Parts:
    """The folder of a dataset.

    Args:
        out: the folder.
        origin: the settings that every line of provenance names.
        num: how many images.
        labelled: whether there is an ``annotations.json``.
    """

    def __init__(self, out: Path, origin: dict[str, Any], num: int, labelled: bool):
        self.out, self.num = Path(out), num
        self.settings = {**origin, "num": num, "format": "coco" if labelled else "images"}
        self._origin, self._parts = origin, self.out / ".parts"

    def missing(self) -> list[int]:
        """Make the folder ready; the chunks that it lacks, none where the dataset is finished.

        Raises:
            DataError: other files, or a dataset of other settings.
            MachineError: the folder cannot be written.
        """
        make_folder(self.out)
        if self.finished:
            self._compare(self._finished_settings())
            return []
        record = self._parts / "settings.json"
        if record.exists():
            self._compare(json.loads(record.read_text(encoding="utf-8")))
        else:
            others = sorted(entry.name for entry in self.out.iterdir() if not entry.name.startswith("."))
            if others:
                raise DataError(
                    f"Expected a new or empty folder for the dataset, actual {self.out} with {', '.join(others[:5])} "
                    "in it; name another folder."
                )
            make_folder(self._parts)
            write_json(record, self.settings)
        make_folder(self.out / "images")
        return [chunk for chunk in self._chunks() if not self._done(chunk)]

    @property
    def finished(self) -> bool:
        """Whether the labels are written."""
        return (self.out / LINES).exists()

    def size(self, chunk: int) -> int:
        """How many images a chunk gives; the last one may give fewer than it draws."""
        return min(CHUNK, self.num - chunk * CHUNK)

    def write(self, chunk: int, images: list[bytes], record: dict[str, Any]) -> None:
        """Write a chunk: its images, then its record.

        Raises:
            MachineError: the disk is full.
        """
        for i, data in enumerate(images):
            path = self.out / image_name(chunk * CHUNK + i)
            temporary = self._parts / f"{path.name}.{os.getpid()}"
            try:
                temporary.write_bytes(data)
            except OSError as error:
                raise machine_error(error, path) from error
            _move(temporary, path)
        write_text(self._part(chunk), json.dumps({"bytes": [len(data) for data in images], **record}))

    def records(self) -> Iterator[dict[str, Any]]:
        """The chunks' records in order, one at a time."""
        for chunk in self._chunks():
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

    def _chunks(self) -> range:
        return range(-(-self.num // CHUNK))

    def _part(self, chunk: int) -> Path:
        return self._parts / f"{chunk:06d}.json"

    def _done(self, chunk: int) -> bool:
        """Whether a chunk's record is there and its images are as long as it says."""
        try:
            sizes = json.loads(self._part(chunk).read_text(encoding="utf-8"))["bytes"]
            files = [self.out / image_name(chunk * CHUNK + i) for i in range(self.size(chunk))]
            return sizes == [file.stat().st_size for file in files]
        except (OSError, ValueError, KeyError):
            return False

    def _finished_settings(self) -> dict[str, Any]:
        try:
            with open(self.out / LINES, encoding="utf-8") as file:
                line = json.loads(next(file))
                num = 1 + sum(1 for _ in file)
            settings = {key: line[key] for key in self._origin}
        except (OSError, StopIteration, ValueError, KeyError, TypeError) as error:
            raise DataError(
                f"Expected lines of provenance in {self.out / LINES}, actual something else; name another folder."
            ) from error
        return {**settings, "num": num, "format": "coco" if (self.out / LABELS).exists() else "images"}

    def _compare(self, before: dict[str, Any]) -> None:
        differing = [key for key in self.settings if before.get(key) != self.settings[key]]
        if differing:
            was, now = (", ".join(f"{key} {s.get(key)}" for key in differing) for s in (before, self.settings))
            raise DataError(
                f"Expected the settings that the dataset in {self.out} was begun with ({was}), actual {now}; "
                "give the same, or name another folder."
            )


def _move(file: Path, path: Path) -> None:
    try:
        os.replace(file, path)
    except OSError as error:
        raise machine_error(error, path) from error
