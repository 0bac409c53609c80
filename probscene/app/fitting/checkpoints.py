"""Checkpoints of a training in a run folder, and the log that goes with them."""

import json
import time

from probscene.inference.training import Training

from ..files import write_text
from .storage import Storage

SAVE_EVERY = 5.0  # seconds between checkpoints: what an interruption can cost


class Keeper:
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
        stage = {"features": "features", "guide": "structure"}[name]
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
