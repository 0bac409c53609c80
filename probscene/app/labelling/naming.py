"""The names that a file of labels has for images and classes, matched with the target's and the model's."""

import re
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from probscene.dataset import Images
from probscene.errors import DataError


class NamedImages:
    """What a file of labels says of a target's images, or of some, by name, each exactly once.

    Args:
        path: of the labels, for messages.
        some: there need not be labels of every image.

    Attributes:
        found: by name; the caller adds what it reads.
        unknown: names of images that have an entry but no usable label, such as a crowd: they are not missed.
    """

    def __init__(self, path: Path, target: Images, some: bool):
        self.path, self.target, self.some = path, target, some
        self.known = Counter(file.name for file in target.paths)
        self.left_out = {file.name for file in target.bad}
        self.found: dict[str, Any] = {}
        self.unknown: set[str] = set()

    def wanted(self, name: str, where: str) -> bool:
        """Whether an entry is of an image that is used; one of a file that the target left out as bad is not.

        Raises:
            DataError: it is of no image, of two, or of one that has an entry already.
        """
        if name in self.left_out and name not in self.known:
            return False
        if name not in self.known:
            near = _alike(name, self.known)
            raise DataError(
                f"Expected the name of an image in {self.target.path} {where}, actual {name!r}; "
                f"{f'did you mean {near!r}?' if near else 'mend the name, or leave the entry out.'}"
            )
        if self.known[name] > 1:
            raise DataError(
                f"Expected the name of one image {where}, actual {name!r}, which {self.known[name]} files of the "
                "target have; give them different names."
            )
        if name in self.found or name in self.unknown:
            raise DataError(f"Expected one row an image, actual a second one of {name} {where}; keep one of them.")
        return True

    def rows(self) -> list[int]:
        """The numbers of the images that it is about, in the order of the target's files.

        Raises:
            DataError: there are no labels of an image, and not only some are expected; none of any.
        """
        missing = [f.name for f in self.target.paths if f.name not in self.found and f.name not in self.unknown]
        if not self.found and (self.some or not missing):
            raise DataError(
                f"Expected labels of images of {self.target.path} in {self.path}, actual none; label at least one."
            )
        if missing and not self.some:
            names = missing[0] + (f" and {len(missing) - 1} more" if len(missing) > 1 else "")
            raise DataError(
                f"Expected labels of every image of {self.target.path} in {self.path}, actual none of {names}; if only "
                "some are labelled, add --some-labels."
            )
        return [i for i, file in enumerate(self.target.paths) if file.name in self.found]

    def ordered(self) -> list[Any]:
        """What was found, in the order of ``rows``."""
        return [self.found[self.target.paths[i].name] for i in self.rows()]


def labelled_classes(
    names: Iterable[str], classes: tuple[str, ...], what: str, path: Path
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The model's classes that a file of labels names, in the model's order, and notes on its other names.

    Args:
        names: of the file.
        what: of the file they are, with all that are expected, for messages.

    Raises:
        DataError: one is spelt a little differently from a class that is not named otherwise; or none is a class.
    """
    names = list(dict.fromkeys(names))
    others = [name for name in names if name not in classes]
    free = [name for name in classes if name not in names]
    for name in others:
        if near := _alike(name, free):
            raise DataError(
                f"Expected {what} in {path}, actual {name!r}; did you mean {near!r}? Write it as the model does."
            )
    found = tuple(name for name in classes if name in names)
    if not found:
        raise DataError(
            f"Expected {what} in {path}, actual {', '.join(others) or 'none'}; give at least one by the model's name."
        )
    note = f"Not counted, since the model has no such class: {', '.join(others)}."
    return found, (note,) if others else ()


def base_name(name: str) -> str:
    """The name of a file without its folders, of whatever system they are."""
    return re.split(r"[/\\]", name)[-1]


def _alike(name: str, others: Iterable[str]) -> str | None:
    """One that differs in case, in what joins its words or in an s at its end only."""
    return next((other for other in others if _plain(other) == _plain(name)), None)


def _plain(name: str) -> str:
    plain = re.sub(r"[\s_-]+", "", name.casefold())
    return plain.removesuffix("s") or plain
