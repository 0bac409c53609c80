"""Counts read from the maps of a network that was trained on photographs, and what else structure moves in them.

A count network that is trained on renders alone learns what renders look like, and counts less well in photographs. The
frozen maps of a pretrained network change less between the two. Only small heads are trained on them
(``pretrained_training``). Every place of the map, 16 pixels apart, holds a distribution over background and classes, as
in ``net``; the counts are the sums over the map after each object's probability is rounded (``harden_counts``). Heads
that agree on renders disagree about photographs, so the mean of several is taken. The groups of a model are counted
like any class. The directions of ``projection`` come from the same pass: counts say nothing about how a wood differs
from five single trees.

The unit of the counts is the bandwidth of their density, as it is for the projection's directions: how many kernels
away one object more is depends on how well objects can be counted. Things and directions are blocks with a density each
(``Blockwise``), because photographs may lie far from all renders in some direction. Stuff is counted so that it is not
mistaken for things, and is not compared: in photographs a wood has no definite number of trees (``docs/results.md`` has
what happens if it is).

Axis letters: N images, C channels of the maps, h w places, P pooled features, d directions.
"""

import math
from typing import Any, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..pretrained import AT_ONCE, EfficientNetLite
from ..projection import Projection, bandwidth

SIZES = 224, 342  # least and largest square whose area images enter with; a frame of 621 x 188 enters as 608 x 192
NOTHING, WHOLE = 0.1, 0.5  # probability of an object that counts as none and as one
HEADS, HIDDEN = 4, 64
DROPPED = 0.2  # of the channels, so that none is relied upon


