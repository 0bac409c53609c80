"""What a reader sees of an image: channels on a fine grid of cells.

Of renders, the convolutions of the count network, trained further. Of photographs, the frozen maps that counts are read
from, which differ less between renders and photographs than anything trained on renders; and each cell's mean colour
and contrast, which such maps keep badly. Axis letters: N images, h w cells.
"""

import copy
from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from probscene.device import device_of

from ..features.base import FeatureNet, enter
from ..features.counting.batches import images_per_step
from ..features.counting.net import IMAGES_AT_ONCE, CountNet, conv, images_at_once, layers

WIDTH = 64  # channels
STRIDE = 4  # pixels of a reduced image a cell
FINEST = 8  # pixels of what enters a pretrained network a cell
DROPPED, SHIFT = 0.1, 0.2  # of the maps' channels that are left out; deviation of what is added to one, in its own


class Backbone(nn.Module):
    """``forward`` gives ``(N, WIDTH, h, w)`` of what ``enter`` gives.

    Attributes:
        cell: ``(2,)`` pixels of the image that a cell spans, along x and y.
        pretrained_parts: parts that know much already, and are trained slowly.
        is_random: whether it draws random numbers while it is trained.
        at_once: how many images it is shown together when it does not learn.
    """

    cell: Tensor
    pretrained_parts: tuple[nn.Module, ...] = ()
    is_random = False
    at_once = IMAGES_AT_ONCE

    def enter(self, images: Tensor) -> Tensor:
        """Of ``(N, 1 or 3, H, W)`` uint8 images."""
        raise NotImplementedError

    def images_per_step(self, most: int) -> int:
        """How many images it is shown in a step of its training, at most ``most``."""
        return most

    @staticmethod
    def from_feature_net(net: FeatureNet) -> "Backbone | None":
        """That which suits what structure was learnt by; None where nothing does."""
        if isinstance(net, CountNet):
            return RenderBackbone(net)
        return PhotographBackbone(net) if isinstance(net, FrozenMaps) else None


class RenderBackbone(Backbone):
    """On a copy of a count network's convolutions, which know the classes."""

    def __init__(self, counts: CountNet):
        super().__init__()
        self.channels, self.reduce, self.area = counts.channels, counts.reduce, counts.area
        fine, coarse, (b, c) = counts.stages()
        self.fine, self.coarse = copy.deepcopy(fine), copy.deepcopy(coarse)
        self.side, self.down = nn.Conv2d(b, WIDTH, 1, bias=False), nn.Conv2d(c, WIDTH, 1, bias=False)
        self.both = nn.Sequential(nn.BatchNorm2d(WIDTH), nn.ReLU(inplace=True), *conv(WIDTH, WIDTH, 3, 1))
        self.cell = torch.full((2,), float(STRIDE * self.reduce))
        self.at_once = images_at_once(self.area)
        self.pretrained_parts = self.fine, self.coarse
        self.to(device_of(counts))

    def enter(self, images: Tensor) -> Tensor:
        """Reduced images, padded to whole cells."""
        x = enter(images, self.channels, self.reduce)
        return F.pad(x, (0, -x.shape[-1] % (2 * STRIDE), 0, -x.shape[-2] % (2 * STRIDE)))

    def images_per_step(self, most: int) -> int:
        """See ``Backbone``; fewer where they are large."""
        return images_per_step(most, self.area)

    def forward(self, x: Tensor) -> Tensor:
        """See ``Backbone``."""
        fine = layers(self.fine, x)
        coarse = F.interpolate(self.down(self.coarse(fine)), scale_factor=2, mode="nearest")
        return self.both(self.side(fine) + coarse)


@runtime_checkable
class FrozenMaps(Protocol):
    """A ``FeatureNet`` on the maps of a pretrained network: ``PretrainedCountNet``, which takes seconds to import."""

    @property
    def map_channels(self) -> Sequence[int]:
        """Of each map."""
        ...

    @property
    def device(self) -> torch.device:
        """Where its maps are."""
        ...

    def compute_maps(self, images: Tensor) -> list[Tensor]:
        """Maps ``(N, c, h, w)`` of ``(N, C, H, W)`` uint8 images."""
        ...

    def normalise(self, maps: list[Tensor]) -> list[Tensor]:
        """The maps, each channel of mean 0 and standard deviation 1 in the target."""
        ...

    def places(self, stride: int) -> tuple[int, int]:
        """Height and width of a grid with a cell every ``stride`` pixels of what enters."""
        ...

    def scale(self) -> Tensor:
        """``(2,)`` pixels of what enters a pixel of the image, along x and y."""
        ...


class PhotographBackbone(Backbone):
    """On frozen maps.

    Args:
        net: trained.
    """

    is_random = True

    def __init__(self, net: FrozenMaps):
        super().__init__()
        self.net = (net,)  # not a submodule: its state is the run's
        self.sides = nn.ModuleList(nn.Conv2d(number, WIDTH, 1, bias=False) for number in net.map_channels)
        self.colours = nn.Conv2d(6, WIDTH, 1, bias=False)
        self.both = nn.Sequential(nn.BatchNorm2d(WIDTH), nn.ReLU(inplace=True), *conv(WIDTH, WIDTH, 3, 1))
        self.cell = FINEST / net.scale()
        self.to(net.device)

    def enter(self, images: Tensor) -> Tensor:
        """As they are."""
        return images

    def forward(self, x: Tensor) -> Tensor:
        """See ``Backbone``."""
        net = self.net[0]
        maps, size = net.normalise(net.compute_maps(x)), net.places(FINEST)
        if self.training:
            shifted = (some + SHIFT * torch.randn(*some.shape[:2], 1, 1).to(some.device) for some in maps)
            maps = [F.dropout2d(some, DROPPED) for some in shifted]
        # On the CPU: MPS does not pool to parts of unequal size.
        seen = self.colours(cell_colours(x.cpu(), size).to(net.device))
        for side, some in zip(self.sides, maps, strict=True):
            seen = seen + F.interpolate(side(some), size, mode="bilinear")
        return self.both(seen)


def cell_colours(images: Tensor, size: tuple[int, int]) -> Tensor:
    """``(N, 6, h, w)`` mean and standard deviation of each channel in each cell, of ``(N, 1 or 3, H, W)`` uint8."""
    x = images.float().expand(-1, 3, -1, -1) / 128 - 1
    mean = F.adaptive_avg_pool2d(x, size)
    spread = (F.adaptive_avg_pool2d(x.square(), size) - mean.square()).clamp(min=1e-6).sqrt()
    return torch.cat([mean, 3 * spread], 1)
