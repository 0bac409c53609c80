"""Files of labels as text, and the numbers in them."""

import math
from pathlib import Path
from typing import Any

from probscene.errors import DataError


def text_of(path: Path) -> str:
    """A file of labels, its lines ended as they are.

    Raises:
        DataError: there is none, or it is no UTF-8.
    """
    try:
        return path.read_bytes().decode("utf-8-sig")
    except OSError as error:
        raise DataError(f"expected a file of labels at {path}, got none: {error.strerror}.") from error
    except UnicodeDecodeError as error:
        raise DataError(f"expected a text file in UTF-8, got {path}: {error}.") from error


def lines_of(path: Path) -> list[tuple[str, list[str]]]:
    """Of each line that has some, where it is, and its words.

    Raises:
        DataError: see ``text_of``.
    """
    lines = enumerate(text_of(path).splitlines(), 1)
    return [(f"in line {number} of {path}", line.split()) for number, line in lines if line.strip()]


def number_of(value: Any) -> float:
    """A number, also where it is written as text; NaN for all else."""
    if isinstance(value, bool) or (isinstance(value, str) and "_" in value):  # Python reads 1_0 as 10
        return math.nan
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        return math.nan
