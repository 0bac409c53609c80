"""Files that are whole or absent: written aside, synced, then renamed over the old one."""

import errno
import json
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from probscene.errors import DataError, MachineError


def write_whole(path: Path, write: Callable[[Path], Any]) -> None:
    """Call ``write(temporary path)``, then rename it to ``path``.

    Raises:
        MachineError: the disk is full or the folder cannot be written; ``path`` is as it was.
    """
    path = Path(path)
    temporary = None
    try:
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        os.close(handle)
        temporary = Path(name)
        write(temporary)
        with open(temporary, "rb+") as file:
            os.fsync(file.fileno())
        temporary.chmod(0o666 & ~_UMASK)
        os.replace(temporary, path)
    except OSError as error:
        raise machine_error(error, path) from error
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """``write_whole`` for text: UTF-8, the same bytes on every platform; of names that are no UTF-8, escapes."""
    data = text.encode("utf-8", "backslashreplace")
    write_whole(path, lambda temporary: temporary.write_bytes(data))


def write_json(path: Path, value: Any) -> None:
    """``write_whole`` for JSON with sorted keys."""
    write_text(path, json.dumps(value, indent=1, sort_keys=True) + "\n")


def make_folder(path: Path) -> Path:
    """Create a folder and its parents.

    Raises:
        DataError: a file is in the way.
        MachineError: it cannot be created or written.
    """
    path = Path(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError) as error:
        raise DataError(f"expected a folder at {path}, got a file in the way; name another folder.") from error
    except OSError as error:
        raise machine_error(error, path) from error
    if not os.access(path, os.W_OK | os.X_OK):
        raise MachineError(f"expected a folder that can be written, got {path} is read-only; name another folder.")
    return path


def machine_error(error: OSError, path: Path) -> MachineError:
    """The message for an ``OSError`` while writing ``path``."""
    if error.errno in _FULL:
        return MachineError(f"The disk is full: could not write {path}. Free some space and run the command again.")
    return MachineError(f"Could not write {path}: {error.strerror or error}.")


_FULL = {getattr(errno, name) for name in ("ENOSPC", "EDQUOT") if hasattr(errno, name)}
_UMASK = os.umask(0)
os.umask(_UMASK)
