"""One head: a small network that says what the places of an image hold.

Heads whose places are 16 pixels apart read strides of 16 and 32: what they count, they count more alike in renders and
photographs. Those 8 pixels apart see stride 8 beside them, and small objects. Axis letters: N images, C classes, h w
places.
"""

from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .reading import SCOPES

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
        teaches: whether it learns from what it reads in photographs, see ``training``.
    """

    stride: int
    scopes: tuple[int, ...]
    hidden: int
    dropped: float
    shift: float
    teaches: bool


def _of(stride: int) -> tuple[int, ...]:
    return tuple(s for s, scope in enumerate(SCOPES) if scope.stride == stride)


# Texture, which is in the finest maps, differs most between renders and photographs.
KINDS = (Kind(16, _of(16), 64, 0.2, 0.2, True), Kind(8, _of(8), 32, 0.35, 0.5, False))


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
