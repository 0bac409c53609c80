"""Training a ``Reader`` on renders, whose labels and values come free.

What is of nodes is learnt from renders that are seen once each: they have many nodes. What is of the scene, one value a
render, is learnt apart, from renders that are kept as the few numbers that it looks at, and seen many times. Axis
letters: N images, M nodes, S sites of nodes, G sites of scenes, E numbers.
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from probscene.device import device_of
from probscene.sampling import seed_everything

from ..features.base import Examples
from ..features.counting.batches import STRIDE as CELL
from ..features.counting.batches import cells, shares
from ..training import AdamTraining, batch_seed
from .global_head import NUM_FEATURES, GlobalHead, global_features
from .reader import Reader, value_loss
from .schedule import RENDERS_PER_STEP

MIN_VISIBLE = 0.25
PRETRAINED_RATE = 0.25  # of the rate, for parts that are pretrained
SCENE_IMAGES = 64  # of a step on sites of scenes
RENDERS_PER_DRAW, STEPS_PER_DRAW = 256, 64  # renders that are drawn at once; steps from then until the next are


class SupervisedBatch(NamedTuple):
    """Labelled renders and the values of their sites.

    Attributes:
        drawn: the labels, of what can be seen.
        kind: ``(N, M)`` int64 the grammar's kind of each node that has a class, -1 for none.
        parent: ``(N, M)`` int64 node index of the nearest parent that has a class, -1 for none.
        group: ``(N, M)`` int64 node index in the derivation of the parent, whether that has a class or not.
        u: ``(N, M, S)``, NaN where a node has none.
        scene_u: ``(N, G)`` of the scenes' sites.
    """

    drawn: Examples
    kind: Tensor
    parent: Tensor
    group: Tensor
    u: Tensor
    scene_u: Tensor

    def select(self, rows: slice) -> "SupervisedBatch":
        """Some of the scenes."""
        drawn = self.drawn._replace(**{name: part[rows] for name, part in self.drawn._asdict().items()})
        return SupervisedBatch(drawn, *(part[rows] for part in self[1:]))


class ReaderTraining(AdamTraining):
    """Resumable training.

    Args:
        reader: trained in place.
        draw: gives the valued renders of the next step, ``self.images``.
        steps: of AdamW.
        images: a step, at most; see ``Backbone.images_per_step``.
        learning_rate: the largest.
        seed: of everything random.
    """

    subject = "the reader"

    def __init__(
        self,
        reader: Reader,
        draw: Callable[[], SupervisedBatch],
        steps: int = 1000,
        images: int = 12,
        learning_rate: float = 4e-3,
        seed: int = 0,
    ):
        pretrained_parts = [parameter for part in reader.backbone.pretrained_parts for parameter in part.parameters()]
        rest = [
            parameter for parameter in reader.parameters() if not any(parameter is other for other in pretrained_parts)
        ]
        groups = [
            {"params": rest},
            *([{"params": pretrained_parts, "lr": PRETRAINED_RATE * learning_rate}] if pretrained_parts else []),
        ]
        adam = torch.optim.AdamW(groups, lr=learning_rate, betas=(0.9, 0.99), weight_decay=1e-3)
        super().__init__(reader, adam, steps, seed, warmup_steps=30)
        self.reader, self.draw, self.images = reader, draw, reader.backbone.images_per_step(images)

    def seed_step(self) -> None:
        """Nothing where steps draw no random numbers, as another thread draws renders by its own seeds meanwhile."""
        if self.reader.backbone.is_random:
            super().seed_step()

    def loss(self) -> Tensor:
        """See ``AdamTraining``."""
        return reader_loss(self.reader, self.draw())


class GlobalHeadTraining(AdamTraining):
    """Resumable training of an ``GlobalHead``. In its first half renders are drawn, from all of which it learns.

    Args:
        head: trained in place.
        draw: so many images as they enter, and the u of their scenes' sites ``(N, G)``, NaN where there is none.
        renders: in all.
        learning_rate: the largest.
        seed: of everything random.
    """

    subject = "the reader of scenes"

    def __init__(
        self,
        head: GlobalHead,
        draw: Callable[[int], tuple[Tensor, Tensor]],
        renders: int = 4096,
        learning_rate: float = 2e-3,
        seed: int = 0,
    ):
        adam = torch.optim.AdamW(head.parameters(), lr=learning_rate, weight_decay=1e-2)
        super().__init__(head, adam, -(-renders // RENDERS_PER_STEP), seed, warmup_steps=30)
        self.head, self.draw, self.drawn = head, draw, 0
        self.features, self.u = torch.empty(renders, NUM_FEATURES), torch.empty(renders, head.sites)

    def loss(self) -> Tensor:
        """See ``AdamTraining``."""
        number = min(len(self.u), RENDERS_PER_DRAW * (1 + self.done // STEPS_PER_DRAW))
        while self.drawn < number:  # a training that was resumed draws all of them again
            self._draw()
        self.seed_step()  # as where nothing was drawn
        rows, device = torch.randint(self.drawn, (SCENE_IMAGES,)), device_of(self.head)
        u = self.u[rows].to(device)
        loss = value_loss(self.head.from_features(self.features[rows].to(device)), u.nan_to_num(0.5))
        return loss.where(~u.isnan(), 0.0).sum(1).mean()

    @torch.no_grad()
    def _draw(self) -> None:
        seed_everything(batch_seed(self.seed, self.total, self.drawn))
        rows = slice(self.drawn, min(self.drawn + RENDERS_PER_DRAW, len(self.u)))
        images, self.u[rows] = self.draw(rows.stop - rows.start)
        self.features[rows] = global_features(images)
        if not self.drawn:
            self.head.fit_normalisation(self.features[rows])
        self.drawn = rows.stop


def reader_loss(reader: Reader, valued: SupervisedBatch) -> Tensor:
    """Cross-entropy of the cells, the error of where parents are, and of u, summed over an image's objects."""
    drawn, scale, device = valued.drawn, reader.backbone.cell, device_of(reader)
    seen, logits = reader(reader.backbone.enter(drawn.image.to(device)))
    h, w = logits.shape[-2:]
    label = drawn.label.masked_fill(drawn.visible < MIN_VISIBLE, -1)
    target = cells(drawn.centre / scale * CELL, label, reader.classes, h, w).to(device)
    entropy = -(target * F.log_softmax(logits, 1)).sum((1, 2, 3)).mean()
    parts = zip(*shares(drawn.centre / scale * CELL, label, h, w), strict=True)
    n, m, i, j, share = (torch.cat(part) for part in parts)
    u, above = valued.u[n, m].to(device), valued.parent[n, m]
    has, at = (above >= 0).float().to(device), (drawn.centre[n, above.clamp(min=0)] / scale).to(device)
    n, i, j, share = (part.to(device) for part in (n, i, j, share))
    parent, output = reader.values_at(seen, n, i, j)
    of_values = value_loss(output, u.nan_to_num(0.5)).where(~u.isnan(), 0.0)
    away = (torch.stack([j, i], -1) + 0.5 + parent - at).abs().clamp(max=20.0).sum(-1)
    of_nodes = (share * (of_values.sum(1) + has * away)).sum()
    return entropy + of_nodes / len(logits)
