"""Trained feature networks in the user's cache folder, so that the second fit of a model begins where the first one's
network was finished: with the same bytes, since a network is found under all that its training depends on."""

import hashlib
import json
import platform
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

import probscene
from probscene.cache import cache_folder
from probscene.errors import ProbsceneError, RunError
from probscene.inference.features.base import FeatureNet

from ..files import make_folder, write_text
from ..loading import assets_folder, folder_digest
from .plugins import IN_MEMORY
from .run import RunFolder
from .store import load_tensors, save_tensors, state_of


class Cached(NamedTuple):
    """A network that was kept.

    Attributes:
        tensors: its state.
        lines: of the log of its training.
    """

    tensors: dict[str, Tensor]
    lines: list[str]


class NetworkCache:
    """One run's place in the cache.

    Args:
        run: the run.
        net: its network, untrained.
        folder: of the cache; the user's where None.
        target: the fingerprint of the images that the network learns from; empty for none.
    """

    def __init__(self, run: RunFolder, net: FeatureNet, folder: Path | None = None, target: str = ""):
        self.folder = (cache_folder() if folder is None else Path(folder)) / "features"
        record = run.record
        own = run.config.words().get("features", "")
        # What is in memory alone may change from one fit to the next without a trace.
        self.usable = not any(word.startswith(IN_MEMORY) for word in (record["model"], own))
        about: dict[str, Any] = {
            "code": _code_digest(),
            "torch": torch.__version__,
            "machine": [platform.machine(), torch.backends.cpu.get_cpu_capability(), record["threads"]],
            **({"devices": [*map(_named, devices)]} if (devices := record.get("devices", ["cpu"])) != ["cpu"] else {}),
            "model": [record["model"], record["model_sha256"], record["assets"], list(run.model.canvas)],
            **({"modules": record["modules"]} if "modules" in record else {}),
            "assets": folder_digest(assets_folder(run.model, record.get("assets_folder"))),
            "features": own or repr(run.features),
            "weights": _digest(state_of(net)),
            "parts": record.get("parts", {}),
            "seed": record["seed"],
            "target": target,
        }
        self.key = hashlib.sha256(json.dumps(about, sort_keys=True).encode()).hexdigest()

    @property
    def file(self) -> Path:
        """Where the network is, or will be."""
        return self.folder / f"{self.key}.safetensors"

    def load(self) -> Cached | None:
        """A network that was kept; None where there is none, or where its files are damaged."""
        if not self.usable:
            return None
        try:
            digest, *lines = self._log.read_text(encoding="utf-8").splitlines()
            tensors = load_tensors(self.file)
        except (RunError, OSError, ValueError):
            return None
        return Cached(tensors, lines) if digest == json.dumps({"sha256": _digest(tensors, lines)}) else None

    def save(self, tensors: dict[str, Tensor], lines: list[str]) -> None:
        """Keep a network; where that cannot be, the fit goes on without."""
        if not self.usable or not tensors:
            return
        try:
            make_folder(self.folder)
            save_tensors(self.file, tensors)
            whole = [json.dumps({"sha256": _digest(tensors, lines)}), *lines]
            write_text(self._log, "".join(f"{line}\n" for line in whole))
        except ProbsceneError:
            return

    @property
    def _log(self) -> Path:
        """The log of the network's training, under a digest of both."""
        return self.file.with_suffix(".jsonl")


def _named(device: str) -> str:
    """A device with its processor, whose kind decides about bytes."""
    there = device.startswith("cuda") and torch.cuda.is_available()  # a run may have left the machine with its GPU
    return f"{device} {torch.cuda.get_device_name(device)}" if there else device


def _digest(tensors: dict[str, Tensor], lines: Sequence[str] = ()) -> str:
    """SHA-256 of tensors and lines, hexadecimal."""
    digest = hashlib.sha256("\n".join(lines).encode())
    for name, value in sorted(tensors.items()):
        digest.update(f"{name} {value.dtype} {tuple(value.shape)}".encode())
        digest.update(value.detach().cpu().contiguous().view(-1).view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()


@cache
def _code_digest() -> str:
    """Of the library's own source, so that no network of other code is taken."""
    digest = hashlib.sha256(probscene.__version__.encode())
    roots = [Path(entry) for entry in probscene.__path__]
    folders = {root / name for root in roots for name in ("models", "renderers", "inference")} | {roots[0]}
    for folder in sorted(folders):
        for file in sorted(folder.rglob("*.py")):
            digest.update(file.read_bytes())
    return digest.hexdigest()
