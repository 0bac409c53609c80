"""The truth that learnt structures are judged by. Three kinds:

``counts.csv``, how many objects of each class an image shows, see ``labels.counts``.

``provenance.jsonl`` as ``generate`` writes it: one line an image with the rules of its structure, which says also what
hangs below what, and how likely a policy would have derived it.

Labels with boxes of COCO, KITTI and YOLO, see ``labels.reading``.
"""

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from probscene.dataset import Images
from probscene.derivation import Derivation
from probscene.errors import DataError, GrammarError
from probscene.model import SceneModel

from ..labels.boxes import Boxes, read_boxes
from ..labels.counts import read_table
from ..labels.naming import Entry, match_target
from ..labels.reading import has_boxes
from ..labels.text import text_of
from .structure_counts import Counts, StructureCounts, count_structures

VISIBLE_NOTE = "Prior and learnt scenes are rendered, and counted as labels count: by what can be seen."


class Labels(NamedTuple):
    """The truth of L images, in the order of their files.

    Attributes:
        structures: their counts ``(L, C)``, and the children of each node where whole structures are known.
        derivation: the structures themselves, where they are known.
        classes: the C that are labelled, in the model's order; all of the model's where None.
        notes: what a person should know, one sentence each.
        min_height: where objects are labelled that can be seen, and not all that a structure has: that of a box which
            is counted, pixels of the canvas.
        rows: the numbers of the L images in the target; all of its images where None.
        boxes: of the objects, where labels have such and none is left out.
    """

    structures: StructureCounts
    derivation: Derivation | None = None
    classes: tuple[str, ...] | None = None
    notes: tuple[str, ...] = ()
    min_height: float | None = None
    rows: list[int] | None = None
    boxes: Boxes | None = None

    def columns(self, model: SceneModel) -> list[int]:
        """Of the model's classes, the C that are labelled, by number."""
        return [model.classes.index(name) for name in self.classes or model.classes]


@dataclass(frozen=True)
class TargetLabels:
    """Labels of a target's images, and how they are read.

    Args:
        source: a ``counts.csv``, COCO's ``.json``, ``provenance.jsonl``, KITTI's folder ``label_2`` or YOLO's
            ``labels``.
        some: they need not be of all images.
        min_height: of objects that labels with boxes count, pixels.
    """

    source: Path | str
    some: bool = False
    min_height: float = 0.0

    def read(self, model: SceneModel, target: Images) -> "Labels":
        """The labels, see ``read_labels``."""
        return read_labels(Path(self.source), model, target, self.some, self.min_height)


def read_labels(path: Path, model: SceneModel, target: Images, some: bool = False, min_height: float = 0.0) -> Labels:
    """The labels of a target's images, by the path's kind: a ``.jsonl`` of provenance, labels with boxes
    (``read_annotations``), else a CSV of counts.

    Entries of files that the target left out as bad are passed over, as are those of files that it has not, which the
    notes say.

    Args:
        some: there need not be one for every image; those without are left out.
        min_height: of an object's box that is counted, pixels of its image; for labels with boxes.

    Raises:
        DataError: see ``read_table`` and ``read_boxes``; a line that is none of provenance, or whose
            rules are not the model's; a least height for what has no boxes.
    """
    path = Path(path)
    if has_boxes(path):
        boxes = read_boxes(path, model, target, some, min_height)
        low = min_height * float(np.median(target.scales))
        counts, notes = StructureCounts(boxes.counts, {}), (VISIBLE_NOTE, *boxes.notes)
        whole = None if min_height else boxes
        return Labels(counts, None, boxes.classes, notes, low, boxes.rows, whole)
    if min_height:
        raise DataError(
            "expected labels with boxes (COCO's, KITTI's or YOLO's) for a least height of objects, got the file "
            f"{path}."
        )
    if path.suffix != ".jsonl":
        table = read_table(path, model.classes, target, some)
        return Labels(StructureCounts(table.counts, {}), classes=table.classes, notes=table.notes, rows=table.rows)
    return _read_derivations(path, model, target, some)


def counts_of_dataset(model: SceneModel, folder: Path) -> tuple[list[str], Counts]:
    """The file names and counts ``(L, C)`` of a dataset that this model drew, from its ``provenance.jsonl``."""
    names, rules = [], []
    with open(folder / "provenance.jsonl", encoding="utf-8") as file:
        for line in map(json.loads, file):
            names.append(Path(line["image"]).name)
            rules.append(line["rules"])
    return names, count_structures(model, Derivation.from_rules(model.grammar, _padded(rules))).counts


def _read_derivations(path: Path, model: SceneModel, target: Images, some: bool) -> Labels:
    entries, of_line = list[Entry](), list[tuple[list[Any], str]]()
    for number, text in enumerate(text_of(path).split("\n"), 1):
        if not text.strip():
            continue
        where = f"in line {number} of {path}"
        try:
            line = json.loads(text)
            entries.append(Entry(str(line["image"]), where))
            of_line.append((list(line["rules"]), line["derivation"]))
        except (ValueError, KeyError, TypeError) as error:
            about = f"{type(error).__name__}: {error}"
            raise DataError(f"expected image, rules and derivation {where}, got something else ({about}).") from error
    found = match_target(path, entries, target, some)
    rules = [_rules(model, *of_line[k], entries[k].where) for k in found.entries.values()]
    try:
        derivation = Derivation.from_rules(model.grammar, _padded(rules))
        whole = derivation.complete.all()
    except GrammarError:
        whole = False
    if not whole:
        names = (target.paths[i].name for i, row in zip(found.entries, rules, strict=True) if not _is_whole(model, row))
        raise DataError(f"expected structures of model {model.name!r} in {path}, got another of {next(names)}.")
    return Labels(count_structures(model, derivation), derivation, notes=found.notes, rows=list(found.entries))


def _rules(model: SceneModel, rules: list[Any], spelt: str, where: str) -> list[int]:
    """The rules of one structure, seen to be the model's."""
    known = model.grammar.rules
    own = rules and all(type(rule) is int and 0 <= rule < len(known) for rule in rules)
    if not own or "; ".join(str(known[rule]) for rule in rules) != spelt:
        raise DataError(f"expected rules of model {model.name!r} {where}, got those of another grammar.")
    return rules


def _is_whole(model: SceneModel, rules: list[int]) -> bool:
    try:
        return bool(Derivation.from_rules(model.grammar, _padded([rules])).complete.all())
    except GrammarError:
        return False


def _padded(rules: Iterable[list[int]]) -> torch.Tensor:
    """``(L, T)`` int64, -1 pads."""
    rows = [torch.tensor(row, dtype=torch.int64) for row in rules]
    return torch.nn.utils.rnn.pad_sequence(rows, batch_first=True, padding_value=-1)
