"""Errors inside a user's own program, raised with the user's file, line and source text, and with what to do.

A traceback is the user's where one of its frames lies in code that belongs neither to probscene nor to an installed
package; any other error is a bug of probscene and passes through as it is.
"""

import functools
import inspect
import linecache
import os
import re
import sys
import sysconfig
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple

from .errors import ModelError, ProbsceneError

MAX_MESSAGE_LENGTH = 320  # characters of another library's message that are shown
_INSTALLED = tuple({sysconfig.get_path(key) + os.sep for key in ("purelib", "platlib")})
_REMEDIES = {
    "Multiple sample sites named": "give each site a name of its own",
    "to satisfy the constraint": "keep the distribution's parameters in range; of a Uniform, low is below high",
    "to be within the support": "give the site values that its distribution can have",
    "inside plate(": "sites inside scene.nodes(...) are (scenes, nodes); their parameters have to broadcast to that",
    "collide at dim": "sample inside scene.nodes(...), with no plate of your own at dim=-1 or dim=-2",
}


class Place(NamedTuple):
    """A line of a user's. Attributes: its file, number, and text without indentation."""

    file: str
    line: int
    text: str

    def __str__(self) -> str:
        here = Path(self.file)
        if here.is_absolute() and here.is_relative_to(Path.cwd()):
            here = here.relative_to(Path.cwd())
        return f"{here}, line {self.line}" + (f", '{self.text}'" if self.text else "")


@contextmanager
def user_errors(what: str, program: Any = None) -> Iterator[None]:
    """Raise errors of the user's code as one ``ModelError``.

    Args:
        what: is run, in words, such as "the program of model 'tabletop'".
        program: the code that is run; lines of its own file are preferred to those of other files of the user's.

    Raises:
        ModelError: the user's code raised something else; with its own error, file, line, source text, and a remedy.
    """
    try:
        yield
    except (ProbsceneError, MemoryError):
        raise
    except Exception as error:
        place = user_place(error, source_file(program))
        if place is None:
            raise
        raise ModelError(
            f"expected {what} to run, got {type(error).__name__} in {place}: {useful_text(error)}; {remedy(error)}."
        ) from error


def user_place(error: BaseException, file: str | None = None) -> Place | None:
    """Where the user's code was when it failed: in ``file`` if a frame of the traceback lies there, else in the last
    frame outside probscene and installed packages; None if there is no such frame, or only probscene's own."""
    if isinstance(error, SyntaxError) and error.filename and error.lineno:
        return Place(error.filename, error.lineno, (error.text or "").strip())
    frames = [(f, line) for f, line in traceback.walk_tb(error.__traceback__) if not _is_library(f, file)]
    own = [(f, line) for f, line in frames if f.f_code.co_filename == file]
    if not frames:
        return None if error.__cause__ is None else user_place(error.__cause__, file)
    frame, line = (own or frames)[-1]
    source = frame.f_code.co_filename
    return Place(source, line, linecache.getline(source, line, frame.f_globals).strip())


def useful_text(error: BaseException) -> str:
    """The line of another library's message that says what is wrong: without Pyro's table of shapes and the dump of a
    tensor; it ends without a full stop."""
    text = error.msg if isinstance(error, SyntaxError) else str(error)
    text = re.split(r"\n *Trace Shapes:", text)[0]
    head, found, values = text.partition("but found invalid values:")
    if found:
        text = f"{head}but found {_short(values, 60)}"
    line = "; ".join(filter(None, map(str.strip, text.splitlines())))
    return _short(line, MAX_MESSAGE_LENGTH).rstrip(".") or "no message"


def remedy(error: BaseException) -> str:
    """What to do about an error of the user's code."""
    text = str(error)
    return next((what for part, what in _REMEDIES.items() if part in text), "fix that line")


def source_file(program: Any) -> str | None:
    """The file that a program's code lies in; None if it has none of its own."""
    program = getattr(program, "program", program)  # of a SceneModel
    program = getattr(program, "draw", program)  # of a SceneProgram
    while isinstance(program, functools.partial):
        program = program.func
    if not callable(program):
        return None
    program = inspect.unwrap(program)
    code = getattr(program, "__code__", None) or getattr(program.__call__, "__code__", None)
    return None if code is None else code.co_filename


def _is_library(frame: FrameType, file: str | None) -> bool:
    root = str(frame.f_globals.get("__name__", "")).partition(".")[0]
    source = frame.f_code.co_filename
    if root == "probscene" or source.startswith("<frozen"):
        return True
    return source != file and (root in sys.stdlib_module_names - {"__main__"} or source.startswith(_INSTALLED))


def _short(text: str, most: int) -> str:
    text = " ".join(text.split())
    return text if len(text) <= most else f"{text[:most]}..."
