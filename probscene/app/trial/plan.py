"""What a trial compares: rows, each of a name and what its detector is shown.

    NAME=PATH              a labelled set, see ``sets``
    NAME=PATH@LIST         those of its images whose names, without ending, are lines of a text file
    NAME=PATH:20           20 of its images, by chance; by the same seed, the first 20 of any greater number
    NAME=A,B               A, then B
    NAME=A+B               A and B, each half of the images that are shown

For a path may stand ``real``, the photographs that are not for testing, a source of a run, see ``GENERATED_SOURCES``,
or an earlier row's name, for what it has.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from probscene.errors import DataError, ProbsceneError

from ..labels.naming import composed
from .sets import Example, LabelledSet

REAL = "real"
MAX_NAMED_IMAGES = 5  # images in a message


class Part(NamedTuple):
    """A source, all of it or so many of its images."""

    source: str
    number: int | None = None


class Row(NamedTuple):
    """What one detector is shown: stages one after the other, each of parts that are shown in turn."""

    name: str
    stages: tuple[tuple[Part, ...], ...]

    @property
    def photographs(self) -> int | None:
        """How many, where it is shown ``REAL`` alone; -1 for all of them."""
        parts = [part for stage in self.stages for part in stage]
        if len(parts) > 1 or parts[0].source != REAL:
            return None
        return -1 if parts[0].number is None else parts[0].number

    def record(self) -> list[list[list[str | int | None]]]:
        """For JSON."""
        return [[list(part) for part in stage] for stage in self.stages]


class Plan(NamedTuple):
    """All rows, and by name the path of each source that is none of ``known``."""

    rows: tuple[Row, ...]
    paths: dict[str, Path]


def plan(sets: Mapping[str, str | Path], known: Iterable[str], numbers: Iterable[int | None] = ()) -> Plan:
    """Read what sets are said to be.

    Args:
        sets: what each row is shown, by its name.
        known: names of sources that are not paths; those of a run have a row each.
        numbers: of labelled photographs, with a row each; None for all.

    Raises:
        ProbsceneError: no row; two of one name; a number of images that is none; a name that cannot be a file's.
        DataError: neither a set nor a name.
    """
    known, rows, paths = tuple(known), {}, {}
    for number in numbers:
        part = Part(REAL, number)
        rows[f"{REAL} {'all' if number is None else number}"] = Row(_row_name(part), ((part,),))
    for name in known:
        if name != REAL:
            rows[name] = Row(name, ((Part(name),),))
    for name, text in sets.items():
        if name in rows or name in known:
            raise ProbsceneError(f"expected a name for each set of a trial, got {name!r} twice; rename one.")
        if not name or name.startswith(".") or any(letter in name for letter in '/\\:"\n'):
            raise ProbsceneError(f"expected a name that can be a file's for a set of a trial, got {name!r}.")
        rows[name] = Row(name, _stages(text, known, rows, paths))
    if not rows:
        raise ProbsceneError(
            "expected sets to compare, got none; give --set NAME=PATH, --run RUN or --real-numbers 10,20,50,all."
        )
    return Plan(tuple(rows.values()), paths)


def chosen(found: LabelledSet, part: Part, seed: int) -> tuple[Example, ...]:
    """A part's examples for a seed: the first of a permutation that is the seed's."""
    if part.number is None:
        return found.examples
    order = np.random.default_rng([seed, 10]).permutation(len(found.examples))
    return tuple(found.examples[i] for i in order[: part.number])


def only(found: LabelledSet, names: Path) -> LabelledSet:
    """Of the images whose stems a file lists.

    Raises:
        DataError: no such file, an empty one, or one that names an image that is not there.
    """
    try:
        stems = list(dict.fromkeys(names.read_text(encoding="utf-8").split()))
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"expected a text file of image names at {names}, got none to be read ({error}).") from error
    there = {composed(example.path.stem): example for example in found.examples}
    lacking = [stem for stem in stems if composed(stem) not in there]
    if lacking or not stems:
        actual = f"{lacking[0]!r}, which it has not" if lacking else "none"
        raise DataError(f"expected in {names} names of images of {found.path}, without ending, got {actual}.")
    return found._replace(examples=tuple(there[composed(stem)] for stem in stems))


def split(found: LabelledSet, number: int, seed: int) -> tuple[LabelledSet, LabelledSet]:
    """A set without so many of its images, nor others that are the same, but for empty scenes; and those images.

    Raises:
        ProbsceneError: it has not more than that.
    """
    total = len(found.examples)
    if not 0 < number < total:
        raise ProbsceneError(f"expected to hold out 1 to {total - 1} of the images of {found.path}, got {number}.")
    order = np.random.default_rng([seed, 30]).permutation(total)
    test = tuple(found.examples[i] for i in sorted(order[:number]))
    held = {example.digest for example in test if len(example.boxes)}
    rest = tuple(e for i, e in enumerate(found.examples) if i in order[number:] and e.digest not in held)
    return found._replace(examples=rest), found._replace(examples=test)


def list_of(path: Path) -> tuple[Path, Path | None]:
    """``PATH@LIST`` as its two, or the path alone."""
    before, at, after = str(path).rpartition("@")
    return (Path(before), Path(after)) if at and not path.exists() else (path, None)


def check(planned: Plan, loaded: Mapping[str, LabelledSet], tested: LabelledSet, later: set[str]) -> None:
    """See that every part has the images that are asked for, and that none of them is a test image.

    Args:
        later: sources that are generated only after that.

    Raises:
        DataError: one has fewer, or some of those that are tested on, by their pixels.
    """
    for row in planned.rows:
        for part in (part for stage in row.stages for part in stage):
            there = None if part.source in later else len(loaded[part.source].examples)
            if there is not None and (part.number or 0) > there:
                raise DataError(
                    f"expected at least {part.number} images in {part.source} for the set {row.name!r}, got {there}."
                )
    used = {part.source for row in planned.rows for stage in row.stages for part in stage}
    for name in sorted(used & loaded.keys()):
        check_apart(name, loaded[name], tested)


def check_apart(name: str, found: LabelledSet, tested: LabelledSet) -> None:
    """See that no image of a set is one that is tested on, by its pixels.

    Args:
        name: of the set, for the message.

    Raises:
        DataError: some are.
    """
    of_digest = {example.digest: example for example in tested.examples}
    both = [
        f"{e.path} is {of_digest[e.digest].path}"
        for e in found.examples
        if e.digest in of_digest and len(e.boxes) + len(of_digest[e.digest].boxes)  # empty scenes may be the same
    ]
    if both:
        more = f" and {len(both) - MAX_NAMED_IMAGES} more" if len(both) > MAX_NAMED_IMAGES else ""
        raise DataError(
            f"expected test images that are in no set, got {len(both)} in {name!r}: "
            f"{'; '.join(both[:MAX_NAMED_IMAGES])}{more}. Take them out of one of the two; for a part of "
            "one folder, name 'real' with --hold-out N."
        )


def baselines_of(planned: Plan, names: Iterable[str]) -> tuple[str, ...]:
    """The rows that others are compared with; the first where none is named.

    Raises:
        ProbsceneError: a name that no row has.
    """
    there = [row.name for row in planned.rows]
    chosen = tuple(names) or (there[0],)
    unknown = [name for name in chosen if name not in there]
    if unknown:
        raise ProbsceneError(f"expected a baseline among {', '.join(there)}, got {unknown[0]!r}.")
    return chosen


def _row_name(part: Part) -> str:
    return f"{REAL} {'all' if part.number is None else part.number}"


def _stages(
    text: str | Path, known: tuple[str, ...], rows: Mapping[str, Row], paths: dict[str, Path]
) -> tuple[tuple[Part, ...], ...]:
    if isinstance(text, Path) or Path(text).exists():
        return ((_path(str(text), paths),),)
    stages: list[tuple[Part, ...]] = []
    for words in text.split(","):
        found: list[tuple[tuple[Part, ...], ...]] = [
            _named(word.strip(), known, rows, paths) for word in words.split("+")
        ]
        if len(found) > 1 and any(len(of) > 1 for of in found):
            raise ProbsceneError(f"expected sets of one stage on both sides of +, got {words!r}.")
        stages += found[0] if len(found) == 1 else [tuple(part for of in found for part in of[0])]
    return tuple(stages)


def _named(
    word: str, known: tuple[str, ...], rows: Mapping[str, Row], paths: dict[str, Path]
) -> tuple[tuple[Part, ...], ...]:
    if word in rows:
        return rows[word].stages
    if word in known:
        return ((Part(word),),)
    if Path(word).exists():
        return ((_path(word, paths),),)
    before, colon, number = word.rpartition(":")
    if not colon:
        return ((_path(word, paths),),)
    if not number.isdecimal() or int(number) < 1:
        raise ProbsceneError(f"expected a positive number of images after the colon, got {word!r}.")
    if before in known:
        return ((Part(before, int(number)),),)
    return ((Part(_path(before, paths).source, int(number)),),)


def _path(word: str, paths: dict[str, Path]) -> Part:
    if not list_of(Path(word))[0].exists():
        raise DataError(
            f"expected a labelled set at {word!r}, got none; name a folder of COCO, KITTI or YOLO, a JSON file, an "
            "earlier row, or real, prior, start, structure, parameters or learnt where they are given."
        )
    paths[word] = Path(word)
    return Part(word)
