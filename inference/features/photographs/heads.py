"""Counts read from the maps of a network that was trained on photographs.

A count network that is trained on renders alone learns what renders look like, and counts less well in photographs. The
frozen maps of a pretrained network change less between the two. Only small heads are trained on them
(``training``). Every place of the finest map, 8 pixels apart, holds a distribution over background and
classes, as in ``net``, once for each of ``SHARES``: the heads count what is visible by at least that share. Heads that
agree on renders disagree about photographs, so the mean of several is taken. The groups of a model are counted like any
class. How counts are read from the places is a choice for each class (``reading``), one for renders and one for
photographs (``readability``).

Renders need not be read: their labels say how much of each object can be seen. The unit of a count is the bandwidth
of a density of all counts, each in its standard deviations. Things and stuff are blocks (``Blockwise``): stuff is
counted so that it is not mistaken for things, and is not compared, as in photographs a wood has no definite number of
trees (``docs/results.md`` has what happens if it is).

Axis letters: N images, C classes, h w places, S shares, V renders that nothing is trained on.
"""

import math
from typing import Any, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..base import Examples
from ..pretrained import AT_ONCE, EfficientNetLite
from ..projection import bandwidth
from .readability import rules_for_renders
from .reading import RULES, SHARES, by_steps, read_all, read_each

SIZES = 224, 342  # least and largest square whose area images enter with; a frame of 621 x 188 enters as 608 x 192
PLACE = 8  # pixels of what enters
SMALLEST = 2 / 3  # places that the longer side of an object spans; what is smaller is not counted
LEAST_SPREAD, LEAST_UNIT = 0.3, 0.3  # objects
HEADS, HIDDEN = 4, 32
MOST = 200  # objects of a class that labels may count
DROPPED = 0.35  # of the channels, so that none is relied upon
Maps = list[Tensor]
"""Maps at strides of 8, 16 and 32, each ``(N, channels, h, w)``."""


