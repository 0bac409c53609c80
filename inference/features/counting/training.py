"""Features that count by a network of the fit's own, trained on prior renders with their free labels.

The loss is the cross-entropy of the cells and the squared error of the soft counts, and the error of the votes where
objects are counted by groups. What the steps look at is drawn ahead in a thread of its own: the network is so small
that it gains less from a second core than drawing does. Axis letters: N images.

Reference:
    [1] Jordan et al., *Muon: an optimizer for hidden layers in neural networks*, 2024.
"""

import math
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, field
from functools import partial
from itertools import chain

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from probscene.device import device_of
from probscene.model import SceneModel
from probscene.sampling import seed_everything
from probscene.threads import threads

from ...training import Callback, TrainingLoop, batch_seed
from ..base import Draw, Features, Photographs, Renders
from .batches import STEPS_A_DRAW, CountBatch, CountBatches, CountSchedule, Votes
from .muon import Muon
from .net import CountNet

WARMUP_STEPS, MAX_GRAD_NORM = 50, 5.0


@dataclass(frozen=True)
class CountFeatures(Features):
    """``CountNet``, trained on renders of the prior, or of what guides are pretrained on.

    Args:
        schedule: of its training.
        width, blocks: its size, see ``CountNet``.
    """

    schedule: CountSchedule = field(default_factory=CountSchedule)
    width: tuple[int, int, int] = (16, 32, 64)
    blocks: tuple[int, int] = (1, 1)

    name = "count"
    resolution = 0.5  # of a count

    @property
    def images(self) -> int:
        """See ``Features``; fewer of a canvas above 128 x 128 pixels."""
        return self.schedule.steps * self.schedule.images

    def build(self, model: SceneModel) -> CountNet:
        """Untrained."""
        rounding = self.schedule.rounding
        return CountNet(model.classes, model.channels, model.canvas, self.width, self.blocks, model.groups, rounding)

    def training(
        self, net: CountNet, renders: Renders, photographs: Callable[[], Photographs], seed: int
    ) -> "CountTraining":
        """On renders alone, reduced no more than the model's small objects bear."""
        seed_everything(0)  # how large objects are is the model's, and the same for all seeds
        net.fit_to(renders.object_size())
        draw = partial(renders.draw, beyond_prior=self.schedule.beyond_prior)
        return CountTraining(net, draw, self.schedule, seed=batch_seed(seed, 1))


class CountTraining(TrainingLoop):
    """Adam and Muon on the loss of ``count_loss`` and ``group_loss``.

    Args:
        net: trained in place.
        draw: labelled prior renders; called in another thread, the only one that draws random numbers meanwhile.
        schedule: how long and how.
        seed: of everything random.

    Attributes:
        unit, total, done: see ``Training``.
    """

    subject = "the count network"
    report_every = STEPS_A_DRAW

    def __init__(self, net: CountNet, draw: Draw, schedule: CountSchedule, seed: int = 0):
        self.net, self.schedule = net, schedule
        self.batches = CountBatches(net, draw, schedule, seed)
        self.left: Iterator[CountBatch] = iter(())
        # Muon [1] takes matrices: a second parameter over the storage of each convolution that batch norm follows.
        inner = [m.weight for m in net.modules() if isinstance(m, nn.Conv2d) and m.bias is None and m.in_channels > 3]
        self.matrices = [(weight, nn.Parameter(weight.detach().view(len(weight), -1))) for weight in inner]
        rest = [p for p in net.parameters() if not any(p is weight for weight in inner)]
        optimisers: dict[str, torch.optim.Optimizer] = {
            "adam": torch.optim.AdamW(rest, lr=schedule.learning_rate, betas=(0.9, 0.99), weight_decay=1e-3),
            "muon": Muon([matrix for _, matrix in self.matrices], lr=schedule.muon_rate, momentum=0.8),
        }
        super().__init__(net, optimisers, schedule.steps, seed)
        self.remedy = (
            f"begin again with lower rates, such as count.muon_rate={schedule.muon_rate / 4:g} and "
            f"count.learning_rate={schedule.learning_rate / 4:g}"
        )

    def run(self, callback: Callback | None = None) -> None:
        """See ``Training``; the callback is given the mean loss after every draw of batches."""
        self.net.train()
        # The next batches are drawn on another core meanwhile.
        with threads(1), closing(self.batches.after(self.done)) as draws:
            self.left = chain.from_iterable(draws)
            super().run(callback)
        self.net.eval()

    def seed_step(self) -> None:
        """Nothing: the thread that draws the batches seeds them, and steps draw no random numbers."""

    def step(self) -> float:
        """See ``TrainingLoop``."""
        batch = next(self.left).to(device_of(self.net))
        s = self.schedule
        factor = min(1.0, (self.done + 1) / WARMUP_STEPS) * 0.5 * (1 + math.cos(math.pi * self.done / s.steps))
        for optimiser, rate in zip(self.optimisers.values(), (s.learning_rate, s.muon_rate), strict=True):
            for group in optimiser.param_groups:
                group["lr"] = rate * factor
        number = batch.target.shape[1]
        logits = self.net(batch.image)
        loss = count_loss(logits[:, :number], batch.target, batch.margin, s.count_weight, s.relative)
        if batch.votes is not None and batch.group_cells is not None:
            loss = loss + s.group_weight * group_loss(logits[:, number:], batch.votes, batch.margin)
            self.net.group_cells.lerp_(batch.group_cells, max(0.01, 1 / (self.done + 1)))
        self.net.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(self.net.parameters(), MAX_GRAD_NORM)
        for weight, matrix in self.matrices:
            matrix.grad = None if weight.grad is None else weight.grad.view_as(matrix)
            with torch.no_grad():  # batch norm makes the scale free; fixed, the rate means the same all the way
                matrix.mul_(len(matrix) ** 0.5 / matrix.norm())
        for optimiser in self.optimisers.values():
            optimiser.step()
        return loss.item()


