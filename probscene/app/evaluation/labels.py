"""The truth that learnt structures are judged by; fitting never reads it. Three kinds:

``counts.csv``, how many objects of each class an image shows: the columns are ``image`` and the model's classes, in any
order; one row an image, in any order. A class that nobody has labelled has no column, and is not compared.

    image,0,1,2
    000000.png,0,2,1

``provenance.jsonl`` as ``generate`` writes it: one line an image with the rules of its structure, which says also what
hangs below what, and how likely a policy would have derived it.

A folder of KITTI's label files, see ``kitti_labels``.
"""

import csv
import io
import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from probscene.dataset import Images
from probscene.derivation import Derivation
from probscene.errors import DataError, GrammarError
from probscene.model import SceneModel

from ..datasets.kitti_labels import read_kitti
from ..files import write_text
from .structure_counts import Counts, StructureCounts, count

SEEN = "Prior and learnt scenes are rendered, and counted as labels count: by what can be seen."


class Labels(NamedTuple):
    """The truth of L images, in the order of their files.

    Attributes:
        structures: their counts ``(L, C)``, and the children of each node where whole structures are known.
        derivation: the structures themselves, where they are known.
        classes: the C that are labelled, in the model's order; all of the model's where None.
        notes: what a person should know, one sentence each.
        min_height: where objects are labelled that can be seen, and not all that a structure has: that of a box which
            is counted, pixels of the canvas.
    """

    structures: StructureCounts
    derivation: Derivation | None = None
    classes: tuple[str, ...] | None = None
    notes: tuple[str, ...] = ()
    min_height: float | None = None

    def columns(self, model: SceneModel) -> list[int]:
        """Of the model's classes, the C that are labelled, by number."""
        return [model.classes.index(name) for name in self.classes or model.classes]


def read_labels(
    path: Path, model: SceneModel, target: Images, some: bool = False, min_height: float = 0.0
) -> Labels:
    """The labels of a target's images, from a ``.jsonl`` of provenance, a CSV of counts or a folder of KITTI's labels.

    Rows of files that the target left out as bad are passed over.

    Args:
        some: there need not be one for every image; those without are left out.
        min_height: of an object's box that is counted, pixels of its image; a folder alone has boxes.

    Raises:
        DataError: see ``read_counts`` and ``read_kitti``; a line that is none of provenance, or whose rules are not the
            model's; a least height for what has no boxes.
    """
    if Path(path).is_dir():
        counts, classes, notes = read_kitti(Path(path), model, target, some, min_height)
        low = min_height * float(np.median(target.scales))
        return Labels(StructureCounts(counts, {}), classes=classes, notes=(SEEN, *notes), min_height=low)
    if min_height:
        raise DataError(f"Expected a folder of KITTI's labels for a least height of objects, actual the file {path}.")
    if Path(path).suffix != ".jsonl":
        classes = _labelled(Path(path), model.classes)
        return Labels(StructureCounts(read_counts(path, classes, target, some), {}), classes=classes)
    derivation = _read_derivations(Path(path), model, target, some)
    return Labels(count(model, derivation), derivation)


def _labelled(path: Path, classes: tuple[str, ...]) -> tuple[str, ...]:
    """The classes that have a column; all where none has, or a column is of something else."""
    header = {field.strip(' "\r') for field in _text(path).partition("\n")[0].split(",")}
    found = tuple(name for name in classes if name in header)
    return found if found and header == {"image", *found} else classes


def read_counts(path: Path, classes: tuple[str, ...], target: Images, some: bool = False) -> Counts:
    """The counts ``(L, C)`` of a target's images, in the order of its files.

    Rows of files that the target left out as bad are passed over; with ``some``, so are images without a row.

    Raises:
        DataError: no such file, other columns, a row of another length, an image that is not there, twice there or
            without a row, or what is not a count; the first is named.
    """
    path = Path(path)
    try:
        rows = list(csv.reader(io.StringIO(_text(path)), strict=True))
    except csv.Error as error:
        raise DataError(f"Expected a CSV file in UTF-8, actual {path}: {error}.") from error
    header = [name.strip() for name in rows[0]] if rows else []
    if sorted(header) != sorted(["image", *classes]):
        raise DataError(
            f"Expected the columns {','.join(['image', *classes])} in {path}, actual {','.join(header) or 'none'}."
        )
    named = _Named(path, target, some)
    for number, fields in enumerate(rows[1:], 2):
        if not fields:
            continue
        where = f"in line {number} of {path}"
        if len(fields) != len(header):
            raise DataError(f"Expected {len(header)} fields {where}, actual {len(fields)}.")
        row = dict(zip(header, fields, strict=True))
        name = row["image"].strip()
        if named.wanted(name, where):
            named.found[name] = [_count(row[c], c, name, where) for c in classes]
    return np.array(named.ordered(), np.int64)


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
    return names, count(model, Derivation.of(model.grammar, _padded(rules))).counts