class PretrainedCountNet(nn.Module):
    """A ``FeatureNet``: counts of things, counts of stuff and directions, D = classes + d, in bandwidths.

    Args:
        classes: the kinds that are counted.
        directions: d.
        canvas: height and width of the images, which enter in about that size.
        stuff: those of the classes that are no things, see ``SceneModel``.
        sizes: see ``SIZES``.

    Attributes:
        unit: ``(D,)``, what 1 in each feature stands for: objects, or the projection's own unit.
        blocks: how many features are counts of things, counts of stuff, and directions.
        taught_by: fingerprint of the images that the heads taught themselves on, ``(32,)`` uint8; zeros for none.
    """

    mean: Tensor
    scale: Tensor
    unit: Tensor
    taught_by: Tensor
    projected_mean: Tensor
    projected_weight: Tensor

    def __init__(
        self,
        classes: tuple[str, ...],
        directions: int,
        canvas: tuple[int, int],
        stuff: tuple[str, ...] = (),
        sizes: tuple[int, int] = SIZES,
    ):
        super().__init__()
        frozen = EfficientNetLite(min(max(round(math.sqrt(math.prod(canvas))), sizes[0]), sizes[1]))
        self.frozen = (frozen,)  # not a submodule: its weights are in no state
        self.order = sorted(range(len(classes)), key=lambda i: classes[i] in stuff)  # of the classes in the features
        things = sum(name not in stuff for name in classes)
        self.blocks = things, len(classes) - things, directions
        counted = (classes[i] for i in self.order)
        self.names = (*counted, *(f"direction_{i}" for i in range(1, directions + 1)))
        self.register_buffer("mean", torch.zeros(frozen.channels, 1, 1))
        self.register_buffer("scale", torch.ones(frozen.channels, 1, 1))
        self.register_buffer("unit", torch.ones(len(self.names)))
        self.register_buffer("taught_by", torch.zeros(32, dtype=torch.uint8))
        self.register_buffer("projected_mean", torch.zeros(len(frozen.names)))
        self.register_buffer("projected_weight", torch.zeros(len(frozen.names), directions))
        self.heads = nn.ModuleList(_head(frozen.channels, 1 + len(classes)) for _ in range(HEADS))

    @property
    def taught_by_fingerprint(self) -> str:
        """``taught_by`` in hexadecimal; empty for none."""
        return bytes(self.taught_by.tolist()).hex() if self.taught_by.any() else ""

    def learn_from(self, fingerprint: str) -> None:
        """Remember whose images the heads teach themselves on."""
        self.taught_by.copy_(torch.tensor(list(bytes.fromhex(fingerprint)), dtype=torch.uint8))

    @torch.no_grad()
    def begin(self, maps: Tensor, target: Tensor) -> None:
        """Take over channels' means and scales, and start from what places hold in the mean: from anywhere else the
        first steps, which only mend the counts, leave a head that tells no class from another for long.

        Args:
            maps: ``(N, C, h, w)`` of some renders.
            target: ``(N, 1 + classes, h, w)``, what their places hold, see ``batches.cells``.
        """
        self.mean.copy_(maps.mean((0, 2, 3)).view(-1, 1, 1))
        self.scale.copy_(maps.std((0, 2, 3)).view(-1, 1, 1) + 1e-3)
        for head in self.heads:
            _last(head).bias.copy_(target.mean((0, 2, 3)).clamp(min=1e-6).log())

    @torch.no_grad()
    def finish(self, projection: Projection, maps: Tensor) -> None:
        """Take over a projection of pooled features, and choose the unit of the counts by the things in maps of renders
        that nothing was trained on, as many as a batch of the fit has."""
        self.projected_mean.copy_(projection.mean)
        self.projected_weight.copy_(projection.weight)
        things = self.order[: self.blocks[0]]
        self.unit[: len(self.order)] = bandwidth(self.counts(maps)[:, things])

    @torch.no_grad()
    def look(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Maps ``(N, C, h, w)`` and pooled features ``(N, P)`` of ``(N, 1 or 3, H, W)`` uint8 images."""
        net = self.frozen[0]
        parts = [net.places(net.enter(some)) for some in images.split(AT_ONCE)]
        maps, pooled = (torch.cat(part) for part in zip(*parts, strict=True))
        return maps, pooled

    def forward(self, maps: Tensor) -> Tensor:
        """Logits of the places by each head, ``(HEADS, N, 1 + classes, h, w)``."""
        x = (maps - self.mean) / self.scale
        return torch.stack([head(x) for head in self.heads])

    @torch.no_grad()
    def cell_counts(self, maps: Tensor) -> Tensor:
        """The heads' mean counts in the places of maps ``(N, C, h, w)``, each object's probability rounded,
        ``(N, classes, h, w)``."""
        return torch.cat([harden_counts(self(some.float()).softmax(2).mean(0)[:, 1:]) for some in maps.split(64)])

    @torch.no_grad()
    def counts(self, maps: Tensor) -> Tensor:
        """Counts in the order of the classes, ``(N, classes)``, objects."""
        return self.cell_counts(maps).sum((2, 3))

    @torch.no_grad()
    def embed(self, images: Tensor) -> Tensor:
        """``(N, D)`` features of ``(N, 1 or 3, H, W)`` uint8 images."""
        out = [torch.zeros(0, len(self.names))]
        for some in images.split(AT_ONCE):
            maps, pooled = self.look(some)
            directions = (pooled - self.projected_mean) @ self.projected_weight
            out.append(torch.cat([self.counts(maps)[:, self.order], directions], 1) / self.unit)
        return torch.cat(out)


def harden_counts(probability: Tensor) -> Tensor:
    """Maps of probabilities ``(N, classes, h, w)`` with each object's probability rounded; of the same shape.

    In photographs heads give too little probability to the objects there are, and a little to many that are not there.
    An object's probability is its sum over the 3 x 3 places around: up to ``NOTHING`` it counts as no object, from
    ``WHOLE`` on as one, with a smooth transition in between.
    """
    mass = 9 * F.avg_pool2d(probability, 3, 1, 1)
    part = ((mass - NOTHING) / (WHOLE - NOTHING)).clamp(0, 1)
    return probability * part.square() * (3 - 2 * part) * (1 / mass.clamp(min=NOTHING)).clamp(min=1.0)


def _head(channels: int, out: int) -> nn.Sequential:
    head = nn.Sequential(
        nn.Dropout2d(DROPPED),
        nn.Conv2d(channels, HIDDEN, 1),
        nn.ReLU(inplace=True),
        nn.Conv2d(HIDDEN, HIDDEN, 3, padding=1),
        nn.ReLU(inplace=True),
        nn.Conv2d(HIDDEN, out, 1),
    )
    with torch.no_grad():
        _last(head).weight.mul_(0.3)
    return head


def _last(head: nn.Module) -> Any:
    """The last convolution of a head."""
    return cast(nn.Sequential, head)[-1]