def count_loss(logits: Tensor, target: Tensor, margin: int, count_weight: float, relative: bool = False) -> Tensor:
    """Cross-entropy of the cells, summed over an image, and the squared error of its soft counts and their total.

    Args:
        logits, target: ``(N, 1 + classes, h, w)``.
        margin: cells at the border that do not count.
        relative: see ``CountSchedule``.
    """
    entropy, error, count = _errors(logits, target, margin)
    of_classes, of_total = error.square(), error.sum(1).square()
    if relative:
        of_classes, of_total = _relative(error, count), _relative(error.sum(1), count.sum(1))
    return (entropy + count_weight * (of_classes.sum(1) + of_total)).mean()


def relative_count_loss(logits: Tensor, target: Tensor) -> Tensor:
    """The relative ``count_loss`` without the total."""
    entropy, error, count = _errors(logits, target, 0)
    return (entropy + _relative(error, count).sum(1)).mean()


def _relative(error: Tensor, count: Tensor) -> Tensor:
    return error.square() / (1 + count)


def _errors(logits: Tensor, target: Tensor, margin: int) -> tuple[Tensor, Tensor, Tensor]:
    """Cross-entropy of the cells ``(N,)``, errors of the soft counts and the true counts, each ``(N, classes)``."""
    h, w = logits.shape[-2:]
    inner = (..., slice(margin, h - margin), slice(margin, w - margin))
    log_prob, target = F.log_softmax(logits[inner], 1), target[inner]
    error = (log_prob.exp() - target)[:, 1:].sum((2, 3))
    return -(target * log_prob).sum((1, 2, 3)), error, target[:, 1:].sum((2, 3))


def group_loss(votes: Tensor, target: Votes, margin: int) -> Tensor:
    """Cross-entropy of where groups are seen, and the absolute error, in cells, of the votes of what is seen and of
    objects; summed over an image.

    Args:
        votes: ``(N, 3, h, w)``: logit that a cell shows a group, its vote and its object's vote, see ``CountNet``.
        target: what the cells should vote for.
        margin: cells at the border that do not count.
    """
    h, w = votes.shape[-2:]
    inner = (..., slice(margin, h - margin), slice(margin, w - margin))
    logit, way, pull = votes[inner].unbind(1)
    shown, true_way, mass, true_pull = (x[inner] for x in target)
    entropy = F.binary_cross_entropy_with_logits(logit, shown, reduction="none")
    error = shown * (way - true_way).abs() + 4 * mass * (pull - true_pull).abs()
    return (entropy + error).sum((1, 2)).mean()
