"""The names that labels have for images and classes, matched with files and with a model's classes.

Names match when they are the same, also where their letters are composed otherwise (Unicode's NFC and NFD), where one
has folders before it, and where only one of them has white space at its ends. Bytes that are no UTF-8 and line ends are
written as ``printable`` has them, and match as such.
"""

import re
import unicodedata
from collections import defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

from probscene.dataset import Images
from probscene.errors import DataError


class Entry(NamedTuple):
    """What labels say of one image.

    Attributes:
        name: of the image, with or without folders.
        where: it is in the labels, for messages.
    """

    name: str
    where: str


class Matched(NamedTuple):
    """Which entries are of which images.

    Attributes:
        entries: by the image's number, the number of its entry, in the order of the images.
        notes: what a person should know, one sentence each.
        others: names of entries that are of no image, with their places.
    """

    entries: dict[int, int]
    notes: tuple[str, ...] = ()
    others: tuple[Entry, ...] = ()


def matched(
    entries: Sequence[Entry], files: Sequence[Path], folder: Path, left_out: Iterable[Path] = (), stems: bool = False
) -> Matched:
    """Match entries with images, one to one. Those of no image are left out, which a note says.

    Args:
        folder: of the images, for messages.
        left_out: further images, whose entries are passed over.
        stems: names are without the ending of the image's file.

    Raises:
        DataError: an entry is of two images, or two are of one; or one is of no image, but of one without an entry
            but for case.
    """
    names, of_file = _Names(files, stems), defaultdict[int, list[int]](list)
    others = list[int]()
    for number, entry in enumerate(entries):
        found = names.lookup(entry.name)
        if len(found) > 1:
            raise DataError(
                f"expected the name of one image {entry.where}, got {entry.name!r}, which {len(found)} files in "
                f"{folder} have; give them different names."
            )
        if found:
            of_file[found[0]].append(number)
        else:
            others.append(number)
    chosen = dict[int, int]()
    for i, numbers in sorted(of_file.items()):
        alike = [_folders_alike(entries[number].name, files[i]) for number in numbers]
        best = [number for number, depth in zip(numbers, alike, strict=True) if depth == max(alike)]
        if len(best) > 1:
            raise DataError(
                f"expected one row an image, got a second one of {files[i].name} {entries[best[1]].where}; keep one "
                "of them."
            )
        chosen[i] = best[0]
        others += [number for number in numbers if number != best[0]]
    passed = _Names(list(left_out), stems)
    unknown = [entries[number] for number in sorted(others) if not passed.lookup(entries[number].name)]
    _check_case(unknown, [file for i, file in enumerate(files) if i not in chosen], folder, stems)
    more = f" and {len(unknown) - 1} more" if len(unknown) > 1 else ""
    shown = [f"{_last(entry.name)}.txt" if stems else entry.name for entry in unknown]
    notes = (f"Not read, since {folder} has no such image: {shown[0]}{more}.",) if shown else ()
    return Matched(chosen, notes, tuple(unknown))


def match_target(
    path: Path, entries: Sequence[Entry], target: Images, allow_missing: bool, stems: bool = False
) -> Matched:
    """Match entries with a target's images; those of files that the target left out as bad are passed over.

    Args:
        path: of the labels, for messages.
        allow_missing: there need not be an entry for every image.

    Raises:
        DataError: see ``matched``; an image without an entry, unless ``allow_missing``; none of any.
    """
    found = matched(entries, target.paths, target.path, target.bad, stems)
    missing = [file.name for i, file in enumerate(target.paths) if i not in found.entries]
    but = ""
    if found.others:
        entry, more = found.others[0], len(found.others) - 1
        but = f", but of {_last(entry.name)!r} {entry.where}{f' and {more} more' if more else ''}, which it has not"
    if not found.entries and (allow_missing or not missing):
        raise DataError(
            f"expected labels of images of {target.path} in {path}, got none{but}; label at least one, by the name "
            "of its file."
        )
    if missing and not allow_missing:
        names = missing[0] + (f" and {len(missing) - 1} more" if len(missing) > 1 else "")
        raise DataError(
            f"expected labels of every image of {target.path} in {path}, got none of {names}{but}; if only some are "
            "labelled, add --some-labels."
        )
    return found


