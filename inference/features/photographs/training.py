"""Training ``PretrainedCountNet`` on renders with their free labels, each structure drawn twice.

The frozen network sees each image once; its maps stay in memory as half-precision numbers, 0.2 MB an image of 320 x
240, and the heads take many epochs on them. The second drawing of each structure looks as a camera might have taken it
(``looks``). Photographs' maps are unlike renders' channel by channel, so the heads are kept from relying on any:
channels are left out (``heads.DROPPED``) and shifted at random. The pairs give the projection.

Axis letters: N images, M nodes, S shares.
"""

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from probscene.sampling import seed_everything

from ...training import Report, batch_seed, check_finite, restore_training, training_state
from ..base import Draw, Examples
from ..counting.batches import STRIDE, cells
from ..counting.training import relative_count_loss
from ..projection import discriminant
from .heads import SMALLEST, Maps, PretrainedCountNet
from .looks import photographed
from .readability import rules_for_renders
from .reading import SHARES

DRAWN_AT_ONCE = 32  # structures
SHIFT = 0.2  # of a channel over a whole image, in its standard deviations


class Found(NamedTuple):
    """How well structure is seen.

    Attributes:
        correlation: of the counts with the true ones on the renders held out, ``(classes,)``; NaN where one of them
            does not vary.
        ratio: of the projection, see there.
    """

    correlation: Tensor
    ratio: Tensor


