"""Trained feature networks in the user's cache folder, so that the second fit of a model begins where the first one's
network was finished: with the same bytes, since a network is found under all that its training depends on."""

import hashlib
import json
import platform
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
from .parts import IN_MEMORY, is_file_part
from .run import RunFolder
from .storage import load_tensors, save_tensors


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
        words = (record["model"], record["preset"]["features"])
        # What is in memory alone may change from one fit to the next without a trace.
        self.usable = not any(word.startswith(IN_MEMORY) for word in words)
        about: dict[str, Any] = {
            "code": _code_digest(),
            "torch": torch.__version__,
            "machine": [platform.machine(), torch.backends.cpu.get_cpu_capability(), record["threads"]],
            "model": [record["model"], record["model_sha256"], record["assets"], list(run.model.canvas)],
            "features": [words[1], repr(run.features) if self.usable and not is_file_part(words[1]) else ""],
            "weights": bytes(getattr(net, "origin", torch.zeros(0, dtype=torch.uint8)).tolist()).hex(),
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
        log = self.file.with_suffix(".jsonl")
        if not self.usable or not self.file.is_file() or not log.is_file():
            return None
        try:
            return Cached(load_tensors(self.file), log.read_text(encoding="utf-8").splitlines())
        except (RunError, OSError, UnicodeDecodeError):
            return None

    def save(self, tensors: dict[str, Tensor], lines: list[str]) -> None:
        """Keep a network; where that cannot be, the fit goes on without."""
        if not self.usable or not tensors:
            return
        try:
            make_folder(self.folder)
            write_text(self.file.with_suffix(".jsonl"), "".join(f"{line}\n" for line in lines))
            save_tensors(self.file, tensors)
        except ProbsceneError:
            return


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
