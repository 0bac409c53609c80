"""Counts read from the maps of a network that was trained on photographs.

A count network that is trained on renders alone learns what renders look like, and counts less well in photographs. The
frozen maps of a pretrained network change less between the two. Only small heads are trained on them (``training``).
Every place of a map holds a distribution over background and classes, as in ``counting.net``, once for each of
``SCOPES``. Heads that agree on renders disagree about photographs, so the mean of several is taken. Heads whose places
are 16 pixels apart read strides of 16 and 32: what they count, they count more alike in renders and photographs. Those
8 pixels apart see stride 8 as well, and small objects. The groups of a model are counted like any class. How counts are
read from the places is a choice for each class (``reading``), one for renders and one for photographs
(``readability``).

Renders need not be read: their labels say how much of each object can be seen. The unit of a count is the bandwidth
of a density of all counts, each in its standard deviations. Things and stuff are blocks (``Blockwise``): stuff is
counted so that it is not mistaken for things, and is not compared, as in photographs a wood has no definite number of
trees (``docs/experiments.md`` has what happens if it is).

Axis letters: N images, C classes, h w places, S scopes, R rules, V renders that nothing is trained on.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from probscene.device import device_of

from ...divergence import bandwidth
from ..base import Examples
from ..pretrained import AT_ONCE, NHWC, EfficientNetLite
from .readability import rules_for_renders, scopes_without_labels
from .reading import RULES, SCOPES, Rule, Scope, by_steps, read_all, read_each, whole

SIZES = 224, 342  # least and largest square whose area images enter with; a frame of 621 x 188 enters as 608 x 192
MIN_PIXELS = min(scope.pixels for scope in SCOPES)  # pixels of what enters; what is smaller is not counted
MIN_SPREAD, MIN_UNIT = 0.3, 0.3  # objects
HEADS = 4  # of each kind
PSEUDO_LABEL_RULE = Rule("soft", 3, 0.1, 0.5)  # by which heads learn from their own readings
MAX_COUNT = 200  # objects of a class that labels may count


STRIDES = (8, 16, 32)  # of the maps
Maps = list[Tensor]
"""Maps at ``STRIDES``, each ``(N, channels, h, w)``."""


class Kind(NamedTuple):
    """Heads that have their places in common.

    Attributes:
        stride: of their places, see ``Scope``.
        scopes: those of ``SCOPES`` that they count.
        hidden: channels.
        dropped: share of the maps' channels that is left out, so that none is relied upon.
        shift: standard deviation of what is added to a channel over a whole image, in its own.
        self_training: whether it learns from what it reads in photographs, see ``training``.
    """

    stride: int
    scopes: tuple[int, ...]
    hidden: int
    dropped: float
    shift: float
    self_training: bool


def _scopes_of(stride: int) -> tuple[int, ...]:
    return tuple(s for s, scope in enumerate(SCOPES) if scope.stride == stride)


# Texture, which is in the finest maps, differs most between renders and photographs.
KINDS = (Kind(16, _scopes_of(16), 64, 0.2, 0.2, True), Kind(8, _scopes_of(8), 32, 0.35, 0.5, False))


class Head(nn.Module):
    """One place's logits from the maps of its stride and of those above.

    The first layer takes each map at its own stride: a 1 x 1 convolution of what is upsampled is the same, upsampled.
    """

    def __init__(self, kind: Kind, channels: tuple[int, ...], out: int):
        super().__init__()
        self.kind, self.first = kind, STRIDES.index(kind.stride)
        enters = (nn.Conv2d(number, kind.hidden, 1, bias=i == 0) for i, number in enumerate(channels[self.first :]))
        self.enter = nn.ModuleList(enters)
        self.mix = nn.Conv2d(kind.hidden, kind.hidden, 3, padding=1)
        self.out: Any = nn.Conv2d(kind.hidden, out * len(kind.scopes), 1)
        with torch.no_grad():
            self.out.weight.mul_(0.3)

    def forward(self, maps: Maps) -> Tensor:
        """``(N, the kind's scopes, 1 + C, h, w)``."""
        dropped = [F.dropout2d(some, self.kind.dropped, self.training) for some in maps[self.first :]]
        x = self.enter[0](dropped[0])
        for enter, some in zip(self.enter[1:], dropped[1:], strict=True):
            x = x + F.interpolate(enter(some), x.shape[2:], mode="bilinear")
        return self.out(F.relu(self.mix(F.relu(x)))).unflatten(1, (len(self.kind.scopes), -1))


class PretrainedCountNet(nn.Module):
    """A ``FeatureNet``: counts of things, then counts of stuff, D = C, in bandwidths.

    Args:
        classes: the kinds that are counted.
        canvas: height and width of the images, which enter in about that size.
        stuff: those of the classes that are no things, see ``SceneModel``.
        held: renders on which nothing is trained and rules are tried, V.
        sizes: see ``SIZES``.

    Attributes:
        uses_labels: see ``FeatureNet``.
        unit: ``(D,)``, how many objects 1 in each feature stands for.
        blocks: how many features are counts of things and counts of stuff.
        taught_by: fingerprint of the images that heads and rules are suited to, ``(32,)`` uint8; zeros for none.
        rules: ``(2, C, R)`` bool, of ``RULES``, by whose median renders and photographs are read.
        scope: ``(C,)`` of ``SCOPES``.
        counted_from: ``(C, 2)``, from which visible share and which longer side, pixels of what enters, objects of
            scenes count: those of the scope, or of what people label where a class is read as they label it.
        apart: ``(S, R, C)``, how far heads were apart in those images before they learnt from them, see
            ``readability.disagreement``; infinite where they did not.
        steps: ``(C, MAX_COUNT)``, see ``readability.by_steps``; infinite for none.
        read: ``(D,)`` bool, whether a class can be read in photographs; features of others are 0.
        held_read, held_true: ``(V, S, R, C)`` and ``(V, S, C)``, what is read in those renders, and their counts.
        size: ``(C,)``, pixels of what enters that the longer side of such an object spans, the median; infinite where
            none was drawn.
    """

    uses_labels = True
    unit: Tensor
    taught_by: Tensor
    rules: Tensor
    scope: Tensor
    counted_from: Tensor
    apart: Tensor
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
        self.register_buffer("rules", torch.ones(2, C, len(RULES), dtype=torch.bool))
        self.register_buffer("scope", torch.zeros(C, dtype=torch.int64))
        self.register_buffer("counted_from", torch.tensor([SCOPES[0][:2]] * C))
        self.register_buffer("apart", torch.full((len(SCOPES), len(RULES), C), math.inf))
        self.register_buffer("steps", torch.full((C, MAX_COUNT), math.inf))
        self.register_buffer("read", torch.ones(len(self.names), dtype=torch.bool))
        self.register_buffer("held_read", torch.zeros(held, len(SCOPES), len(RULES), C))
        self.register_buffer("held_true", torch.zeros(held, len(SCOPES), C))
        self.register_buffer("size", torch.zeros(C))
        self.heads = nn.ModuleList(
            nn.ModuleList(Head(kind, frozen.channels, 1 + C) for _ in range(HEADS)) for kind in KINDS
        )

    def place(self, device: torch.device) -> None:
        """See ``Placeable``; heads and frozen network go there, and what is kept of classes stays on the CPU."""
        self.frozen[0].place(device)
        self.heads.to(device)

    @property
    def device(self) -> torch.device:
        """Where its maps and heads are."""
        return device_of(self.heads)

    @property
    def feature_mask(self) -> Tensor:
        """``(D,)`` bool, which features say anything of the target's images: things that can be read."""
        return self.read & (torch.arange(len(self.names)) < self.blocks[0])

    @property
    def taught_by_fingerprint(self) -> str:
        """``taught_by`` in hexadecimal; empty for none."""
        return bytes(self.taught_by.tolist()).hex() if self.taught_by.any() else ""

    def bind(self, fingerprint: str) -> None:
        """Say which images heads and rules are suited to, see ``taught_by``; in hexadecimal."""
        self.taught_by.copy_(torch.tensor(list(bytes.fromhex(fingerprint)), dtype=torch.uint8))

    @property
    def map_channels(self) -> Sequence[int]:
        """Of each map."""
        return self.frozen[0].channels

    def places(self, stride: int) -> tuple[int, int]:
        """h and w of places so far apart."""
        height, width = self.frozen[0].entering(*self.canvas)
        return height // stride, width // stride

    def scale(self) -> Tensor:
        """Pixels of what enters to one of the canvas, along x and y, ``(2,)``."""
        height, width = self.frozen[0].entering(*self.canvas)
        return torch.tensor([width / self.canvas[1], height / self.canvas[0]])

    @torch.no_grad()
    def initialise(self, maps: Maps, targets: list[Tensor]) -> None:
        """Take over channels' means and scales, and start from what places hold in the mean: from anywhere else the
        first steps, which only fix the counts, leave a head that tells no class from another for long.

        Args:
            maps: of some renders.
            targets: for each of ``KINDS``, what its places hold, ``(N, its scopes, 1 + C, h, w)``, see
                ``batches.cells``.
        """
        for i, some in enumerate(maps):
            getattr(self, f"mean_{i}").copy_(some.float().mean((0, 2, 3)).view(-1, 1, 1))
            getattr(self, f"scale_{i}").copy_(some.float().std((0, 2, 3)).view(-1, 1, 1) + 1e-3)
        for heads, target in zip(self.heads, targets, strict=True):
            start = target.float().mean((0, 3, 4)).flatten().clamp(min=1e-6).log()
            for head in cast(nn.ModuleList, heads):
                cast(Head, head).out.bias.copy_(start)

    @torch.no_grad()
    def calibrate(self, read: Tensor, true: Tensor, sizes: Tensor) -> None:
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
        self.scope.copy_(scopes_without_labels(true))
        self.counted_from.copy_(torch.tensor([SCOPES[s][:2] for s in self.scope.tolist()]))
        C = torch.arange(len(self.scope))
        of_scope = true[:, self.scope, C]
        self.rules.copy_(rules_for_renders(read[:, self.scope, :, C].transpose(0, 1), of_scope).expand(2, -1, -1))
        things = self.order[: self.blocks[0]]
        spread = of_scope.std(0).clamp(min=MIN_SPREAD)
        one = bandwidth((of_scope / spread)[:, things]) if things else 1.0
        self.unit.copy_((one * spread).clamp(min=MIN_UNIT)[self.order])

    @torch.no_grad()
    def compute_maps(self, images: Tensor) -> Maps:
        """Maps of ``(N, 1 or 3, H, W)`` uint8 images, on ``device``."""
        net = self.frozen[0]
        parts = [net.pyramid(net.enter(some)) for some in images.split(AT_ONCE)]
        return [torch.cat(part) for part in zip(*parts, strict=True)]

    def counted_labels(self, drawn: Examples, scope: Scope) -> Tensor:
        """Classes ``(N, M)`` of renders' objects that a scope counts; -1 of others.

        Args:
            drawn: their labels.
        """
        small = self.spans(drawn) < scope.pixels
        return drawn.label.masked_fill((drawn.visible < scope.visible) | small, -1)

    def true_counts(self, drawn: Examples) -> Tensor:
        """Of renders, by their labels, for each scope ``(N, S, C)``."""
        number = torch.arange(len(self.classes))
        return torch.stack(
            [(self.counted_labels(drawn, scope)[..., None] == number).sum(1) for scope in SCOPES], 1
        ).float()

    def normalise(self, maps: Maps) -> Maps:
        """Maps in their channels' scales, float32, on ``device``."""
        device = self.device
        wide = [some.to(device).float().contiguous(memory_format=NHWC) for some in maps]
        scales = ([getattr(self, f"{name}_{i}").to(device) for name in ("mean", "scale")] for i in range(len(maps)))
        return [(some - mean) / scale for some, (mean, scale) in zip(wide, scales, strict=True)]

    def forward(self, maps: Maps) -> list[Tensor]:
        """For each of ``KINDS``, logits of the places by each head, ``(HEADS, N, its scopes, 1 + C, h, w)``, of maps as
        ``normalise`` gives them."""
        return [torch.stack([head(maps) for head in cast(nn.ModuleList, heads)]) for heads in self.heads]

    @torch.no_grad()
    def head_probabilities(self, maps: Maps) -> list[Tensor]:
        """For each of ``KINDS``, probabilities of the classes in the places by each head, ``(HEADS, N, its scopes, C,
        h, w)``."""
        return [logits.softmax(3)[:, :, :, 1:] for logits in self(self.normalise(maps))]

    @torch.no_grad()
    def pseudo_labels(self, maps: Maps) -> list[Tensor]:
        """For each of ``KINDS``, what the places hold by the mean of its heads, where what is surely an object is a
        whole one and what is faint is none, ``(N, its scopes, 1 + C, h, w)``."""
        out = []
        for probability in self.head_probabilities(maps):
            mean = probability.mean(0)
            held = whole(mean.flatten(0, 1), PSEUDO_LABEL_RULE).unflatten(0, mean.shape[:2])
            held = held / held.sum(2, keepdim=True).clamp(min=1)
            out.append(torch.cat([1 - held.sum(2, keepdim=True), held], 2).cpu())
        return out

    @torch.no_grad()
    def readings(self, maps: Maps) -> tuple[Tensor, Tensor]:
        """Counts by every rule, from the mean of the heads ``(N, S, R, C)``, and by each ``(HEADS, N, S, R, C)``."""
        whole, each = [], []
        for some in zip(*(part.split(64) for part in maps), strict=True):
            kinds = self.head_probabilities(list(some))
            whole.append(torch.cat([_all_scopes(probability.mean(0)) for probability in kinds], 1).cpu())
            each.append(torch.cat([torch.stack([*map(_all_scopes, probability)]) for probability in kinds], 2).cpu())
        return torch.cat(whole), torch.cat(each, 1)

    @torch.no_grad()
    def counts(self, maps: Maps, photographs: bool = False) -> Tensor:
        """Counts in the order of the classes, ``(N, C)``, objects."""
        parts = [torch.zeros(0, len(self.classes))]
        for some in zip(*(part.split(64) for part in maps), strict=True):
            counts = torch.zeros(len(some[0]), len(self.classes))
            for kind, probability in zip(KINDS, self.head_probabilities(list(some)), strict=True):
                for within, s in enumerate(kind.scopes):
                    which = self.scope == s
                    rules = self.rules[int(photographs), which]
                    counts[:, which] = read_each(probability[:, :, within, which].mean(0), rules).cpu()
            parts.append(by_steps(counts, self.steps) if photographs else counts)
        return torch.cat(parts)

    @torch.no_grad()
    def cells(self, images: Tensor) -> Tensor:
        """How many objects of each class each place is expected to hold, ``(N, C, h, w)`` at the finest stride, of
        ``(N, 1 or 3, H, W)`` uint8 images, in the order of ``classes``."""
        finest, out = min(kind.stride for kind in KINDS), []
        for some in images.split(AT_ONCE):
            found = torch.zeros(len(some), len(self.classes), *self.places(finest))
            for kind, probability in zip(KINDS, self.head_probabilities(self.compute_maps(some)), strict=True):
                whole = probability.mean(0) * (finest / kind.stride) ** 2
                for within, s in enumerate(kind.scopes):
                    which = self.scope == s
                    if which.any():
                        found[:, which] = F.interpolate(whole[:, within, which], found.shape[2:]).cpu()
            out.append(found)
        return torch.cat(out)

    def embed_from_labels(self, drawn: Examples) -> Tensor:
        """``(N, D)`` features of renders by their labels."""
        visible, pixels = self.counted_from.unbind(1)
        counted = (drawn.visible.unsqueeze(-1) >= visible) & (self.spans(drawn).unsqueeze(-1) >= pixels)
        counted &= drawn.label.unsqueeze(-1) == torch.arange(len(self.classes))
        return self._features(counted.sum(1).float())

    def spans(self, drawn: Examples) -> Tensor:
        """``(N, M)`` the longer side of renders' objects, pixels of what enters."""
        return (drawn.size * self.scale()).amax(-1)

    def embed(self, images: Tensor) -> Tensor:
        """``(N, D)`` features of renders ``(N, 1 or 3, H, W)`` uint8, read."""
        return self._embed(images, False)

    def embed_real(self, images: Tensor) -> Tensor:
        """``(N, D)`` features of images of the target ``(N, 1 or 3, H, W)`` uint8, read by their own rules."""
        return self._embed(images, True)

    @torch.no_grad()
    def _embed(self, images: Tensor, photographs: bool) -> Tensor:
        parts = [self.counts(self.compute_maps(some), photographs) for some in images.split(AT_ONCE)]
        return self._features(torch.cat(parts) if parts else torch.zeros(0, len(self.classes)))

    def _features(self, counts: Tensor) -> Tensor:
        return counts[:, self.order] / self.unit * self.read


def _all_scopes(probability: Tensor) -> Tensor:
    """Counts ``(N, S, R, C)`` by every rule, of ``(N, S, C, h, w)``."""
    return read_all(probability.flatten(0, 1)).unflatten(0, probability.shape[:2])
