"""Photographs that a begun model's pictures were cut out of.

A model that was begun from labelled photographs is drawn with objects cut out of them, so what it generates shows them.
Beside such a model's file lies ``begun.json``:

    {"photographs": [{"name": "0001.jpg", "digest": "..."}, ...]}

with digests as ``sets.Example`` has them.
"""

import json
from pathlib import Path

from probscene.errors import DataError

from ..fitting.run import RunFolder
from ..loading import BUILT_IN, split_reference
from .plan import MAX_NAMED_IMAGES
from .sets import LabelledSet

FILE = "begun.json"


def model_file(source: RunFolder | str) -> Path | None:
    """The file of a model, or of the one that a run was begun with; None of one that is built in or in memory."""
    if isinstance(source, RunFolder):
        return None if "model" in source.objects else model_file(source.record["model"])
    name = split_reference(source)[0]
    return None if name in BUILT_IN else Path(name)


def check_not_cut_out(model: Path, tested: LabelledSet) -> None:
    """See that no test image is one that the model's pictures were cut out of; a model without ``begun.json`` beside
    its file has none.

    Args:
        model: its file.

    Raises:
        DataError: some are, or the file is damaged.
    """
    file = model.parent / FILE
    if not file.is_file():
        return
    try:
        names = {each["digest"]: each["name"] for each in json.loads(file.read_text(encoding="utf-8"))["photographs"]}
    except (ValueError, TypeError, KeyError) as error:
        raise DataError(
            f"expected the photographs that the model was begun from in {file}, got a damaged file; begin it again."
        ) from error
    both = [f"{e.path} is {names[e.digest]}" for e in tested.examples if e.digest in names]
    if both:
        more = f" and {len(both) - MAX_NAMED_IMAGES} more" if len(both) > MAX_NAMED_IMAGES else ""
        raise DataError(
            f"expected test images that the model {model} was not begun from, got {len(both)} that its pictures were "
            f"cut out of: {'; '.join(both[:MAX_NAMED_IMAGES])}{more}; test on others, by --test."
        )
