"""A run's files: what ``fit`` writes and every other command reads.

    run.json               the configuration, the model, the target, the version that wrote it
    model.py               a copy of the model's file, where it is not a built-in one
    model/                 the same under its own name with the modules that it imports from beside it, where it does
    guide.safetensors      the learnt guide; there once the fit is finished
    guide-first.safetensors
                           the guide before parameters were learnt, where they are
    parameters.json        which sites are learnt, and what was read of them
    features.safetensors   the feature network
    outcome.json           how far prior and learnt scenes are from the target, and which are kept
    real.safetensors       features of the target images
    readings.json          how each class is read, where features are suited to the target's images
    sources.json           which source trains the best detector, where that was asked for
    log.jsonl              one line an update
    checkpoint.safetensors what ``--resume`` goes on from

All are written aside and renamed.
"""

import json
import time
from pathlib import Path
from typing import Any

import safetensors
import safetensors.torch
from torch import Tensor, nn

from probscene.errors import DataError, RunError
from probscene.inference.features.base import FeatureNet
from probscene.inference.training import Training

from ..files import write_json, write_text, write_whole
from ..modules import file_digest
from .plugins import IN_MEMORY, inner

TIMING, OTHER = "timing.json", "other"  # OTHER: seconds of no stage
FORMAT, READABLE = 4, (3, 4)  # of the run folder, as it is written and as it can be read
READINGS, OUTCOME, PARAMETERS, SOURCES = "readings.json", "outcome.json", "parameters.json", "sources.json"
SAVE_EVERY = 5.0  # seconds between checkpoints: what an interruption can cost
KEYS = {"model", "model_sha256", "assets"}  # that every run.json has


class Storage:
    """The files of a run.

    Attributes:
        path: the folder.
        record: the contents of ``run.json``.
    """

    def __init__(self, path: Path, record: dict[str, Any]):
        self.path, self.record = Path(path), record

    def guide_hash(self) -> str:
        """SHA-256 of the learnt guide's file, hexadecimal; provenance names it."""
        return file_digest(self.path / "guide.safetensors")

    def visible_shares(self) -> dict[str, float]:
        """By class, how much of an object must be visible for labels to count it, 0 to 1; empty where nothing is known.

        Raises:
            RunError: ``readings.json`` is damaged.
        """
        try:
            found = self.readings["classes"] if self.readings else {}
            return {name: float(read["visible"]) for name, read in found.items() if "visible" in read}
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise RunError(
                f"expected what was read of each class in {self.path / READINGS}, got something else; fit again."
            ) from error

    @property
    def unread(self) -> tuple[str, ...]:
        """Classes that its features cannot count in the target's images."""
        return tuple(
            name for name, found in self.readings.get("classes", {}).items() if not found.get("readable", True)
        )

    @property
    def is_finished(self) -> bool:
        """Whether the guide is learnt."""
        return (self.path / "guide.safetensors").is_file()

    @property
    def objects(self) -> dict[str, str]:
        """Which of model, features, divergence and guide were in memory alone, and what each was called: the folder
        cannot give them back."""
        record, config, preset = self.record, self.record.get("config", {}), self.record.get("preset", {})
        parts = {"features": preset.get("features"), "divergence": preset.get("objective")}
        parts["guide"] = record.get("guide", {}).get("kind")
        parts = {"model": record.get("model")} | {name: (config or parts).get(name) for name in parts}
        words = {name: word for name, word in parts.items() if isinstance(word, str)}
        return {name: word[len(IN_MEMORY) :] for name, word in words.items() if word.startswith(IN_MEMORY)}

    @property
    def readings(self) -> dict[str, Any]:
        """What the features found when they were suited to the target's images, see ``Features.adapt``; empty where
        they are as they were trained."""
        return self._read_json(READINGS)

    def write_readings(self, found: dict[str, Any]) -> None:
        """Keep what ``readings`` gives."""
        write_json(self.path / READINGS, found)

    @property
    def outcome(self) -> dict[str, Any]:
        """How far prior and learnt scenes are from the target, and which are kept; empty for runs of earlier
        versions."""
        return self._read_json(OUTCOME)

    def write_outcome(self, found: dict[str, Any]) -> None:
        """Keep what ``outcome`` gives."""
        write_json(self.path / OUTCOME, found)

    @property
    def parameters(self) -> dict[str, Any]:
        """Which sites are learnt, how well each is read, and whether the learnt parameters are kept; empty where none
        were to be learnt."""
        return self._read_json(PARAMETERS)

    def write_parameters(self, found: dict[str, Any]) -> None:
        """Keep what ``parameters`` gives."""
        write_json(self.path / PARAMETERS, found)

    @property
    def sources(self) -> dict[str, Any]:
        """Which source trains the best detector, see ``detectors.source_comparison``; empty where that was not asked
        for."""
        return self._read_json(SOURCES)

    def write_sources(self, found: dict[str, Any]) -> None:
        """Keep what ``sources`` gives."""
        write_json(self.path / SOURCES, found)

    def _read_json(self, name: str) -> dict[str, Any]:
        file = self.path / name
        try:
            found = json.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}
            if not isinstance(found, dict):
                raise ValueError(type(found).__name__)
            return found
        except ValueError as error:
            raise RunError(f"expected JSON in {file}, got a damaged file ({error}); fit again.") from error

    def read_tensors(self, name: str) -> dict[str, Tensor] | None:
        """The tensors of ``name.safetensors``, or None where there is no such file.

        Raises:
            RunError: the file is damaged.
        """
        file = self.path / f"{name}.safetensors"
        return load_tensors(file) if file.is_file() else None

    def write_tensors(self, name: str, tensors: dict[str, Tensor]) -> None:
        """Write ``name.safetensors``, whole or not at all."""
        save_tensors(self.path / f"{name}.safetensors", tensors)


