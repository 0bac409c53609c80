"""Where the files of a dataset go: a folder, or an address of any file system that fsspec knows, such as ``s3://``.

Names are relative to the place, with ``/`` between folders. A file is whole or absent.
"""

import os
import shutil
import socket
import tempfile
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from probscene.errors import MachineError, ProbsceneError

from ..files import machine_error, make_folder, write_whole

PARTS = ".parts"
"""The folder of what is there only while a dataset is made."""


def place_at(out: Path | str) -> "LocalPlace | RemotePlace":
    """The place of a folder, or of an address with ``://``.

    Raises:
        ProbsceneError: an address that names no place.
    """
    if "://" not in str(out):
        return LocalPlace(Path(out))
    scheme, _, path = str(out).partition("://")
    if not path.strip("/"):
        raise ProbsceneError(
            f"expected an address with a place, such as {scheme}://bucket/folder, got {out}; add the place."
        )
    return LocalPlace(Path(path)) if scheme == "file" else RemotePlace(str(out))


class LocalPlace:
    """A folder.

    Args:
        path: the folder; ``make`` creates it.
    """

    def __init__(self, path: Path):
        self.path = self.where = path

    def __str__(self) -> str:
        return str(self.path)

    @property
    def lasting(self) -> str:
        """What means the same from every working directory."""
        return str(self.path.resolve())

    def make(self) -> None:
        """Let it be there and take files.

        Raises:
            DataError, MachineError: see ``make_folder``.
        """
        make_folder(self.path)
        make_folder(self.path / PARTS)

    def names(self) -> list[str]:
        """What is in it, folders as well, but not in these."""
        return [entry.name for entry in self.path.iterdir()] if self.path.is_dir() else []

    def exists(self, name: str) -> bool:
        return (self.path / name).exists()

    def read(self, name: str) -> bytes:
        """The bytes of a file.

        Raises:
            FileNotFoundError: there is none.
        """
        return (self.path / name).read_bytes()

    def read_all(self, names: list[str]) -> list[bytes]:
        """The bytes of several files."""
        return [self.read(name) for name in names]

    def lines(self, name: str) -> Iterator[str]:
        """The lines of a text file, one at a time."""
        with open(self.path / name, encoding="utf-8") as file:
            yield from file

    def put(self, files: dict[str, bytes], links: dict[str, str]) -> None:
        """Write files, and further names of some of them, or copies where the file system has no second names.

        Raises:
            MachineError: the disk is full.
        """
        for folder in {(self.path / name).parent for name in (*files, *links)}:
            make_folder(folder)
        for name, data in files.items():
            self._put(name, lambda aside, data=data: aside.write_bytes(data))
        for name, other in links.items():
            self._put(name, lambda aside, other=other: _link(self.path / other, aside))

    def begin(self, name: str, data: bytes) -> None:
        """Write a file unless another process has."""
        path = self.path / name
        if path.exists():
            return
        aside = self._aside(name)
        write_whole(aside, lambda temporary: temporary.write_bytes(data))
        try:
            if hasattr(os, "link"):
                with suppress(OSError):
                    os.link(aside, path)
            if not path.exists():  # the file system has no second names: the last process's stay
                _move(aside, path)
        finally:
            aside.unlink(missing_ok=True)

    def write(self, files: dict[str, Callable[[Path], Any]]) -> None:
        """Write files by what fills a path; they appear one after the other when all are written."""
        for name, fill in files.items():
            aside = self.path / PARTS / name
            make_folder(aside.parent)
            write_whole(aside, fill)
        for name in files:
            _move(self.path / PARTS / name, self.path / name)

    def remove_parts(self) -> None:
        """Remove what is there only while a dataset is made."""
        shutil.rmtree(self.path / PARTS, ignore_errors=True)

    def _put(self, name: str, fill: Callable[[Path], Any]) -> None:
        path, aside = self.path / name, self._aside(name)
        try:
            fill(aside)
            os.replace(aside, path)
        except OSError as error:
            aside.unlink(missing_ok=True)
            raise machine_error(error, path) from error

    def _aside(self, name: str) -> Path:
        """A path that no other process takes, of any host."""
        return self.path / PARTS / f"{Path(name).name}.{socket.gethostname()}.{uuid.uuid4().hex}"


