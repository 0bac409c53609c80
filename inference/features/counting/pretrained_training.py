"""Training ``PretrainedCountNet`` on renders with their free labels, each structure drawn twice.

The frozen network sees each image once; its maps stay in memory as half-precision numbers, 0.4 MB a frame of 621 x
188, and the heads take many epochs on them. Photographs' maps are unlike renders' channel by channel, so the heads are
kept from relying on any: channels are left out (``pretrained.DROPPED``) and shifted at random. The pairs give the
projection.

Then the heads train themselves [1]: for one more epoch their own rounded counts in the target's unlabelled images are
the labels, with channels left out and shifted, beside the renders. It is one epoch because each further one raises the
counts again (``docs/results.md``).

Axis letters: N images, M nodes.

References:
    [1] Xie et al., *Self-training with Noisy Student improves ImageNet classification*, CVPR 2020.
"""

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from probscene.sampling import seed_everything

from ...training import Report, batch_seed, check_finite, restore_training, training_state
from ..base import Draw, Examples
from ..projection import discriminant
from .batches import STRIDE, cells
from .pretrained import PretrainedCountNet
from .training import relative_count_loss

DRAWN_AT_ONCE = 32  # structures
SMALLEST = 1.0  # places that the longer side of an object spans; what is smaller is not counted
SHIFT = 0.2  # of a channel over a whole image, in its standard deviations
PHOTOGRAPHS = 12  # a step
SLOWER = 0.4  # rate of the epoch with photographs, of the first one's


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
        epochs: of the heads on renders alone.
        held_out: further renders, as many as a batch of the fit has scenes, by which the unit of the counts is chosen.
        batch_size, learning_rate: of AdamW, along a cosine.
        min_visible: objects less visible than this are not counted.
        seed: of everything random.
        photographs: unlabelled images of the target, ``(L, 1 or 3, H, W)`` uint8; where there are none, no epoch
            on them.

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
        held_out: int = 150,
        batch_size: int = 32,
        learning_rate: float = 5e-3,
        min_visible: float = 0.25,
        seed: int = 0,
        photographs: Tensor | None = None,
    ):
        self.net, self.draw_twice, self.pairs, self.epochs, self.held_out = net, draw_twice, pairs, epochs, held_out
        self.photographs, self.batch_size, self.min_visible, self.seed = photographs, batch_size, min_visible, seed
        self.learning_rate, self.done = learning_rate, 0
        self.total = epochs + (photographs is not None and len(photographs) > 0)
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
        maps, pooled, target, photographs = self._look(each)
        n, own = 2 * self.pairs, None
        if self.done == 0:
            self.net.begin(maps[: min(n, 512)].float(), target[: min(n, 512)].float())
        while self.done < self.total:
            seed_everything(batch_seed(self.seed, 1, self.done))
            if self.done == self.epochs:
                own = photographs, self._own(photographs)
            self.net.train()
            batches = torch.randperm(n).split(self.batch_size)
            losses = [self._step(maps[rows], target[rows], i / len(batches), own) for i, rows in enumerate(batches)]
            self.done += 1
            loss = sum(losses) / len(losses)
            where = f"in epoch {self.done}"
            check_finite(loss, self.net.parameters(), "the count heads", where, "begin again with features=count")
            if each is not None:
                each(self, {"loss": loss})
        self.net.eval()
        one, other = pooled[:n].chunk(2)
        projection = discriminant(one, other, self.net.blocks[-1], self.held_out)
        self.net.finish(projection, maps[n:])
        seen, true = self.net.counts(maps[n:]), target[n:, 1:].float().sum((2, 3))
        each_class = zip(seen.T, true.T, strict=True)
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

    def _look(self, each: Report | None) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Of renders: maps ``(N, C, h, w)`` float16, pooled features ``(N, P)`` and what the places should hold
        ``(N, 1 + classes, h, w)`` float16: all first drawings, all second ones, then what is held out. Of photographs:
        maps, as of renders."""
        seed_everything(batch_seed(self.seed, 0))
        number = self.pairs + (self.held_out + 1) // 2
        photographs = () if self.photographs is None else self.photographs.split(2 * DRAWN_AT_ONCE)
        done, total = 0, 2 * number + sum(map(len, photographs))

        def look(images):
            nonlocal done
            maps, pooled = self.net.look(images)
            done += len(images)
            if each is not None:
                each(self, {"images": done, "of": total})
            return maps.half(), pooled

        parts = ([], [], [])
        for some in [*_parts(self.pairs), *_parts(number - self.pairs)]:
            drawings = self.draw_twice(some)
            maps, pooled = look(drawings.image)
            target = self._target(drawings, *maps.shape[2:]).half()
            for part, of_drawings in zip(parts, (maps, pooled, target), strict=True):
                part.append(of_drawings.chunk(2))
        cut = len(_parts(self.pairs))
        maps, pooled, target = (
            torch.cat([both[i] for some in (part[:cut], part[cut:]) for i in (0, 1) for both in some]) for part in parts
        )
        return maps, pooled, target, torch.cat([look(some)[0] for some in photographs] or [maps[:0]])

    def _own(self, photographs: Tensor) -> Tensor:
        """What the places of photographs' maps hold in the heads' own belief, ``(L, 1 + classes, h, w)``."""
        self.net.eval()
        counts = self.net.cell_counts(photographs)
        counts = counts / counts.sum(1, keepdim=True).clamp(min=1)
        return torch.cat([1 - counts.sum(1, keepdim=True), counts], 1)

    def _target(self, drawings: Examples, height: int, width: int) -> Tensor:
        places = torch.tensor([width / drawings.image.shape[-1], height / drawings.image.shape[-2]])
        size = (drawings.size * places).amax(-1)
        label = drawings.label.masked_fill((drawings.visible < self.min_visible) | (size < SMALLEST), -1)
        return cells(drawings.centre * places * STRIDE, label, len(self.net.order), height, width)

    def _step(self, maps: Tensor, target: Tensor, part: float, own: tuple[Tensor, Tensor] | None) -> float:
        over, slower = ((self.done + part) / self.epochs, 1) if own is None else (part, SLOWER)
        for group in self.optimiser.param_groups:
            group["lr"] = slower * self.learning_rate * 0.5 * (1 + math.cos(math.pi * over))
        loss = self._loss(maps, target)
        if own is not None:
            rows = torch.randint(len(own[0]), (PHOTOGRAPHS,))
            loss = loss + self._loss(*(each[rows] for each in own))
        self.optimiser.zero_grad()
        loss.backward()
        self.optimiser.step()
        return loss.item()

    def _loss(self, maps: Tensor, target: Tensor) -> Tensor:
        flipped = torch.rand(len(maps)) < 0.5
        maps, target = maps.float(), target.float()
        maps[flipped], target[flipped] = maps[flipped].flip(3), target[flipped].flip(3)
        maps += self.net.scale * (SHIFT * torch.randn(*maps.shape[:2], 1, 1))
        logits = self.net(maps).flatten(0, 1)
        return relative_count_loss(logits, target.repeat(len(logits) // len(target), 1, 1, 1))


def _parts(number: int) -> list[int]:
    return [min(DRAWN_AT_ONCE, number - start) for start in range(0, number, DRAWN_AT_ONCE)]