class PretrainedCountTraining:
    """Resumable training; after an interruption the renders are drawn and looked at again.

    Args:
        net: trained in place.
        draw_twice: labelled renders of so many structures, then as many of the same structures.
        pairs: structures.
        epochs: of the heads.
        batch_size, learning_rate: of AdamW, along a cosine.
        seed: of everything random.

    Attributes:
        unit, total, done: see ``Training``.
        found: how well structure is seen, once it is finished.
    """

    unit = "epochs"

    def __init__(
        self,
        net: PretrainedCountNet,
        draw_twice: Draw,
        pairs: int = 1000,
        epochs: int = 8,
        batch_size: int = 32,
        learning_rate: float = 5e-3,
        seed: int = 0,
    ):
        self.net, self.draw_twice, self.pairs, self.total = net, draw_twice, pairs, epochs
        self.batch_size, self.learning_rate, self.seed, self.done = batch_size, learning_rate, seed, 0
        self.found: Found | None = None
        self.optimiser = torch.optim.AdamW(net.heads.parameters(), lr=learning_rate, weight_decay=5e-2)

    def run(self, each: Report | None = None) -> None:
        """Take the epochs that are left.

        Args:
            each: hears how many images have been looked at, ``images``, ``of`` how many; then the mean loss after every
                epoch.

        Raises:
            ProbsceneError: the loss is no longer finite; see also ``discriminant``.
        """
        maps, pooled, target, true, sizes = self._look(each)
        n = 2 * self.pairs
        if self.done == 0:
            some = slice(0, n, max(1, n // 512))
            self.net.begin([part[some] for part in maps], target[some])
        while self.done < self.total:
            seed_everything(batch_seed(self.seed, 1, self.done))
            self.net.train()
            batches = torch.randperm(n).split(self.batch_size)
            losses = [
                self._step([part[rows] for part in maps], target[rows], i / len(batches))
                for i, rows in enumerate(batches)
            ]
            self.done += 1
            loss = sum(losses) / len(losses)
            where = f"in epoch {self.done}"
            check_finite(loss, self.net.parameters(), "the count heads", where, "begin again with features=count")
            if each is not None:
                each(self, {"loss": loss})
        self.net.eval()
        one, other = pooled[:n].chunk(2)
        held = [part[n:] for part in maps]
        projection = discriminant(one, other, self.net.blocks[-1], len(held[0]))
        read, _ = self.net.readings(held)
        self.net.held_read.copy_(read)
        self.net.held_true.copy_(true[n:])
        self.net.size.copy_(torch.stack([each.median() if len(each) else torch.tensor(math.inf) for each in sizes]))
        directions = projection(pooled[n:])
        self.net.finish(projection, directions, rules_for_renders(read[:, 0], true[n:, 0]), held)
        each_class = zip(self.net.counts(held).T, true[n:, 0].T, strict=True)
        correlation = torch.stack([torch.corrcoef(torch.stack(pair))[0, 1] for pair in each_class])
        self.found = Found(correlation, projection.ratio)

    def summary(self) -> dict[str, Any]:
        """For the log: what was found."""
        if self.found is None:
            return {}
        plain = {name: [x if x == x else None for x in part.tolist()] for name, part in self.found._asdict().items()}
        return {"stage": "counts", **plain}

    def state(self) -> dict[str, Tensor]:
        """All that ``restore`` needs, as named tensors."""
        return training_state(self.net, {"adam": self.optimiser}, done=self.done)

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Go on from a ``state``."""
        self.done = int(restore_training(self.net, {"adam": self.optimiser}, tensors)["done"])

    def _look(self, each: Report | None) -> tuple[Maps, Tensor, Tensor, Tensor, list[Tensor]]:
        """Of renders: maps, float16, pooled features ``(N, P)``, what the places should hold ``(N, S, 1 + classes, h,
        w)`` float16 and the true counts ``(N, S, classes)``: all first drawings, all second ones, then what is held
        out. Then of each class the sizes of its objects, places."""
        seed_everything(batch_seed(self.seed, 0))
        rng = np.random.default_rng(batch_seed(self.seed, 2))
        held = len(self.net.held_true)
        number = self.pairs + (held + 1) // 2
        done, parts, sizes = 0, [], [[] for _ in self.net.classes]
        chunks = [*_parts(self.pairs), *_parts(number - self.pairs)]
        for some in chunks:
            drawings = self.draw_twice(some)
            image = torch.cat([drawings.image[:some], photographed(drawings.image[some:], rng)])
            maps, pooled = self.net.look(image)
            target, true, size = self._target(drawings)
            for c, of_class in enumerate(sizes):
                of_class.append(size[(drawings.label == c) & (drawings.visible >= SHARES[0])])
            parts.append([part.chunk(2) for part in (*(m.half() for m in maps), pooled, target.half(), true)])
            done += len(image)
            if each is not None:
                each(self, {"images": done, "of": 2 * number})
        cut = len(_parts(self.pairs))
        joined = [
            torch.cat([both[i] for some in (column[:cut], column[cut:]) for i in (0, 1) for both in some])
            for column in zip(*parts, strict=True)
        ]
        *maps, pooled, target, true = (part[: 2 * self.pairs + held] for part in joined)
        return maps, pooled, target, true, [torch.cat(of_class) for of_class in sizes]

    def _target(self, drawings: Examples) -> tuple[Tensor, Tensor, Tensor]:
        """What the places should hold, ``(N, S, 1 + classes, h, w)``, counts ``(N, S, classes)``, and the sizes of
        objects ``(N, M)``, places."""
        height, width = self.net.places()
        places = torch.tensor([width / drawings.image.shape[-1], height / drawings.image.shape[-2]])
        size = (drawings.size * places).amax(-1)
        held, counts, C = [], [], len(self.net.classes)
        for share in SHARES:
            label = drawings.label.masked_fill((drawings.visible < share) | (size < SMALLEST), -1)
            held.append(cells(drawings.centre * places * STRIDE, label, C, height, width))
            counts.append(
                (drawings.label.masked_fill(drawings.visible < share, -1)[..., None] == torch.arange(C)).sum(1)
            )
        return torch.stack(held, 1), torch.stack(counts, 1).float(), size

    def _step(self, maps: Maps, target: Tensor, part: float) -> float:
        for group in self.optimiser.param_groups:
            group["lr"] = self.learning_rate * 0.5 * (1 + math.cos(math.pi * (self.done + part) / self.total))
        flipped = torch.rand(len(target)) < 0.5
        target = torch.where(flipped[:, None, None, None, None], target.flip(4), target).float()
        seen = [torch.where(flipped[:, None, None, None], some.flip(3), some) for some in self.net.normal(maps)]
        seen = [some + SHIFT * torch.randn(*some.shape[:2], 1, 1) for some in seen]
        logits = self.net(seen)  # (heads, N, S, 1 + classes, h, w)
        loss = relative_count_loss(logits.flatten(0, 2), target.expand(len(logits), -1, -1, -1, -1, -1).flatten(0, 2))
        self.optimiser.zero_grad()
        loss.backward()
        self.optimiser.step()
        return loss.item()


def _parts(number: int) -> list[int]:
    return [min(DRAWN_AT_ONCE, number - start) for start in range(0, number, DRAWN_AT_ONCE)]
