"""A cache on disk of the pictures that a command has drawn, by scene."""

import hashlib
import io
import json
import os
import secrets
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from probscene.errors import MachineError
from probscene.generator import Command

from .reply import Picture


class PictureCache:
    """A folder of pictures, which several processes may share.

    Args:
        folder: made where it is not there.
        command: what draws them; pictures of another command are never returned.

    Raises:
        DataError: a file of the command cannot be read.
    """

    def __init__(self, folder: Path, command: Command):
        self.folder, self._fingerprint = folder, command.fingerprint()

    def file(self, record: dict[str, Any]) -> Path:
        """Where the picture of a scene is, or will be."""
        about = json.dumps([self._fingerprint, record], sort_keys=True)
        name = hashlib.sha256(about.encode()).hexdigest()
        return self.folder / name[:2] / f"{name}.npz"

    def load(self, record: dict[str, Any]) -> Picture | None:
        """The picture of a scene; None where there is none, or where its file is damaged."""
        try:
            with open(self.file(record), "rb") as file, np.load(file) as found:
                picture = Picture(**{"depth": None, "amodal_box": None, **found})
        except Exception:  # damaged bytes raise whatever zipfile, zlib and the parser of numpy's headers do
            return None
        return picture if _is_valid(picture, record) else None

    def save(self, record: dict[str, Any], picture: Picture) -> None:
        """Store the picture of a scene.

        Raises:
            MachineError: the folder cannot be written.
        """
        file, whole = self.file(record), io.BytesIO()
        np.savez_compressed(whole, **{key: part for key, part in picture._asdict().items() if part is not None})
        temporary = file.with_name(f".{file.stem}.{secrets.token_hex(4)}")
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            temporary.write_bytes(whole.getbuffer())
            os.replace(temporary, file)
        except OSError as error:
            with suppress(OSError):
                temporary.unlink()
            raise MachineError(
                f"expected to write pictures to {self.folder}, which keep= of the Command names, got "
                f"{error.strerror}; make room, or take keep= away."
            ) from error


def _is_valid(picture: Picture, record: dict[str, Any]) -> bool:
    """Whether the arrays have the shapes and types of a picture of this scene."""
    height, width, most = record["height"], record["width"], max((node["id"] for node in record["nodes"]), default=0)
    expected = ((height, width, 3), "B"), ((height, width), "h"), ((height, width), "f"), ((most, 4), "f")
    found = zip(picture, expected, strict=True)
    return all(part is None or (part.shape, part.dtype.char) == this for part, this in found)