class RemotePlace:
    """An address of a file system that fsspec knows; a file appears there when all of it is written.

    Args:
        address: such as ``s3://bucket/folder``.

    Raises:
        ProbsceneError: no such file system, or its package is not installed.
    """

    def __init__(self, address: str):
        self.address = self.where = address.rstrip("/")
        try:
            from fsspec.core import url_to_fs

            self._files, self._root = url_to_fs(self.address, use_listings_cache=False)
        except ImportError as error:
            raise ProbsceneError(
                f"expected the package for addresses such as {address}, got none ({error}); for S3, "
                "pip install 'probscene[s3]'."
            ) from error
        except ValueError as error:
            raise ProbsceneError(
                f"expected a folder, or an address of a file system that fsspec knows, got {address} ({error})."
            ) from error

    def __str__(self) -> str:
        return self.address

    @property
    def lasting(self) -> str:
        return self.address

    def make(self) -> None:
        """See that files can be written; object stores have no folders.

        Raises:
            MachineError: they cannot.
        """
        probe = f"{PARTS}/{uuid.uuid4().hex}"
        with self._told():
            self._files.pipe_file(self._at(probe), b"")
            self._files.rm_file(self._at(probe))

    def names(self) -> list[str]:
        """See ``LocalPlace``, as are those below."""
        try:
            with self._told(reading=True):
                found = self._files.ls(self._root, detail=False)
        except FileNotFoundError:
            return []
        return [name.rstrip("/").rpartition("/")[2] for name in found]

    def exists(self, name: str) -> bool:
        with self._told():
            return self._files.exists(self._at(name))

    def read(self, name: str) -> bytes:
        with self._told(reading=True):
            return self._files.cat_file(self._at(name))

    def read_all(self, names: list[str]) -> list[bytes]:
        paths = [self._at(name) for name in names]
        with self._told(reading=True):
            found = self._files.cat(paths) if paths else {}
        return [found[path] for path in paths]  # its own order is another

    def lines(self, name: str) -> Iterator[str]:
        with self._told(reading=True), self._files.open(self._at(name), "rt", encoding="utf-8") as file:
            yield from file

    def put(self, files: dict[str, bytes], links: dict[str, str]) -> None:
        with self._told():
            self._files.pipe(
                {self._at(n): data for n, data in (files | {n: files[o] for n, o in links.items()}).items()}
            )

    def begin(self, name: str, data: bytes) -> None:
        with self._told():
            if not self._files.exists(self._at(name)):
                self._files.pipe_file(self._at(name), data)

    def write(self, files: dict[str, Callable[[Path], Any]]) -> None:
        for name, fill in files.items():
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder, "file")
                try:
                    fill(path)
                except OSError as error:
                    raise machine_error(error, path) from error
                with self._told():
                    self._files.put_file(str(path), self._at(name))

    def remove_parts(self) -> None:
        with suppress(Exception):  # what is left there harms nothing
            self._files.rm(self._at(PARTS), recursive=True)

    def _at(self, name: str) -> str:
        return f"{self._root}/{name}"

    @contextmanager
    def _told(self, reading: bool = False) -> Iterator[None]:
        """Raise what a file system's package raises as one sentence; a file that is not there is for the reader."""
        try:
            yield
        except Exception as error:
            if isinstance(error, ProbsceneError) or (reading and isinstance(error, FileNotFoundError)):
                raise
            raise MachineError(
                f"expected to read and write {self.address}, got {type(error).__name__}: "
                f"{str(error).splitlines()[0] if str(error) else 'nothing more is known'}. See that the place exists, "
                "and that this machine has the rights; docs/how_to/formats.md says where they are looked for."
            ) from error


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
