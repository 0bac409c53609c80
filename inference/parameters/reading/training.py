"""Training a ``Reader`` on renders, whose labels and values come free.

Axis letters: N images, M nodes, S sites.
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from ...features.base import Examples
from ...features.counting.batches import STRIDE as CELL
from ...features.counting.batches import cells, shares
from ...steps import StepTraining
from .reader import Reader, value_loss

MIN_VISIBLE = 0.25
KEPT = 0.25  # of the rate, for convolutions that know the classes already


class Valued(NamedTuple):
    """Labelled renders and the values of their sites.

    Attributes:
        drawn: the labels.
        parent: ``(N, M)`` int64 node index of the nearest parent that has a class, -1 for none.
        group: ``(N, M)`` int64 node index in the derivation of the parent, whether that has a class or not.
        u: ``(N, M, S)``, NaN where a node has none.
        overall: ``(N, G)`` of the scenes' sites.
    """

    drawn: Examples
    parent: Tensor
    group: Tensor
    u: Tensor
    overall: Tensor

    def of(self, rows: slice) -> "Valued":
        """Some of the scenes."""
        drawn = self.drawn._replace(**{name: part[rows] for name, part in self.drawn._asdict().items()})
        return Valued(drawn, *(part[rows] for part in self[1:]))


class ReaderTraining(StepTraining):
    """Resumable training.

    Args:
        reader: trained in place.
        draw: so many valued renders.
        steps: of AdamW.
        images: a step.
        learning_rate: the largest.
        seed: of everything random.
    """

    what = "the reader"

    def __init__(
        self,
        reader: Reader,
        draw: Callable[[int], Valued],
        steps: int = 1000,
        images: int = 12,
        learning_rate: float = 4e-3,
        seed: int = 0,
    ):
        knowing = [parameter for part in reader.eye.knowing for parameter in part.parameters()]
        rest = [parameter for parameter in reader.parameters() if not any(parameter is other for other in knowing)]
        groups = [{"params": rest}, *([{"params": knowing, "lr": KEPT * learning_rate}] if knowing else [])]
        adam = torch.optim.AdamW(groups, lr=learning_rate, betas=(0.9, 0.99), weight_decay=1e-3)
        super().__init__(reader, adam, steps, seed, warming=30)
        self.reader, self.draw, self.images = reader, draw, images

    def loss(self) -> Tensor:
        """See ``StepTraining``."""
        return reader_loss(self.reader, self.draw(self.images))


def reader_loss(reader: Reader, valued: Valued) -> Tensor:
    """Cross-entropy of the cells, the error of where parents are, and of u, summed over an image's objects."""
    drawn, scale = valued.drawn, reader.eye.cell
    logits, parent, said, overall = reader(reader.eye.enter(drawn.image))
    h, w = logits.shape[-2:]
    label = drawn.label.masked_fill(drawn.visible < MIN_VISIBLE, -1)
    target = cells(drawn.centre / scale * CELL, label, reader.classes, h, w)
    entropy = -(target * F.log_softmax(logits, 1)).sum((1, 2, 3)).mean()
    parts = zip(*shares(drawn.centre / scale * CELL, label, h, w), strict=True)
    n, m, i, j, share = (torch.cat(part) for part in parts)
    u = valued.u[n, m]
    of_values = value_loss(said[n, :, :, i, j], u.nan_to_num(0.5)).where(~u.isnan(), 0.0)
    of_scene = value_loss(overall, valued.overall.nan_to_num(0.5)).where(~valued.overall.isnan(), 0.0)
    has = (valued.parent[n, m] >= 0).float()
    at = drawn.centre[n, valued.parent[n, m].clamp(min=0)] / scale
    away = (torch.stack([j, i], -1) + 0.5 + parent[n, :, i, j] - at).abs().clamp(max=20.0).sum(-1)
    of_nodes = (share * (of_values.sum(1) + has * away)).sum() + of_scene.sum()
    return entropy + of_nodes / len(logits)
