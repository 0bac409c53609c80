"""The run folder: what ``fit`` writes and every other command reads.

    run.json               the configuration, the model, the target, the version that wrote it
    model.py               a copy of the model's file, where it is not a built-in one
    guide.safetensors      the learnt guide; there once the fit is finished
    features.safetensors   the feature network
    real.safetensors       features of the target images
    log.jsonl              one line an update
    checkpoint.safetensors what ``--resume`` goes on from

All are written aside and renamed.
"""

import hashlib
import json
import os
import shutil
from pathlib import Path
from typing import Any

import safetensors
import safetensors.torch
from torch import Tensor

from probscene.errors import DataError, ModelError, RunError
from probscene.inference.guides.base import Guide
from probscene.inference.guides.lstm import make_guide
from probscene.inference.guides.scenario import ScenarioGuide
from probscene.model import SceneModel

from ..files import make_folder, write_json, write_whole
from ..loading import BUILT_IN, lasting_reference, load_model, split_reference

FORMAT = 3  # of the run folder; another number is not read
KEYS = {"model", "model_sha256", "assets"}  # that create adds to every run.json


class Run:
    """A run folder.

    Attributes:
        path: the folder.
        record: the contents of ``run.json``.
    """

    def __init__(self, path: Path, record: dict[str, Any]):
        self.path, self.record = Path(path), record
        self._model: SceneModel | None = None

    @staticmethod
    def create(path: Path, model: str, record: dict[str, Any], assets: Path | None = None) -> "Run":
        """A new run folder; ``record`` is kept in ``run.json``.

        Args:
            assets: a folder that the model is drawn with, from now on whenever the run is opened.

        Raises:
            RunError: the folder holds a run or other files already.
            MachineError: it cannot be written.
        """
        path = Path(path)
        Run.check_free(path)
        words = load_model(model, assets).assets
        make_folder(path)
        reference, file = lasting_reference(model), split_reference(model)[0]
        digest = None if file in BUILT_IN else _sha256(Path(file))
        about = {"format": FORMAT, "model": reference, "model_sha256": digest, "assets": words}
        if assets is not None:
            about["assets_folder"] = os.path.abspath(assets)
        run = Run(path, record | about)
        write_json(path / "run.json", run.record)  # first: with it, what is interrupted here can be resumed
        if digest is not None:
            write_whole(path / "model.py", lambda temporary: shutil.copyfile(file, temporary))
        return run

    @staticmethod
    def check_free(path: Path) -> None:
        """See that a folder can become a run's; nothing is written.

        Raises:
            RunError: it holds a run or other files already.
            DataError: a file is in the way.
        """
        path = Path(path)
        if (path / "run.json").exists():
            raise RunError(f"Expected a new folder for the run, actual {path} holds one; add --resume or name another.")
        if path.exists() and not path.is_dir():
            raise DataError(f"Expected a folder for the run, actual {path} is a file; name another.")
        if path.is_dir() and any(not entry.name.startswith(".") for entry in path.iterdir()):
            raise RunError(f"Expected a new or empty folder for the run, actual {path} holds other files.")

    @staticmethod
    def open(path: Path) -> "Run":
        """An existing run folder.

        Raises:
            RunError: there is none, it is damaged, or another version wrote it.
        """
        path = Path(path)
        file = path / "run.json"
        if not file.is_file():
            raise RunError(f"Expected a run folder with a run.json, actual {path}; make one with 'probscene fit'.")
        try:
            record = json.loads(file.read_text(encoding="utf-8"))
            written = record["format"]
            if written == FORMAT and not KEYS <= record.keys():
                raise KeyError(*(KEYS - record.keys()))
        except (ValueError, KeyError, TypeError) as error:
            raise RunError(f"Expected JSON of a run in {file}, actual something else; fit again.") from error
        if written != FORMAT:
            raise RunError(
                f"Expected a run of format {FORMAT}, actual format {written} in {path}: another version of probscene "
                f"({record.get('version', 'unknown')}) wrote it. Use that version, or fit again."
            )
        return Run(path, record)

    @property
    def model(self) -> SceneModel:
        """The scene model, loaded once.

        Raises:
            RunError: the model's file is gone or has changed since the fit, or it draws with other assets.
        """
        if self._model is None:
            reference, digest = self.record["model"], self.record["model_sha256"]
            file = Path(split_reference(reference)[0])
            if digest is not None and (not file.is_file() or _sha256(file) != digest):
                raise RunError(
                    f"Expected the model file {file} as it was when {self.path} was fitted, actual a missing or "
                    f"changed file. A copy is in {self.path / 'model.py'}: put it back, or fit again."
                )
            model = load_model(reference, self.record.get("assets_folder"))
            if model.assets != self.record["assets"]:
                raise RunError(
                    f"Expected model {model.name} to draw with {self.record['assets'] or 'no assets'}, as when the run "
                    f"{self.path} was begun, actual {model.assets or 'no assets'}; put them back, or fit again."
                )
            self._model = model
        return self._model

    def new_guide(self) -> Guide:
        """An untrained guide of the kind and size that the run was begun with; one that names no kind has an LSTM."""
        settings = {"kind": "lstm", **self.record["guide"]}
        made = ScenarioGuide if self.model.scenarios else make_guide
        return made(grammar=self.model.grammar, max_steps=self.model.max_steps, **settings)

    def guide(self) -> Guide:
        """The learnt guide.

        Raises:
            RunError: the fit is not finished, or the file does not hold this run's guide.
        """
        tensors = self.load("guide")
        if tensors is None:
            raise RunError(f"Expected a finished fit in {self.path}, actual an unfinished one; go on with --resume.")
        guide = self.new_guide()
        try:
            guide.load_state_dict(tensors)
        except RuntimeError as error:
            raise RunError(f"Expected a guide for model {self.model.name} in {self.path}, actual another.") from error
        return guide.eval()

    def guide_hash(self) -> str:
        """SHA-256 of the learnt guide's file, hexadecimal; provenance names it."""
        return _sha256(self.path / "guide.safetensors")

    def load(self, name: str) -> dict[str, Tensor] | None:
        """The tensors of ``name.safetensors``, or None where there is no such file.

        Raises:
            RunError: the file is damaged.
        """
        file = self.path / f"{name}.safetensors"
        if not file.is_file():
            return None
        try:
            return safetensors.torch.load_file(file)
        except (safetensors.SafetensorError, OSError) as error:
            raise RunError(f"Expected tensors in {file}, actual a damaged file ({error}); delete it.") from error

    def save(self, name: str, tensors: dict[str, Tensor]) -> None:
        """Write ``name.safetensors``, whole or not at all."""
        # As bytes: safetensors' own writing says neither OSError nor why where the disk is full.
        whole = safetensors.torch.save({key: value.detach().contiguous() for key, value in tensors.items()})
        write_whole(self.path / f"{name}.safetensors", lambda temporary: temporary.write_bytes(whole))


def is_run(path: str) -> bool:
    """Whether a command's MODEL_OR_RUN names a run folder."""
    return path not in BUILT_IN and (Path(path) / "run.json").is_file()


def _sha256(path: Path) -> str:
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise ModelError(f"Could not read {path}: {error.strerror}.") from error