class _Named:
    """What a file of labels says of a target's images, or of some, by name, each exactly once."""

    def __init__(self, path: Path, target: Images, some: bool):
        self.path, self.target, self.some = path, target, some
        self.known = {file.name for file in target.paths}
        self.left_out = {file.name for file in target.bad}
        self.found: dict[str, Any] = {}

    def wanted(self, name: str, where: str) -> bool:
        """Whether a row is of an image that is used."""
        if name in self.left_out:
            return False
        if name not in self.known:
            raise DataError(f"Expected the name of an image in {self.target.path} {where}, actual {name!r}.")
        if name in self.found:
            raise DataError(f"Expected one row an image, actual a second one of {name} {where}.")
        return True

    def ordered(self) -> list[Any]:
        """In the order of the target's files."""
        missing = [file.name for file in self.target.paths if file.name not in self.found]
        if missing and not (self.some and self.found):
            names = missing[0] + (f" and {len(missing) - 1} more" if len(missing) > 1 else "")
            raise DataError(
                f"Expected a row for every image of {self.target.path} in {self.path}, actual none for {names}"
                f"{'' if self.some else '; if only some are labelled, add --some-labels'}."
            )
        return [self.found[name] for name in self.names()]

    def names(self) -> list[str]:
        """Of the images that it is about, in the order of the target's files."""
        return [file.name for file in self.target.paths if file.name in self.found]


def _read_derivations(path: Path, model: SceneModel, target: Images, some: bool) -> Derivation:
    named = _Named(path, target, some)
    for number, text in enumerate(_text(path).split("\n"), 1):
        if not text.strip():
            continue
        where = f"in line {number} of {path}"
        try:
            line = json.loads(text)
            name, rules, spelt = Path(line["image"]).name, list(line["rules"]), line["derivation"]
        except (ValueError, KeyError, TypeError) as error:
            about = f"{type(error).__name__}: {error}"
            raise DataError(
                f"Expected image, rules and derivation {where}, actual something else ({about})."
            ) from error
        if named.wanted(name, where):
            named.found[name] = _rules(model, rules, spelt, where)
    rules = named.ordered()
    try:
        derivation = Derivation.of(model.grammar, _padded(rules))
        whole = derivation.complete.all()
    except GrammarError:
        whole = False
    if not whole:
        names = (name for name, row in zip(named.names(), rules, strict=True) if not _is_whole(model, row))
        raise DataError(f"Expected structures of model {model.name!r} in {path}, actual another of {next(names)}.")
    return derivation


def _rules(model: SceneModel, rules: list[Any], spelt: str, where: str) -> list[int]:
    """The rules of one structure, seen to be the model's."""
    known = model.grammar.rules
    own = rules and all(type(rule) is int and 0 <= rule < len(known) for rule in rules)
    if not own or "; ".join(str(known[rule]) for rule in rules) != spelt:
        raise DataError(f"Expected rules of model {model.name!r} {where}, actual those of another grammar.")
    return rules


def _is_whole(model: SceneModel, rules: list[int]) -> bool:
    try:
        return bool(Derivation.of(model.grammar, _padded([rules])).complete.all())
    except GrammarError:
        return False


def _padded(rules: Iterable[list[int]]) -> torch.Tensor:
    """``(L, T)`` int64, -1 pads."""
    rows = [torch.tensor(row, dtype=torch.int64) for row in rules]
    return torch.nn.utils.rnn.pad_sequence(rows, batch_first=True, padding_value=-1)


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise DataError(f"Expected a file of labels at {path}, actual none: {error.strerror}.") from error
    except UnicodeDecodeError as error:
        raise DataError(f"Expected a text file in UTF-8, actual {path}: {error}.") from error


def _count(text: str, column: str, name: str, where: str) -> int:
    if not re.fullmatch(r"\s*\+?[0-9]{1,9}\s*", text):
        raise DataError(
            f"Expected a count of 0 or more for class {column!r} of {name} {where}, actual {text!r}; write a whole "
            "number."
        )
    return int(text)