class Checkpointer:
    """Checkpoints of one training, at most every ``SAVE_EVERY`` seconds, with the lines of the log that belong to them.

    The log is written before the checkpoint, and lines past the checkpoint are dropped when a run goes on.
    """

    def __init__(self, run: Storage, name: str, training: Training):
        self.run, self.name, self.training = run, f"{name}-checkpoint", training
        self.log = run.path / "log.jsonl"
        self.lines = self.log.read_text(encoding="utf-8").splitlines() if self.log.exists() else []
        self.saved = time.monotonic()
        tensors = run.read_tensors(self.name)
        if tensors is not None:
            training.restore(tensors)
        stage = {"guide": "structure"}.get(name, name)
        self.lines = [line for line in self.lines if not self._is_past(json.loads(line), stage)]

    def __call__(self, line: dict[str, float | str] | None) -> None:
        """After some steps; ``line`` is what the log has of them, None for nothing."""
        if line is not None:
            self.lines.append(json.dumps(line))
        if time.monotonic() - self.saved > SAVE_EVERY:
            self._save()
            self.saved = time.monotonic()

    def finish(self) -> None:
        """Write the log to its end."""
        write_text(self.log, "".join(f"{line}\n" for line in self.lines))

    def _save(self) -> None:
        self.finish()
        self.run.write_tensors(self.name, self.training.state())

    def _is_past(self, line: dict, stage: str) -> bool:
        return line["stage"] == stage and line.get("step", line.get("batch", 0)) > self.training.done


def check_free(path: Path) -> None:
    """See that a folder can become a run's; nothing is written.

    Raises:
        RunError: it holds a run or other files already.
        DataError: a file is in the way.
    """
    path = Path(path)
    if (path / "run.json").exists():
        raise RunError(f"expected a new folder for the run, got {path} holds one; add --resume or name another.")
    if path.exists() and not path.is_dir():
        raise DataError(f"expected a folder for the run, got {path} is a file; name another.")
    if path.is_dir() and any(not entry.name.startswith(".") for entry in path.iterdir()):
        raise RunError(f"expected a new or empty folder for the run, got {path} holds other files.")


def read_record(path: Path) -> dict[str, Any]:
    """The contents of a run folder's ``run.json``.

    Raises:
        RunError: there is none, it is damaged, or another version wrote it.
    """
    file = path / "run.json"
    if not file.is_file():
        raise RunError(f"expected a run folder with a run.json, got {path}; make one with 'probscene fit'.")
    try:
        record = json.loads(file.read_text(encoding="utf-8"))
        written = record["format"]
        if written in READABLE and not KEYS <= record.keys():
            raise KeyError(*(KEYS - record.keys()))
    except (ValueError, KeyError, TypeError) as error:
        raise RunError(f"expected JSON of a run in {file}, got something else; fit again.") from error
    if written not in READABLE:
        raise RunError(
            f"expected a run of format {FORMAT}, got format {written} in {path}: another version of probscene "
            f"({record.get('version', 'unknown')}) wrote it. Use that version, or fit again."
        )
    return record


def load_tensors(file: Path) -> dict[str, Tensor]:
    """The tensors of a file.

    Raises:
        RunError: it is damaged.
    """
    try:
        return safetensors.torch.load(file.read_bytes())  # a file that is mapped cannot be replaced on Windows
    except (safetensors.SafetensorError, OSError) as error:
        raise RunError(f"expected tensors in {file}, got a damaged file ({error}); delete it.") from error


def save_tensors(file: Path, tensors: dict[str, Tensor]) -> None:
    """Write a file of tensors, whole or not at all."""
    # As bytes: safetensors' own writing says neither OSError nor why where the disk is full.
    whole = safetensors.torch.save({key: value.detach().cpu().contiguous() for key, value in tensors.items()})
    write_whole(file, lambda temporary: temporary.write_bytes(whole))


def state_of(net: FeatureNet) -> dict[str, Tensor]:
    """What a run keeps of a feature network: a module's state, of anything else nothing."""
    module = inner(net)
    return module.state_dict() if isinstance(module, nn.Module) else {}


def load_state(net: FeatureNet, tensors: dict[str, Tensor]) -> None:
    """The reverse of ``state_of``; the network is then ready for use.

    Raises:
        RunError: the state is another network's.
    """
    module = inner(net)
    if not isinstance(module, nn.Module):
        return
    try:
        module.load_state_dict(tensors)
    except RuntimeError as error:
        raise RunError(
            f"expected the state of a {type(module).__name__}, got another network's; put the features back as they "
            "were when the run was begun, or fit again."
        ) from error
    module.eval()


def timing(run: Storage) -> dict[str, float]:
    """Seconds by stage, as far as they are known."""
    try:
        seconds = json.loads((run.path / TIMING).read_text(encoding="utf-8"))
        return {"refinement" if stage == "structure-again" else stage: each for stage, each in seconds.items()}
    except (OSError, ValueError):
        return {}
