"""Counts from detections that another detector made in the target's images.

In photographs a class is counted by its detections from a score on. Renders are counted from their labels, with as many
objects missed and as many false finds as the detector has at that score (``calibration``), so that renders and
photographs are read alike. Axis letters: L images, N renders, M nodes, C classes, D features.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor, nn

from probscene.errors import DataError, ProbsceneError
from probscene.model import SceneModel

from ..base import Examples, FeatureNet, Features, ImageCallback, Photographs
from .calibration import calibrate

DETECTIONS = "detections"
MIN_VISIBLE = 0.25  # share of an object in a render that counts


@dataclass(frozen=True)
class DetectionFeatures(Features):
    """``DetectionNet``: nothing is trained. ``fit --readings FILE`` gives the detections."""

    name = DETECTIONS
    pretrained = True
    takes_labels = True
    takes_readings = True

    def build(self, model: SceneModel) -> FeatureNet:
        """Without detections yet."""
        return DetectionNet(model.classes)

    def adapt(self, net: FeatureNet, photographs: Callable[[], Photographs], callback: ImageCallback) -> dict[str, Any]:
        """Find from which score on each class counts, and count."""
        target, own = photographs(), cast("DetectionNet", net)
        found, labelled = target.detections, target.labelled
        if found is None:
            raise ProbsceneError("expected detections for features 'detections', got none; give --readings FILE.")
        records, readings = {}, calibrate(found, own.classes, labelled)
        own.counts = torch.zeros(found.images, len(own.classes))
        for c, (name, reading) in enumerate(zip(own.classes, readings, strict=True)):
            own.recall[c], own.false_finds[c], own.read[c] = reading.recall, reading.false_finds, reading.readable
            counts = found.counts(c, reading.min_score)
            own.counts[:, c] = torch.from_numpy(counts).float()
            records[name] = {
                **reading._asdict(),
                "error": None if np.isnan(reading.error) else reading.error,
                "visible": MIN_VISIBLE,
                "mean": float(counts.mean()),
            }
        own.bind(target.fingerprint)
        callback(found.images, found.images)
        return {"classes": records}

    def target_fingerprint(self, net: FeatureNet) -> str:
        """The images that the detections are of."""
        return cast("DetectionNet", net).bound_to

    def settings(self, config: Any) -> dict[str, Any]:
        """What is hidden in a drawing does not count, so that each structure is drawn once; parameters are learnt as of
        photographs."""
        return {"parameters": "tilting", "structure.draws_per_structure": 1}


class DetectionNet(nn.Module):
    """A ``FeatureNet`` that counts renders by their labels; in the target's images it knows the counts. Of several
    classes the last feature is the number of all their objects.

    Args:
        classes: of the model.

    Attributes:
        counts: ``(L, C)`` of the target's images.
        recall: ``(C,)``, see ``ClassReading``.
        false_finds: ``(C,)``, likewise.
        read: ``(C,)`` bool, which classes are compared; others are 0 everywhere.
        bound: fingerprint of the target, ``(32,)`` uint8.
    """

    uses_labels = True
    unit = 1.0
    counts: Tensor
    recall: Tensor
    false_finds: Tensor
    read: Tensor
    bound: Tensor

    def __init__(self, classes: tuple[str, ...]):
        super().__init__()
        self.classes = classes
        self.names = (*classes, "total") if len(classes) > 1 else classes
        C = len(classes)
        self.register_buffer("counts", torch.zeros(0, C))
        self.register_buffer("recall", torch.ones(C))
        self.register_buffer("false_finds", torch.zeros(C))
        self.register_buffer("read", torch.zeros(C, dtype=torch.bool))
        self.register_buffer("bound", torch.zeros(32, dtype=torch.uint8))

    def bind(self, fingerprint: str) -> None:
        """Say whose detections these are, in hexadecimal."""
        self.bound.copy_(torch.tensor(list(bytes.fromhex(fingerprint)), dtype=torch.uint8))

    @property
    def bound_to(self) -> str:
        """``bound`` in hexadecimal; empty for none."""
        return bytes(self.bound.tolist()).hex() if self.bound.any() else ""

    def embed_target(self, fingerprint: str) -> Tensor:
        """Features ``(L, D)`` of the target's images.

        Raises:
            DataError: they are others than those with the detections.
        """
        if fingerprint != self.bound_to:
            raise DataError(
                "expected the images that the run's detections are of, got others, whose objects nothing has found; "
                "compare by labels, or fit with detections of these images."
            )
        return self._with_total(self.counts)

    def embed(self, images: Tensor) -> Tensor:
        """Nothing: detections are known of the target's images alone.

        Raises:
            ProbsceneError: always.
        """
        raise ProbsceneError("expected labels of renders, got images; the run's detector is not at hand.")

    def embed_from_labels(self, drawn: Examples) -> Tensor:
        """Features ``(N, D)``, counts of what the detector would find. Which objects it misses goes by where they are,
        so that equal renders have equal features."""
        c = torch.arange(len(self.classes))
        there = (drawn.label.unsqueeze(-1) == c) & (drawn.visible >= MIN_VISIBLE).unsqueeze(-1)
        chance = _hashed(torch.cat([drawn.centre, drawn.size], -1))
        found = (there & (chance.unsqueeze(-1) < self.recall)).sum(1).float()
        of_image = _hashed(drawn.centre.sum(1).repeat(1, 2))
        return self._with_total(found + poisson_quantile(_spread(of_image, len(c)), self.false_finds.double()))

    def _with_total(self, counts: Tensor) -> Tensor:
        read = counts * self.read
        return torch.cat([read, read.sum(1, keepdim=True)], 1) if len(self.names) > len(self.classes) else read

    def _load_from_state_dict(self, state_dict: Any, prefix: str, *args: Any) -> None:
        self.counts = torch.zeros_like(state_dict[f"{prefix}counts"])  # L is the target's
        super()._load_from_state_dict(state_dict, prefix, *args)


def poisson_quantile(v: Tensor, mean: Tensor) -> Tensor:
    """``(N, C)`` the least numbers that a Poisson variable of ``mean (C,)`` exceeds with a probability of at most
    1 - ``v (N, C)``. (SciPy's statistics take a third of a second to import.)"""
    k = torch.arange(int(4 * mean.max()) + 20, dtype=torch.float64)
    cdf = torch.special.gammaincc(k + 1, mean.unsqueeze(-1).clamp(min=1e-12))  # (C, K)
    return (cdf < v.unsqueeze(-1)).sum(-1).float()


def _hashed(numbers: Tensor) -> Tensor:
    """``(...)`` uniform numbers that go by ``(..., 4)`` others."""
    bits = numbers.double().contiguous().view(torch.int64)
    mixed = torch.zeros(numbers.shape[:-1], dtype=torch.int64)
    for one in bits.unbind(-1):
        mixed = (mixed ^ one ^ (one >> 29)) * 0x5851F42D4C957F2D + 0x14057B7EF767814F  # a linear congruential step
        mixed = mixed ^ ((mixed >> 32) & 0xFFFFFFFF)
    return ((mixed >> 12) & 0xFFFFFFFFFFFF).double() / 2**48


def _spread(chance: Tensor, classes: int) -> Tensor:
    """``(N, C)`` uniform numbers of ``(N,)``, one a class."""
    return (chance.unsqueeze(-1) + torch.arange(classes) * 0.6180339887498949) % 1.0
