"""Training ``PretrainedCountNet`` on renders with their free labels.

The frozen network sees each image once; its maps stay in memory as half-precision numbers, 0.2 MB an image of 320 x
240, and the heads take many epochs on them. Every render looks as a camera might have taken it (``looks``).
Photographs' maps are unlike renders' channel by channel, so the heads are kept from relying on any: channels are left
out and shifted at random (``head.KINDS``).

Then heads teach themselves [1], those of some ``KINDS``: what they read in the target's unlabelled images, every object
taken to a whole one, is what they learn to find there for one more epoch, beside the renders. How far heads are apart
is noted before, since they learn from their mean.

Axis letters: N images, L photographs, M nodes, C classes, S scopes.

References:
    [1] Xie et al., *Self-training with Noisy Student improves ImageNet classification*, CVPR 2020.
"""

import math
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor, nn

from probscene.sampling import seed_everything

from ...training import Callback, TrainingLoop, batch_seed
from ..base import Draw, Examples
from ..counting.batches import STRIDE, cells
from ..counting.training import relative_count_loss
from .augmentation import augment
from .net import KINDS, Kind, Maps, PretrainedCountNet
from .readability import disagreement
from .reading import SCOPES, SMALL

DRAWN_AT_ONCE = 32  # structures
PHOTOGRAPHS = 12  # a step
SLOWER = 0.4  # rate of the epoch with photographs, of the others'


