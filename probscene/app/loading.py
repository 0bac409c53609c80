"""MODEL on the command line: a built-in name, or the path of a Python file that exports a ``SceneModel``.

A file may export several models by name, ``SCENARIOS = {"city": ..., "rural": ...}``: ``streets.py`` is then all of
them joined into one (``scenarios.join``), ``streets.py:city,rural`` is these two, and ``streets.py:city`` is one model.
"""

import hashlib
import importlib
import os
import re
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import torch

from probscene.batch import RenderBatch, Renderer
from probscene.drawing import Drawing
from probscene.errors import ModelError, ProbsceneError, RunError
from probscene.generator import Command
from probscene.model import SceneModel
from probscene.render_check import check_renderer
from probscene.renderers.generator.renderer import GeneratedRenderer
from probscene.renderers.meshes import MeshRenderer
from probscene.renderers.sprites import SpriteRenderer
from probscene.request import Renderable, Request
from probscene.scenarios import join
from probscene.world import World

from .modules import import_file

BUILT_IN = {
    "multi_mnist": "probscene.models.multi_mnist",
    "small_digits": "probscene.models.small_digits",
    "aerial2d": "probscene.models.aerial2d",
    "driving": "probscene.models.driving",
    "driving_simple": "probscene.models.driving_simple",
}
_VARIABLE = re.compile(r" (\(PROBSCENE_\w+\)|of PROBSCENE_\w+)$")  # at the end of the words; "of" is of older runs


def load_model(reference: str, assets: Path | str | None = None) -> SceneModel:
    """The scene model that a name or a file gives.

    Args:
        assets: a folder of what it is to be drawn with; if None, that which the model's ``assets_variable`` names.

    Raises:
        ModelError: no such name or file, a file that does not import, one that exports none or several models, a
            scenario that it lacks, or one that does not draw with a folder.
        DataError: something in the folder cannot be used.
    """
    model = _loaded(reference)
    if assets is None:
        return _with_environment(model)
    if model.with_assets is None:
        raise ModelError(
            f"expected a model that can be drawn with a folder of assets, got {reference!r}, which has no "
            "with_assets; leave --assets out."
        )
    return model.with_assets(os.path.abspath(assets))


def _with_environment(model: SceneModel) -> SceneModel:
    """The model with the assets that an environment variable names, if it has one that is set."""
    folder = os.environ.get(model.assets_variable, "") if model.assets_variable else ""
    if not folder or model.with_assets is None:
        return model
    try:
        drawn = model.with_assets(os.path.abspath(folder))
    except ProbsceneError as error:
        raise type(error)(f"{error} The variable {model.assets_variable} names {folder}.") from error
    return replace(drawn, assets=f"{drawn.assets} ({model.assets_variable})")


def drawn_with(model: SceneModel) -> str:
    """What a model draws with beside its own code, in words: its assets, and what its generator's command is made of.

    Raises:
        DataError: a file of the generator's cannot be read.
    """
    return "; ".join(filter(None, (model.assets, _generator(model))))


def _generator(model: SceneModel) -> str:
    return model.generator.fingerprint() if isinstance(model.generator, Command) else ""


def same_assets(one: str, other: str) -> bool:
    """Whether two models draw with the same assets, by their words; ``--assets`` and an environment variable that name
    one folder give the same."""
    return _VARIABLE.sub("", one) == _VARIABLE.sub("", other)


def assets_folder(model: SceneModel, given: Path | str | None) -> str:
    """The folder that a model is drawn with: ``given``, or what an environment variable names; empty for none."""
    return os.fspath(given or os.environ.get(model.assets_variable or "", ""))


def assets_record(model: SceneModel, given: Path | str | None) -> dict[str, str]:
    """What ``run.json`` says of what a model draws with: ``assets``, words; of a folder ``assets_sha256``, see
    ``folder_digest``; and ``assets_folder``, its path, where it is ``given`` and no environment variable's.

    Raises:
        DataError: see ``drawn_with``.
    """
    record = {"assets": drawn_with(model)}
    if given is not None:
        record["assets_folder"] = os.path.abspath(given)
    if folder := assets_folder(model, given):
        record["assets_sha256"] = folder_digest(folder)
    return record


