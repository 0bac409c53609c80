"""Python files of the user's, imported by path: models, and parts of a fit such as features or a guide."""

import hashlib
import importlib.util
import sys
from pathlib import Path
from traceback import walk_tb
from types import ModuleType

from probscene.errors import ModelError, ProbsceneError
from probscene.program_errors import useful_text, user_place

from .neighbours import PREFIX, neighbours, prepare


def line_of_user(error: BaseException) -> str | None:
    """The file and line of a user's own, last in the traceback of an error that it raised; None where it has none."""
    found = _place_of_user(error)
    return found and f"{found[0]}, line {found[1]}"


def _place_of_user(error: BaseException) -> tuple[str, int] | None:
    found = None
    for frame, line in walk_tb(error.__traceback__):
        if str(frame.f_globals.get("__name__", "")).startswith(PREFIX):
            found = frame.f_code.co_filename, line
    return found


def import_file(path: Path) -> ModuleType:
    """The module of a Python file, which may import what lies beside it; its name depends on the path alone.

    Raises:
        ModelError: no such file, or one that does not import: with its own error, line and source text.
    """
    path = Path(path)
    if not path.is_file():
        raise ModelError(f"expected a Python file, got {str(path)!r}, which is not there.")
    name = PREFIX + hashlib.sha256(str(path.resolve()).encode()).hexdigest()[:12]
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    prepare(module, path)
    try:
        spec.loader.exec_module(module)
    except ProbsceneError:
        raise
    except (Exception, SystemExit) as error:
        own = _place_of_user(error)
        place = user_place(error, str(path.absolute()) if own is None else own[0])
        where = f" ({Path(place.file).name}, line {place.line}: '{place.text}')" if place else ""
        what = f"{type(error).__name__}: {useful_text(error)}"
        raise ModelError(f"The file {path} does not import: {what}{where}. Try 'python {path}'.") from error
    return module


def file_digest(path: Path) -> str:
    """SHA-256 of a file, hexadecimal.

    Raises:
        ModelError: it cannot be read.
    """
    try:
        return hashlib.sha256(Path(path).read_bytes()).hexdigest()
    except OSError as error:
        raise ModelError(f"Could not read {path}: {error.strerror}.") from error


def module_digests(path: Path) -> dict[str, str]:
    """SHA-256 of each module that a file imports from beside it, by their path from its folder, see ``neighbours``.

    Raises:
        ModelError: one cannot be read.
    """
    return {name: file_digest(file) for name, file in neighbours(Path(path)).items()}
