"""``counts.csv``: how many objects of each class an image shows; the truth that learnt structures are judged by.

    image,0,1,2
    000000.png,0,2,1

One row an image, in any order; the columns are ``image`` and the model's classes, in any order. Fitting never reads it.
"""

import csv
import io
import json
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from probscene.app.files import write_text
from probscene.dataset import ImageFolder
from probscene.derivation import Derivation
from probscene.errors import DataError
from probscene.model import SceneModel

Counts = NDArray[np.int64]


def read_counts(path: Path, classes: tuple[str, ...], target: ImageFolder) -> Counts:
    """The counts ``(L, C)`` of a target's images, in the order of its files.

    Rows of files that the target left out as bad are passed over.

    Raises:
        DataError: no such file, other columns, a row of another length, an image that is not there, twice there or
            without a row, or what is not a count; the first is named.
    """
    path = Path(path)
    try:
        rows = list(csv.reader(io.StringIO(path.read_text(encoding="utf-8-sig")), strict=True))
    except OSError as error:
        raise DataError(f"Expected a file of counts at {path}, actual none: {error.strerror}.") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise DataError(f"Expected a CSV file in UTF-8, actual {path}: {error}.") from error
    header = [name.strip() for name in rows[0]] if rows else []
    if sorted(header) != sorted(["image", *classes]):
        raise DataError(
            f"Expected the columns {','.join(['image', *classes])} in {path}, actual {','.join(header) or 'none'}."
        )
    known = {file.name for file in target.paths}
    left_out = {file.name for file in target.bad}
    found: dict[str, list[int]] = {}
    for number, fields in enumerate(rows[1:], 2):
        if not fields:
            continue
        where = f"in line {number} of {path}"
        if len(fields) != len(header):
            raise DataError(f"Expected {len(header)} fields {where}, actual {len(fields)}.")
        row = dict(zip(header, fields, strict=True))
        name = row["image"].strip()
        if name in left_out:
            continue
        if name not in known:
            raise DataError(f"Expected the name of an image in {target.path} {where}, actual {name!r}.")
        if name in found:
            raise DataError(f"Expected one row an image, actual a second one of {name} {where}.")
        found[name] = [_count(row[c], c, name, where) for c in classes]
    missing = [file.name for file in target.paths if file.name not in found]
    if missing:
        names = missing[0] + (f" and {len(missing) - 1} more" if len(missing) > 1 else "")
        raise DataError(f"Expected a row for every image of {target.path} in {path}, actual none for {names}.")
    return np.array([found[file.name] for file in target.paths], np.int64)


def write_counts(path: Path, names: list[str], counts: Counts, classes: tuple[str, ...]) -> None:
    """A ``counts.csv`` of ``counts (L, C)``, whole or not at all."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["image", *classes])
    writer.writerows([name, *row] for name, row in zip(names, counts.tolist(), strict=True))
    write_text(path, text.getvalue())


def counts_of_dataset(model: SceneModel, folder: Path) -> tuple[list[str], Counts]:
    """The file names and counts ``(L, C)`` of a dataset that this model drew, from its ``provenance.jsonl``."""
    names, rules = [], []
    with open(folder / "provenance.jsonl", encoding="utf-8") as file:
        for line in map(json.loads, file):
            names.append(Path(line["image"]).name)
            rules.append(line["rules"])
    padded = torch.full((len(rules), max(map(len, rules))), -1)
    for i, row in enumerate(rules):
        padded[i, : len(row)] = torch.tensor(row)
    return names, class_counts(model, Derivation.of(model.grammar, padded))


def class_counts(model: SceneModel, derivation: Derivation) -> Counts:
    """Objects of each of the model's classes in each scene, ``(N, C)``."""
    kinds = [model.grammar.kind(name) for name in model.classes]
    return derivation.counts(len(model.grammar.kinds))[:, kinds].numpy()


def _count(text: str, column: str, name: str, where: str) -> int:
    try:
        count = int(text)
    except ValueError:
        count = -1
    if count < 0:
        raise DataError(f"Expected a count of 0 or more for class {column!r} of {name} {where}, actual {text!r}.")
    return count