def recorded_model(record: dict[str, Any], run: Path) -> SceneModel:
    """The model of the run in a folder, drawn with what the run was begun with, see ``assets_record``: a folder that
    holds the same, wherever it lies by now. Runs of older versions have words alone, which name its place.

    Raises:
        RunError: it draws with something else, or its folder is gone.
        ProbsceneError: see ``load_model`` and ``drawn_with``.
    """
    elsewhere = f"Where they lie elsewhere by now, probscene fit --assets FOLDER --out {run} --resume tells the run so."
    given = record.get("assets_folder")
    if given is not None and not Path(given).exists():
        raise RunError(f"expected the assets of the run {run} in {given}, got nothing there. {elsewhere}")
    model = load_model(record["model"], given)
    found = assets_record(model, given)
    if not (drawn_alike(found, record) and record["assets"].endswith(_generator(model))):
        now = found["assets"]
        changed = now == record["assets"]
        hint = f" {elsewhere}" if "assets_sha256" in record and not changed else ""
        raise RunError(
            f"expected model {model.name} to draw with {record['assets'] or 'no assets'}, as when the run {run} was "
            f"begun, got {now or 'no assets'}{', changed since' * changed}; put them back, or fit again.{hint}"
        )
    return model


def drawn_alike(one: dict[str, Any], other: dict[str, Any]) -> bool:
    """Whether two runs of one model draw with the same, by their records: with folders that hold the same, wherever
    they lie, or by their words."""
    digests = one.get("assets_sha256"), other.get("assets_sha256")
    if None in digests:
        return same_assets(one["assets"], other["assets"])
    return digests[0] == digests[1]


