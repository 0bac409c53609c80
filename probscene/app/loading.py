"""MODEL on the command line: a built-in name, or the path of a Python file that exports a ``SceneModel``."""

import hashlib
import importlib
import importlib.util
import sys
import traceback
from pathlib import Path

from probscene.errors import ModelError, ProbsceneError
from probscene.model import SceneModel
from probscene.renderers.sprites import SpriteRenderer

BUILT_IN = {"multi_mnist": "probscene.models.multi_mnist", "aerial2d": "probscene.models.aerial2d"}


def load_model(reference: str) -> SceneModel:
    """The scene model that a name or a file gives.

    Raises:
        ModelError: no such name or file, a file that does not import, or one that exports none or several models.
    """
    if reference in BUILT_IN:
        return _exported(vars(importlib.import_module(BUILT_IN[reference])), reference)
    path = Path(reference)
    if path.suffix != ".py":
        raise ModelError(
            f"Expected a built-in model ({', '.join(BUILT_IN)}) or a path to a .py file, actual {reference!r}."
        )
    if not path.is_file():
        raise ModelError(f"Expected a model file, actual {reference!r}, which is not there.")
    name = "probscene_model_" + hashlib.sha256(str(path.resolve()).encode()).hexdigest()[:12]
    spec = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except ProbsceneError:
        raise
    except Exception as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        raise ModelError(
            f"Model file {reference} does not import: {type(error).__name__}: {error} "
            f"({Path(where.filename).name}, line {where.lineno}). Try 'python {reference}'."
        ) from error
    return _exported(vars(module), reference)


def renderer_for(model: SceneModel, threads: int | None = None) -> SpriteRenderer:
    """The renderer that reads the model's drawings; one thread for every core where no number is given."""
    return SpriteRenderer(model.canvas, threads)


def _exported(names: dict, reference: str) -> SceneModel:
    found = {name: value for name, value in names.items() if isinstance(value, SceneModel)}
    if "MODEL" in found:
        return found["MODEL"]
    if len({id(value) for value in found.values()}) != 1:
        raise ModelError(
            f"Expected {reference} to export one SceneModel, or one named MODEL, actual {sorted(found) or 'none'}."
        )
    return next(iter(found.values()))