class PretrainedCountTraining(TrainingLoop):
    """AdamW on the loss of ``relative_count_loss``; after an interruption the maps are computed again.

    Args:
        net: trained in place.
        draw_twice: labelled renders of so many structures, then as many of the same structures.
        pairs: structures.
        epochs: of the heads, on renders alone.
        batch_size, learning_rate: of AdamW, along a cosine.
        photographs: images of the target, ``(L, 1 or 3, H, W)`` uint8, for one more epoch; None for none.
        seed: of everything random.

    Attributes:
        unit, total, done: see ``Training``.
        correlation: of the counts with the true ones on renders that nothing was trained on, ``(C,)``, once it is
            finished; NaN where one of them does not vary.
    """

    unit = "epochs"
    subject = "the count heads"
    remedy = "begin again with features=count"
    seed_path = (1,)

    def __init__(
        self,
        net: PretrainedCountNet,
        draw_twice: Draw,
        pairs: int = 1000,
        epochs: int = 8,
        batch_size: int = 32,
        learning_rate: float = 5e-3,
        photographs: Tensor | None = None,
        seed: int = 0,
    ):
        some = () if photographs is None else photographs.split(2 * DRAWN_AT_ONCE)
        self.photographs = [part for part in some if len(part)]
        self.optimiser = torch.optim.AdamW(net.heads.parameters(), lr=learning_rate, weight_decay=5e-2)
        super().__init__(net, {"adam": self.optimiser}, epochs + (len(self.photographs) > 0), seed)
        self.net, self.draw_twice, self.pairs, self.epochs = net, draw_twice, pairs, epochs
        self.batch_size, self.learning_rate = batch_size, learning_rate
        self.correlation: Tensor | None = None
        self.maps: Maps = []
        self.targets: list[Tensor] = []
        self.photograph_maps: Maps | None = None

    def run(self, callback: Callback | None = None) -> None:
        """See ``Training``; the callback is first given how many ``images`` are embedded, and ``of`` how many."""
        maps, targets, true_counts, sizes = self._embed_renders(callback)
        n = 2 * self.pairs
        self.maps, self.targets = ([part[:n] for part in some] for some in (maps, targets))
        if self.photographs and not self.finished:
            self.photograph_maps = self._embed_photographs(callback)
        if self.done == 0:
            some = slice(0, n, max(1, n // 512))
            self.net.initialise([part[some] for part in maps], [target[some] for target in targets])
        super().run(callback)
        self.maps, self.targets, self.photograph_maps = [], [], None
        self.net.eval()
        held_out = [part[n:] for part in maps]
        median = torch.stack([some.median() if len(some) else torch.tensor(math.inf) for some in sizes])
        self.net.calibrate(self.net.readings(held_out)[0], true_counts[n:], median)
        scope, rule, classes = self.net.scope, self.net.rules[0].int().argmax(1), torch.arange(len(self.net.scope))
        predicted, known = self.net.held_read[:, scope, rule, classes], self.net.held_true[:, scope, classes]
        each_class = zip(predicted.T, known.T, strict=True)
        self.correlation = torch.stack([torch.corrcoef(torch.stack(pair))[0, 1] for pair in each_class])

    def step(self) -> float:
        """An epoch; the last one with photographs, where there are some."""
        photographs = None
        if self.done == self.epochs and self.photograph_maps is not None:
            self.net.eval()
            self.net.apart.copy_(disagreement(self.net.readings(self.photograph_maps)[1]))
            photographs = self.photograph_maps, [part.half() for part in self._pseudo_labels(self.photograph_maps)]
        self.net.train()
        batches = torch.randperm(2 * self.pairs).split(self.batch_size)
        losses = [self._update(rows, i / len(batches), photographs) for i, rows in enumerate(batches)]
        return sum(losses) / len(losses)

    def summary(self) -> dict[str, Any]:
        """For the log: how well objects are counted in renders."""
        if self.correlation is None:
            return {}
        return {"stage": "counts", "correlation": [x if x == x else None for x in self.correlation.tolist()]}

    @property
    def _structures(self) -> int:
        """That are drawn twice, those of renders that are held out among them."""
        return self.pairs + (len(self.net.held_true) + 1) // 2

    @property
    def _images(self) -> int:
        """That are embedded."""
        return 2 * self._structures + sum(map(len, self.photographs))

    def _embed_renders(self, callback: Callback | None) -> tuple[Maps, list[Tensor], Tensor, list[Tensor]]:
        """Of renders: maps, float16, what the places of each of ``KINDS`` should hold ``(N, its scopes, 1 + C, h, w)``
        float16 and the true counts ``(N, S, C)``, of what is trained on and then of what is held out. Of each class the
        sizes of its objects, pixels of what enters."""
        seed_everything(batch_seed(self.seed, 0))
        rng = np.random.default_rng(batch_seed(self.seed, 2))
        total = self._structures
        parts, sizes, done = [], [[] for _ in self.net.classes], 0
        while done < total:
            number = min(DRAWN_AT_ONCE, total - done, self.pairs - done if done < self.pairs else total)
            drawn = self.draw_twice(number)
            maps = self.net.compute_maps(augment(drawn.image, rng))
            targets = [self._target(drawn, kind).half() for kind in KINDS]
            parts.append([*(some.half().cpu() for some in maps), *targets, self.net.true_counts(drawn)])
            shown = drawn.label.masked_fill(drawn.visible < SCOPES[SMALL].visible, -1)
            for c, of_class in enumerate(sizes):
                of_class.append(self.net.spans(drawn)[shown == c])
            done += number
            if callback is not None:
                callback(self, {"images": 2 * done, "of": self._images})
        last = 2 * self.pairs + len(self.net.held_true)
        *both, true = (torch.cat(column)[:last] for column in zip(*parts, strict=True))
        return both[: -len(KINDS)], both[-len(KINDS) :], true, [torch.cat(of_class) for of_class in sizes]

    def _target(self, drawn: Examples, kind: Kind) -> Tensor:
        """What the places should hold, ``(N, the kind's scopes, 1 + C, h, w)``."""
        places = drawn.centre * self.net.scale() / kind.stride
        size, number = self.net.places(kind.stride), len(self.net.classes)
        return torch.stack(
            [cells(places * STRIDE, self.net.counted_labels(drawn, SCOPES[s]), number, *size) for s in kind.scopes], 1
        )

    def _embed_photographs(self, callback: Callback | None) -> Maps:
        """Maps, float16."""
        parts, done = [], 2 * self._structures
        for some in self.photographs:
            parts.append([part.half().cpu() for part in self.net.compute_maps(some)])
            done += len(some)
            if callback is not None:
                callback(self, {"images": done, "of": self._images})
        return [torch.cat(part) for part in zip(*parts, strict=True)]

    def _pseudo_labels(self, photographs: Maps) -> list[Tensor]:
        """What their places hold as the heads read them, see ``PretrainedCountNet.pseudo_labels``."""
        parts = [
            self.net.pseudo_labels(list(some)) for some in zip(*(part.split(64) for part in photographs), strict=True)
        ]
        return [torch.cat(part) for part in zip(*parts, strict=True)]

    def _update(self, rows: Tensor, part: float, photographs: tuple[Maps, list[Tensor]] | None) -> float:
        """A step of the optimiser on some renders, after a part of the epoch; returns its loss."""
        progress, rate = (self.done + part) / self.epochs, self.learning_rate
        if photographs is not None:
            progress, rate = part, SLOWER * rate
        for group in self.optimiser.param_groups:
            group["lr"] = rate * 0.5 * (1 + math.cos(math.pi * progress))
        loss = self._loss([some[rows] for some in self.maps], [target[rows] for target in self.targets])
        if photographs is not None:
            rows = torch.randint(len(photographs[0][0]), (PHOTOGRAPHS,))
            loss = loss + self._loss(*([some[rows] for some in part] for part in photographs), self_training=True)
        self.optimiser.zero_grad()
        loss.backward()
        self.optimiser.step()
        return loss.item()

    def _loss(self, maps: Maps, targets: list[Tensor], self_training: bool = False) -> Tensor:
        """Of all heads, or of those alone that teach themselves."""
        device = self.net.device
        flipped = (torch.rand(len(maps[0])) < 0.5).to(device)
        seen = [torch.where(flipped[:, None, None, None], some.flip(3), some) for some in self.net.normalise(maps)]
        loss = torch.zeros((), device=device)
        for kind, heads, target in zip(KINDS, self.net.heads, targets, strict=True):
            if self_training and not kind.self_training:
                continue
            target = target.to(device)
            target = torch.where(flipped[:, None, None, None, None], target.flip(4), target).float()
            shifted = [some + kind.shift * torch.randn(*some.shape[:2], 1, 1).to(device) for some in seen]
            logits = torch.stack([head(shifted) for head in cast(nn.ModuleList, heads)])
            each = target.expand_as(logits)  # (heads, N, scopes, 1 + C, h, w)
            loss = loss + relative_count_loss(logits.flatten(0, 2), each.flatten(0, 2))
        return loss