def labelled_classes(
    names: Iterable[str], classes: tuple[str, ...], what: str, path: Path
) -> tuple[dict[str, str], tuple[str, ...]]:
    """By their names in a file of labels, the model's classes that it names, in the model's order, and notes on its
    other names.

    Args:
        names: of the file.
        what: of the file they are, with all that are expected, for messages.

    Raises:
        DataError: one is spelt a little differently from a class that is not named otherwise; or none is a class.
    """
    names = list(dict.fromkeys(names))
    own = {composed(name): name for name in classes}
    others = [name for name in names if composed(name) not in own]
    free = [name for name in classes if composed(name) not in map(composed, names)]
    for name in others:
        if near := next((other for other in free if _plain(other) == _plain(name)), None):
            raise DataError(
                f"expected {what} in {path}, got {name!r}; did you mean {near!r}? Write it as the model does."
            )
    found = {name: own[composed(name)] for name in names if composed(name) in own}
    if not found:
        raise DataError(
            f"expected {what} in {path}, got {', '.join(others) or 'none'}; give at least one by the model's name."
        )
    note = f"Not counted, since the model has no such class: {', '.join(others)}."
    return dict(sorted(found.items(), key=lambda pair: classes.index(pair[1]))), (note,) if others else ()


def printable(name: str) -> str:
    r"""A file's name as one line of UTF-8: a byte that is none, such as E9, becomes ``\udce9``, a line's end ``\r``."""
    return name.encode("utf-8", "backslashreplace").decode("utf-8").replace("\r", r"\r").replace("\n", r"\n")


class _Names:
    """Files by their names, as they are and as they match otherwise."""

    def __init__(self, files: Sequence[Path], stems: bool):
        self.files = files
        self.tables = [defaultdict[str, list[int]](list) for _ in range(3)]
        for i, file in enumerate(files):
            for table, key in zip(self.tables, _keys(file.stem if stems else file.name), strict=True):
                table[key].append(i)

    def lookup(self, name: str) -> list[int]:
        """The numbers of the files that a name may be of: of those that it is of by its last part, the ones whose
        folders are the most like its own."""
        for text in (name, _last(name)):
            for table, key in zip(self.tables, _keys(text), strict=True):
                if found := table.get(key):
                    alike = [_folders_alike(name, self.files[i]) for i in found]
                    return [i for i, depth in zip(found, alike, strict=True) if depth == max(alike)]
        return []


def _last(name: str) -> str:
    """The name of a file without its folders, of whatever system they are."""
    return re.split(r"[/\\]", name)[-1]


def _keys(name: str) -> tuple[str, str, str]:
    return name, composed(printable(name)), composed(printable(name.strip()))


def _folders_alike(name: str, file: Path) -> int:
    """How many folders, from the last one up, a name and a file have in common."""
    number = 0
    for one, other in zip(re.split(r"[/\\]", name)[-2::-1], file.parts[-2::-1], strict=False):
        if composed(one) != composed(other):
            break
        number += 1
    return number


def _check_case(unknown: Sequence[Entry], free: Sequence[Path], folder: Path, stems: bool) -> None:
    """See that no entry of no image is of one that has none, but for case."""
    near = {(file.stem if stems else file.name).casefold(): file for file in free}
    for entry in unknown:
        if file := near.get(_last(entry.name).casefold()):
            raise DataError(
                f"expected the name of an image in {folder} {entry.where}, got {entry.name!r}; did you mean "
                f"{file.name!r}?"
            )


def composed(name: str) -> str:
    """With letters and their accents as one character, where there is one."""
    return unicodedata.normalize("NFC", name)


def _plain(name: str) -> str:
    """Without case, what joins words, and an s at the end."""
    plain = re.sub(r"[\s_-]+", "", composed(name).casefold())
    return plain.removesuffix("s") or plain
