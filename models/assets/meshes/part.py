"""One piece of a mesh file, as every format is read, and what is checked of it."""

import io
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image

from probscene.errors import DataError
from probscene.image_bytes import Fault, pixel_file

MOST_TRIANGLES = 200_000


class Part(NamedTuple):
    """``positions (V, 3)``; ``triangles (F, 3)``; ``colour (F, 3)`` of 255; ``tinted``; and with a texture
    ``uv (F, 3, 2)``, v downward, and ``texture (h, w, 3)``."""

    positions: np.ndarray
    triangles: np.ndarray
    colour: np.ndarray
    tinted: bool
    uv: np.ndarray | None
    texture: np.ndarray | None


def check_number(file: Path, triangles: int) -> None:
    """See that a mesh does not have too many triangles.

    Raises:
        DataError: it has.
    """
    if triangles > MOST_TRIANGLES:
        raise DataError(f"expected at most {MOST_TRIANGLES} triangles, got {triangles} in {file}; simplify it.")


def check_geometry(file: Path, positions: np.ndarray, triangles: np.ndarray) -> None:
    """See that triangles are of vertices that are there and finite.

    Raises:
        DataError: they are not.
    """
    if triangles.ndim != 2 or triangles.shape[1] != 3:
        raise DataError(f"expected triangles, got faces of {triangles.shape[1:]} in {file}; triangulate it.")
    if triangles.min() < 0 or triangles.max() >= len(positions):
        raise DataError(f"expected vertices 0..{len(positions) - 1}, got {triangles.max()} in {file}; export it again.")
    if not np.isfinite(positions[triangles]).all():
        raise DataError(f"expected finite vertices, got NaN or infinity in {file}; export it again.")


def is_tinted(material: str) -> bool:
    """Whether a material of this name takes the colours that a model gives to its things."""
    return any(word in material.lower() for word in ("paint", "tint"))


def opened(file: Path, name: str, source: str | io.BytesIO) -> Image.Image:
    """A texture, from a path or from its bytes.

    Raises:
        DataError: it is no picture.
    """
    try:
        data = source.getvalue() if isinstance(source, io.BytesIO) else Path(source).read_bytes()
        with suppress(Fault):
            data = pixel_file(data).data  # Pillow stumbles over what lies beside the pixels
        return Image.open(io.BytesIO(data))
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError):
        raise DataError(f"expected a picture, got {name}, which {file} names; replace it by a PNG or JPEG.") from None


def decoded(file: Path, name: str, image: Image.Image) -> np.ndarray:
    """A texture's pixels, ``(h, w, 3)`` uint8; Pillow decodes them only now.

    Raises:
        DataError: they do not decode.
    """
    try:
        if image.mode.startswith("I;16"):  # which Pillow would cut off at 255
            image = Image.fromarray(np.rint(np.asarray(image) / 257).astype(np.uint8))
        return np.asarray(image.convert("RGB"))
    except (OSError, SyntaxError, ValueError) as error:
        raise DataError(
            f"expected a picture that decodes, got {name}, which {file} names ({error}); replace it."
        ) from None
