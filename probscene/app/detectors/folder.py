"""A trained detector in a folder.

detector.json           what it is, what it was trained on, and how good it is on held-out photographs
detector.safetensors    its weights
detector.onnx           where it was asked for, see ``export``
"""

import hashlib
import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.torch
from numpy.typing import NDArray
from safetensors import SafetensorError
from torch import nn

from probscene.device import chosen_device
from probscene.errors import DataError

from ..trial.detector import build
from ..trial.training import Detections, detect_in

FORMAT = 1
RECORD, WEIGHTS, ONNX = "detector.json", "detector.safetensors", "detector.onnx"
SETTINGS = "training.json"  # of a training that is not finished
DEFAULT_MIN_SCORE = 0.3  # where no labelled photographs were held out


@dataclass(frozen=True)
class TrainedDetector:
    """A detector that ``train`` has trained; call it with an image ``(H, W, 3)`` uint8.

    Attributes:
        path: its folder.
        record: the contents of its ``detector.json``.
        device: where it computes, see ``chosen_device``.
    """

    path: Path
    record: dict[str, Any]
    device: str = "cpu"

    @classmethod
    def at(cls, path: Path | str, device: str = "cpu") -> "TrainedDetector":
        """The detector in a folder; its weights are read when it is first called.

        Raises:
            DataError: there is none, its training is not finished, it is damaged, or another version wrote it.
        """
        path = Path(path)
        file = path / RECORD
        if not file.is_file():
            begun = (path / SETTINGS).is_file()
            actual = "one whose training is not finished; give its command again" if begun else "no detector.json"
            remedy = "" if begun else "; name a folder that probscene train has written"
            raise DataError(f"expected a trained detector in {path}, got {actual}{remedy}.")
        try:
            record = json.loads(file.read_text(encoding="utf-8"))
            if (version := record["format"]) != FORMAT:
                raise DataError(
                    f"expected a detector of format {FORMAT} in {file}, got {version}; train it again, or install the "
                    "version of probscene that wrote it."
                )
            _ = record["classes"], record["size"][1], record["recipe"]["first_label"], record["weights_sha256"]
        except (ValueError, TypeError, KeyError, IndexError) as error:
            raise DataError(
                f"expected the record of a detector in {file}, got a damaged file; train it again."
            ) from error
        return cls(path, record, device)

    @property
    def classes(self) -> tuple[str, ...]:
        """Their names, in the order of the numbers in ``Detections``."""
        return tuple(self.record["classes"])

    @property
    def size(self) -> tuple[int, int]:
        """Height and width to which images are scaled, in their own shape."""
        height, width = self.record["size"]
        return height, width

    @property
    def value_range(self) -> tuple[float, float] | None:
        """Of images of 16 bits, see ``read_rgb``; None where it was trained on none."""
        found = self.record.get("value_range")
        return None if found is None else (found[0], found[1])

    @property
    def scores(self) -> dict[str, Any] | None:
        """How good it is on held-out photographs, see ``scores.record_of``; None where there were none."""
        return self.record.get("scores")

    @property
    def min_score(self) -> float | None:
        """The score from which on it makes fewest errors on held-out photographs; None where there were none, or where
        it found nothing in them."""
        return None if self.scores is None else self.scores["min_score"]

    @cached_property
    def network(self) -> nn.Module:
        """torchvision's detector, which takes a list of images ``(3, H, W)`` in 0..1.

        Raises:
            DataError: its weights are missing or damaged.
            ProbsceneError: see ``chosen_device``.
        """
        file, device = self.path / WEIGHTS, chosen_device(self.device)
        try:
            data = file.read_bytes()
            if hashlib.sha256(data).hexdigest() != self.record["weights_sha256"]:
                raise ValueError("bytes")
            network = build(self.record["detector"].partition("=")[0], len(self.classes), self.size)
            network.load_state_dict(safetensors.torch.load(data))
        except (OSError, ValueError, RuntimeError, SafetensorError) as error:
            actual = "none" if isinstance(error, FileNotFoundError) else "others, or a damaged file"
            raise DataError(
                f"expected the weights of the detector in {file}, got {actual}; put them back, or train it again in "
                "another folder."
            ) from error
        return network.eval().to(device)

    def __call__(self, image: NDArray[np.uint8]) -> Detections:
        return detect_in(self.network, image, self.size, self.record["recipe"]["first_label"])
