"""``counts.csv``: how many objects of each class an image shows.

The columns are ``image`` and classes of the model, in any order; one row an image, in any order, separated by commas,
semicolons or tabs. A class that nobody has labelled has no column, or an empty one. A row without any count is of an
image that nobody has labelled.

    image,0,1,2
    000000.png,0,2,1
"""

import csv
import io
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from probscene.dataset import Images
from probscene.errors import DataError

from ..files import write_text
from .naming import Entry, composed, labelled_classes, match_target, printable
from .text import text_of


class Table(NamedTuple):
    """The counts of K of a target's images.

    Attributes:
        rows: the K numbers of the images, ascending.
        counts: ``(K, C)`` int64.
        classes: the C that are labelled, in the model's order.
        notes: what a person should know, one sentence each.
    """

    rows: list[int]
    counts: NDArray[np.int64]
    classes: tuple[str, ...]
    notes: tuple[str, ...] = ()


def read_table(path: Path, classes: tuple[str, ...], target: Images, allow_missing: bool = False) -> Table:
    """The counts of a target's images. Rows of files that the target left out as bad, or that it has not, are skipped;
    a note names the latter.

    Args:
        classes: the model's.
        allow_missing: there need not be a row with counts for every image; those without are left out.

    Raises:
        DataError: no such file, no column of a class, two of one name, a row of another length or with some of its
            counts, two rows of an image or none, or what is not a count; the first is named.
    """
    path = Path(path)
    header, lines = _lines(path)
    expected = f"the columns {','.join(['image', *classes])}"
    if header.count("image") != 1 or len(set(header)) != len(header):
        raise DataError(f"expected {expected} in {path}, got {','.join(header) or 'none'}.")
    found, notes = labelled_classes([name for name in header if name != "image"], classes, expected, path)
    for number, fields in lines:
        if len(fields) != len(header):
            raise DataError(f"expected {len(header)} fields in line {number} of {path}, got {len(fields)}.")
    cells = [(number, dict(zip(header, fields, strict=True))) for number, fields in lines]
    empty = tuple(name for name in found if cells and not any(row[name].strip() for _, row in cells))
    if empty and len(empty) < len(found):
        found = {name: own for name, own in found.items() if name not in empty}
        notes += (f"Not labelled, since its column is empty: {', '.join(empty)}.",)
    cells = [(number, row) for number, row in cells if any(row[name].strip() for name in found)]
    entries = [Entry(row["image"], f"in line {number} of {path}") for number, row in cells]
    images = match_target(path, entries, target, allow_missing)
    counts = [[_count(cells[k][1][name].strip(), name, *entries[k]) for name in found] for k in images.entries.values()]
    whole = np.array(counts, np.int64).reshape(len(counts), len(found))
    return Table(list(images.entries), whole, tuple(found.values()), (*images.notes, *notes))


def write_counts(path: Path, names: list[str], counts: NDArray[np.int64], classes: tuple[str, ...]) -> None:
    """A ``counts.csv`` of ``counts (L, C)``, whole or not at all."""
    write_cells(path, [[name, *map(str, row)] for name, row in zip(names, counts.tolist(), strict=True)], classes)


def write_cells(path: Path, rows: list[list[str]], classes: tuple[str, ...]) -> None:
    """A ``counts.csv`` of rows that begin with an image's name, whole or not at all."""
    text = io.StringIO()
    named = [[printable(name), *counts] for name, *counts in rows]
    csv.writer(text, lineterminator="\n").writerows([["image", *classes], *named])
    write_text(path, text.getvalue())


def _lines(path: Path) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """The header, and the fields of each further row with its number."""
    text = text_of(path)
    first = text.partition("\n")[0]
    try:
        lines = io.StringIO(text, newline="")
        rows = list(csv.reader(lines, delimiter=max(",;\t", key=first.count), strict=True))
    except csv.Error as error:
        raise DataError(f"expected a CSV file in UTF-8, got {path}: {error}.") from error
    named = [(number, fields) for number, fields in enumerate(rows[1:], 2) if any(field.strip() for field in fields)]
    return [composed(name.strip()) for name in rows[0]] if rows else [], named


def _count(text: str, column: str, name: str, where: str) -> int:
    if not re.fullmatch(r"\+?[0-9]{1,9}", text, re.ASCII):
        remedy = "write a whole number" if text else "write 0 where there is none, or leave the whole row empty"
        raise DataError(
            f"expected a count of 0 or more for class {column!r} of {name} {where}, got {text!r}; {remedy}."
        )
    return int(text)