def folder_digest(folder: str) -> str:
    """SHA-256 of the names and bytes in a folder, or of a file's bytes, hexadecimal; of nothing where there is none.

    Hidden files, such as a file manager leaves, are not in it.
    """
    digest, root = hashlib.sha256(), Path(folder)
    for file in sorted(path for path in (root, *root.rglob("*")) if path.is_file()) if folder else ():
        if file.name.startswith("."):
            continue
        digest.update(repr(file.relative_to(folder).parts).encode() + hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()


def _loaded(reference: str) -> SceneModel:
    base, scenarios = split_reference(reference)
    if base in BUILT_IN:
        return _exported(vars(importlib.import_module(BUILT_IN[base])), base, scenarios)
    if Path(base).suffix != ".py":
        raise ModelError(
            f"expected a built-in model ({', '.join(BUILT_IN)}) or a path to a .py file, got {reference!r}."
        )
    return _exported(vars(import_file(Path(base))), base, scenarios)


def split_reference(reference: str) -> tuple[str, tuple[str, ...]]:
    """The name or file of a reference, and the scenarios that it names, if any."""
    base, colon, names = str(reference).rpartition(":")
    if colon and (base in BUILT_IN or base.endswith(".py")):
        return base, tuple(name.strip() for name in names.split(","))
    return str(reference), ()


def with_scenarios(reference: str, names: str | None) -> str:
    """A reference that names scenarios, such as ``"a,b"``; as it is where None.

    Raises:
        ProbsceneError: it names some already.
    """
    if names is None:
        return reference
    if split_reference(reference)[1]:
        raise ProbsceneError(f"expected scenarios once, got {reference} and {names}; leave out --scenarios.")
    return f"{reference}:{names}"


def lasting_reference(reference: str) -> str:
    """A reference that means the same from every folder."""
    base, scenarios = split_reference(reference)
    if base not in BUILT_IN:
        base = str(Path(base).resolve())
    return f"{base}:{','.join(scenarios)}" if scenarios else base


class _AnyRenderer:
    """Sprites for a drawing, meshes for a world; each renderer is made when it is first needed."""

    def __init__(self, canvas: tuple[int, int], threads: int | None):
        self._options = canvas, threads

    def __call__(self, drawing: Renderable) -> RenderBatch:
        if isinstance(drawing, Request):
            raise ModelError(
                "expected a generator of a model whose program returns scene.request(...), got none; name what "
                "draws its scenes: scene_model(..., generator=Command([...]))."
            )
        return (self._meshes if isinstance(drawing, World) else self._sprites)(drawing)

    def labels(self, drawing: Renderable) -> RenderBatch:
        """The same; images may be black."""
        return self._sprites.labels(drawing) if isinstance(drawing, Drawing) else self(drawing)

    @cached_property
    def _sprites(self) -> SpriteRenderer:
        return SpriteRenderer(*self._options)

    @cached_property
    def _meshes(self) -> MeshRenderer:
        return MeshRenderer(*self._options)


class _OwnRenderer:
    """A model's own renderer; the first batch that it gives is checked."""

    def __init__(self, renderer: Renderer, canvas: tuple[int, int]):
        self._renderer, self._canvas, self._checked = renderer, canvas, False

    def __call__(self, drawing: Renderable) -> RenderBatch:
        batch = self._renderer(drawing)
        if not self._checked and len(drawing):
            check_renderer(self._renderer, drawing, self._canvas, batch)
            self._checked = True
        return batch._replace(image=batch.image.contiguous(memory_format=torch.channels_last))


def renderer_for(model: SceneModel, threads: int | None = None) -> Renderer:
    """The model's generator, or its own renderer, or the built-in one that reads what the model returns; one thread for
    every core where no number is given.

    Raises:
        ModelError: the model's own is none; when it is called, see ``check_renderer``.
    """
    if model.generator is not None:
        return GeneratedRenderer(model.generator, model.canvas, threads)
    if model.renderer is None:
        return _AnyRenderer(model.canvas, threads)
    renderer = model.renderer(model.canvas, threads)
    if not callable(renderer):
        raise ModelError(
            f"expected the renderer of model {model.name!r}, called with the canvas and a number of threads, to give "
            f"what can be called with a drawing, got {type(renderer).__name__}; see Renderer in probscene.batch."
        )
    return _OwnRenderer(renderer, model.canvas)


def _exported(names: dict, reference: str, wanted: tuple[str, ...] = ()) -> SceneModel:
    scenarios = names.get("SCENARIOS")
    if not isinstance(scenarios, dict) or not all(isinstance(model, SceneModel) for model in scenarios.values()):
        scenarios = {}
    if wanted or (scenarios and "MODEL" not in names):
        return _joined(scenarios, reference, wanted)
    found = {name: value for name, value in names.items() if isinstance(value, SceneModel)}
    if "MODEL" in found:
        return found["MODEL"]
    if len({id(value) for value in found.values()}) != 1:
        raise ModelError(
            f"expected {reference} to export one SceneModel, or one named MODEL, got {sorted(found) or 'none'}."
        )
    return next(iter(found.values()))


def _named(wanted: tuple[str, ...]) -> str:
    return ",".join(repr(name) if not name.isidentifier() else name for name in wanted)


def _joined(scenarios: dict[str, SceneModel], reference: str, wanted: tuple[str, ...]) -> SceneModel:
    if not scenarios:
        raise ModelError(
            f"expected SCENARIOS in {reference}, from which {_named(wanted)} are chosen, got none; name no scenarios."
        )
    unknown = [name for name in wanted if name not in scenarios]
    if unknown or len(set(wanted)) < len(wanted):
        raise ModelError(
            f"expected scenarios of {reference} among {', '.join(scenarios)}, each once, got {_named(wanted)}; name "
            "them with commas between, or none for all."
        )
    chosen = {name: scenarios[name] for name in wanted or scenarios}
    if len(chosen) == 1:
        return next(iter(chosen.values()))
    return join("-".join([Path(reference).stem, *wanted]), chosen)