class PretrainedCountNet(nn.Module):
    """A ``FeatureNet``: counts of things, then counts of stuff, D = C, in bandwidths.

    Args:
        classes: the kinds that are counted.
        canvas: height and width of the images, which enter in about that size.
        stuff: those of the classes that are no things, see ``SceneModel``.
        held: renders on which nothing is trained and rules are tried, V.
        sizes: see ``SIZES``.

    Attributes:
        unit: ``(D,)``, how many objects 1 in each feature stands for.
        blocks: how many features are counts of things and counts of stuff.
        taught_by: fingerprint of the images whose rules were chosen, ``(32,)`` uint8; zeros for none.
        rules: ``(2, C)`` of ``RULES``, by which renders and photographs are read.
        share: ``(C,)`` of ``SHARES``.
        steps: ``(C, MOST)``, see ``readability.by_steps``; infinite for none.
        read: ``(D,)`` bool, whether a class can be read in photographs; features of others are 0.
        held_read, held_true: ``(V, S, R, C)`` and ``(V, S, C)``, what is read in those renders, and their counts.
        size: ``(C,)``, places that the longer side of such an object spans, the median; infinite where none was drawn.
    """

    unit: Tensor
    taught_by: Tensor
    rules: Tensor
    share: Tensor
    steps: Tensor
    read: Tensor
    held_read: Tensor
    held_true: Tensor
    size: Tensor

    def __init__(
        self,
        classes: tuple[str, ...],
        canvas: tuple[int, int],
        stuff: tuple[str, ...] = (),
        held: int = 150,
        sizes: tuple[int, int] = SIZES,
    ):
        super().__init__()
        frozen = EfficientNetLite(min(max(round(math.sqrt(math.prod(canvas))), sizes[0]), sizes[1]))
        self.frozen = (frozen,)  # not a submodule: its weights are in no state
        self.classes, self.canvas, self.stuff = classes, canvas, stuff
        self.order = sorted(range(len(classes)), key=lambda i: classes[i] in stuff)  # of the classes in the features
        things = sum(name not in stuff for name in classes)
        self.blocks = things, len(classes) - things
        self.names = tuple(classes[i] for i in self.order)
        C = len(classes)
        for i, channels in enumerate(frozen.channels):
            self.register_buffer(f"mean_{i}", torch.zeros(channels, 1, 1))
            self.register_buffer(f"scale_{i}", torch.ones(channels, 1, 1))
        self.register_buffer("unit", torch.ones(len(self.names)))
        self.register_buffer("taught_by", torch.zeros(32, dtype=torch.uint8))
        self.register_buffer("rules", torch.zeros(2, C, dtype=torch.int64))
        self.register_buffer("share", torch.zeros(C, dtype=torch.int64))
        self.register_buffer("steps", torch.full((C, MOST), math.inf))
        self.register_buffer("read", torch.ones(len(self.names), dtype=torch.bool))
        self.register_buffer("held_read", torch.zeros(held, len(SHARES), len(RULES), C))
        self.register_buffer("held_true", torch.zeros(held, len(SHARES), C))
        self.register_buffer("size", torch.zeros(C))
        self.heads = nn.ModuleList(_Head(frozen.channels, (1 + C) * len(SHARES)) for _ in range(HEADS))

    @property
    def compared(self) -> Tensor:
        """``(D,)`` bool, which features say anything of the target's images: things that can be read."""
        return self.read & (torch.arange(len(self.names)) < self.blocks[0])

    @property
    def taught_by_fingerprint(self) -> str:
        """``taught_by`` in hexadecimal; empty for none."""
        return bytes(self.taught_by.tolist()).hex() if self.taught_by.any() else ""

    def places(self) -> tuple[int, int]:
        """h and w."""
        height, width = self.frozen[0].entering(*self.canvas)
        return height // PLACE, width // PLACE

    def scale(self) -> Tensor:
        """Places a pixel of the canvas, along x and y, ``(2,)``."""
        height, width = self.places()
        return torch.tensor([width / self.canvas[1], height / self.canvas[0]])

    @torch.no_grad()
    def begin(self, maps: Maps, target: Tensor) -> None:
        """Take over channels' means and scales, and start from what places hold in the mean: from anywhere else the
        first steps, which only mend the counts, leave a head that tells no class from another for long.

        Args:
            maps: of some renders.
            target: ``(N, S, 1 + C, h, w)``, what their places hold, see ``batches.cells``.
        """
        for i, some in enumerate(maps):
            getattr(self, f"mean_{i}").copy_(some.float().mean((0, 2, 3)).view(-1, 1, 1))
            getattr(self, f"scale_{i}").copy_(some.float().std((0, 2, 3)).view(-1, 1, 1) + 1e-3)
        for head in self.heads:
            cast(_Head, head).out.bias.copy_(target.float().mean((0, 3, 4)).flatten().clamp(min=1e-6).log())

    @torch.no_grad()
    def finish(self, read: Tensor, true: Tensor, sizes: Tensor) -> None:
        """Take over what is read in renders that nothing was trained on, as many as a batch of the fit has: the rules
        by which renders are read, and the units.

        Args:
            read: ``(V, S, R, C)``.
            true: ``(V, S, C)`` their counts.
            sizes: ``(C,)``, see ``size``.
        """
        self.held_read.copy_(read)
        self.held_true.copy_(true)
        self.size.copy_(sizes)
        self.rules.copy_(rules_for_renders(read[:, 0], true[:, 0]).expand(2, -1))
        things = self.order[: self.blocks[0]]
        spread = true[:, 0].std(0).clamp(min=LEAST_SPREAD)
        one = bandwidth((true[:, 0] / spread)[:, things]) if things else 1.0
        self.unit.copy_((one * spread).clamp(min=LEAST_UNIT)[self.order])

    @torch.no_grad()
    def look(self, images: Tensor) -> Maps:
        """Maps of ``(N, 1 or 3, H, W)`` uint8 images."""
        net = self.frozen[0]
        parts = [net.pyramid(net.enter(some))[0] for some in images.split(AT_ONCE)]
        return [torch.cat(part) for part in zip(*parts, strict=True)]

    def seen(self, drawn: Examples, share: float) -> Tensor:
        """Classes ``(N, M)`` of renders' objects that are visible by at least a share and not too small; -1 of others.

        Args:
            drawn: their labels.
        """
        small = (drawn.size * self.scale()).amax(-1) < SMALLEST
        return drawn.label.masked_fill((drawn.visible < share) | small, -1)

    def true_counts(self, drawn: Examples) -> Tensor:
        """Of renders, by their labels, for each share ``(N, S, C)``."""
        number = torch.arange(len(self.classes))
        return torch.stack([(self.seen(drawn, share)[..., None] == number).sum(1) for share in SHARES], 1).float()

    def normal(self, maps: Maps) -> Maps:
        """Maps in their channels' scales, float32."""
        return [
            (some.float() - getattr(self, f"mean_{i}")) / getattr(self, f"scale_{i}") for i, some in enumerate(maps)
        ]

    def forward(self, maps: Maps) -> Tensor:
        """Logits of the places by each head, ``(HEADS, N, S, 1 + C, h, w)``, of maps as ``normal`` gives them."""
        return torch.stack([head(maps).unflatten(1, (len(SHARES), -1)) for head in self.heads])

    @torch.no_grad()
    def by_head(self, maps: Maps) -> Tensor:
        """Probabilities of the classes in the places by each head, ``(HEADS, N, S, C, h, w)``."""
        return self(self.normal(maps)).softmax(3)[:, :, :, 1:]

    @torch.no_grad()
    def readings(self, maps: Maps) -> tuple[Tensor, Tensor]:
        """Counts by every rule, from the mean of the heads ``(N, S, R, C)``, and by each head for the least share
        ``(HEADS, N, R, C)``."""
        whole, each = [], []
        for some in zip(*(part.split(64) for part in maps), strict=True):
            probability = self.by_head(list(some))
            counts = read_all(probability.mean(0).flatten(0, 1))
            whole.append(counts.unflatten(0, (-1, len(SHARES))))
            each.append(torch.stack([read_all(head[:, 0]) for head in probability]))
        return torch.cat(whole), torch.cat(each, 1)

    @torch.no_grad()
    def counts(self, maps: Maps, photographs: bool = False) -> Tensor:
        """Counts in the order of the classes, ``(N, C)``, objects."""
        parts = [torch.zeros(0, len(self.classes))]
        for some in zip(*(part.split(64) for part in maps), strict=True):
            probability = self.by_head(list(some)).mean(0)
            chosen = probability[:, self.share, torch.arange(len(self.share))]
            counts = read_each(chosen, self.rules[int(photographs)])
            parts.append(by_steps(counts, self.steps) if photographs else counts)
        return torch.cat(parts)

    def embed_drawn(self, drawn: Examples) -> Tensor:
        """``(N, D)`` features of renders by their labels."""
        return self._features(self.true_counts(drawn)[:, self.share, torch.arange(len(self.share))])

    def embed(self, images: Tensor) -> Tensor:
        """``(N, D)`` features of renders ``(N, 1 or 3, H, W)`` uint8, read."""
        return self._embed(images, False)

    def embed_photographs(self, images: Tensor) -> Tensor:
        """``(N, D)`` features of images of the target ``(N, 1 or 3, H, W)`` uint8, read by their own rules."""
        return self._embed(images, True)

    @torch.no_grad()
    def _embed(self, images: Tensor, photographs: bool) -> Tensor:
        parts = [self.counts(self.look(some), photographs) for some in images.split(AT_ONCE)]
        return self._features(torch.cat(parts) if parts else torch.zeros(0, len(self.classes)))

    def _features(self, counts: Tensor) -> Tensor:
        return counts[:, self.order] / self.unit * self.read


class _Head(nn.Module):
    """One place's logits from the maps of three strides.

    The first layer takes each map at its own stride: a 1 x 1 convolution of what is upsampled is the same, upsampled.
    """

    def __init__(self, channels: tuple[int, ...], out: int):
        super().__init__()
        self.enter = nn.ModuleList(nn.Conv2d(number, HIDDEN, 1, bias=i == 0) for i, number in enumerate(channels))
        self.mix = nn.Conv2d(HIDDEN, HIDDEN, 3, padding=1)
        self.out: Any = nn.Conv2d(HIDDEN, out, 1)
        with torch.no_grad():
            self.out.weight.mul_(0.3)

    def forward(self, maps: Maps) -> Tensor:
        dropped = [F.dropout2d(some, DROPPED, self.training) for some in maps]
        x = self.enter[0](dropped[0])
        for enter, some in zip(self.enter[1:], dropped[1:], strict=True):
            x = x + F.interpolate(enter(some), x.shape[2:], mode="bilinear")
        return self.out(F.relu(self.mix(F.relu(x))))
