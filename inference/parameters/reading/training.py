"""Training a ``Reader`` on renders, whose labels and values come free.

Axis letters: N images, M nodes, S sites.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from probscene.sampling import seed_everything

from ...features.base import Examples
from ...features.counting.batches import STRIDE as CELL
from ...features.counting.batches import cells, shares
from ...training import Report, batch_seed, check_finite, restore_training, training_state
from .reader import STRIDE, Reader, value_loss

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


class ReaderTraining:
    """Resumable training.

    Args:
        reader: trained in place.
        draw: so many valued renders.
        steps: of AdamW, along a cosine.
        images: a step.
        learning_rate: the largest.
        seed: of everything random.

    Attributes:
        unit, total, done: see ``Training``.
    """

    unit = "steps"

    def __init__(
        self,
        reader: Reader,
        draw: Callable[[int], Valued],
        steps: int = 1000,
        images: int = 12,
        learning_rate: float = 4e-3,
        seed: int = 0,
    ):
        self.reader, self.draw, self.total, self.images = reader, draw, steps, images
        self.seed, self.done = seed, 0
        trained = [*reader.fine.parameters(), *reader.coarse.parameters()]
        rest = [parameter for parameter in reader.parameters() if not any(parameter is other for other in trained)]
        self.rates = KEPT * learning_rate, learning_rate
        groups = [{"params": some, "lr": rate} for some, rate in zip((trained, rest), self.rates, strict=True)]
        self.optimiser = torch.optim.AdamW(groups, betas=(0.9, 0.99), weight_decay=1e-3)

    def run(self, each: Report | None = None) -> None:
        """Take the steps that are left; ``each`` hears the mean loss after every tenth.

        Raises:
            ProbsceneError: the loss is no longer finite.
        """
        self.reader.train()
        losses = []
        while self.done < self.total:
            seed_everything(batch_seed(self.seed, self.done))
            losses.append(self._step(self.draw(self.images)))
            self.done += 1
            if self.done % 10 == 0 or self.done == self.total:
                loss, losses = sum(losses) / len(losses), []
                where = f"at step {self.done}"
                check_finite(loss, self.reader.parameters(), "the reader", where, "begin again with a lower rate")
                if each is not None:
                    each(self, {"loss": loss})
        self.reader.eval()

    def summary(self) -> dict[str, Any]:
        """Nothing more for the log."""
        return {}

    def state(self) -> dict[str, Tensor]:
        """All that ``restore`` needs, as named tensors."""
        return training_state(self.reader, {"adam": self.optimiser}, done=self.done)

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Go on from a ``state``."""
        self.done = int(restore_training(self.reader, {"adam": self.optimiser}, tensors)["done"])

    def _step(self, valued: Valued) -> float:
        progress = self.done / self.total
        factor = min(1.0, (self.done + 1) / 30) * 0.5 * (1 + math.cos(math.pi * progress))
        for group, rate in zip(self.optimiser.param_groups, self.rates, strict=True):
            group["lr"] = rate * factor
        loss = reader_loss(self.reader, valued)
        self.optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.reader.parameters(), 5.0)
        self.optimiser.step()
        return loss.item()


def reader_loss(reader: Reader, valued: Valued) -> Tensor:
    """Cross-entropy of the cells, the error of where parents are, and of u, summed over an image's objects."""
    drawn, scale = valued.drawn, STRIDE * reader.reduce
    logits, parent, said, overall = reader(reader.enter(drawn.image))
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
