"""A network that counts: how many objects of each class an image shows, wherever they stand.

It is fully convolutional and thus indifferent to place. Every cell of a coarse map holds a distribution over background
and classes, and an object spreads one unit over the four cells nearest to its centre. The features are the sums of the
map: a soft count of each class, and their total. Where the model counts by groups they are the number of groups and the
soft counts in each of them, in order; three more channels then say whether a cell shows a group, where that group's
middle is, and where the middle of the group is that the cell's object belongs to (``grouping``). ``training`` trains
it.

The paper has a network of presences instead (``presence``), which keeps less of the structure and learns more slowly.
"""

import copy
import math
from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from probscene.device import device_of
from probscene.model import Groups

from ..base import enter
from .grouping import tally_groups

STRIDE = 8  # pixels of the reduced image a cell
IMAGES_AT_ONCE, PIXELS_AT_ONCE = 64, 64 * 256**2  # images, and pixels of reduced ones, looked at together
BORDER = STRIDE // 2  # clear pixels around a reduced image, so that objects at its edge have cells on either side


class CountNet(nn.Module):
    """Soft counts of the classes and their total, D = classes + 1; of groups, D = 1 + (classes - 1) * max_groups.

    Args:
        classes: the kinds that are counted.
        channels: of the image, 1 or 3.
        canvas: height and width of the images; they are reduced by 2, 4 or 8 to about 128, unless ``fit_to`` says less.
        width: channels at strides 2, 4 and 8.
        blocks: residual blocks at strides 4 and 8.
        groups: by what objects are counted; over the whole image where None.
        rounding: whether features are drawn toward whole numbers.

    Attributes:
        unit: objects that 1 in a feature stands for.
        classes: what ``cells`` tells apart.
    """

    unit = 1.0
    reduction: Tensor
    group_cells: Tensor

    def __init__(
        self,
        classes: tuple[str, ...],
        channels: int,
        canvas: tuple[int, int],
        width: tuple[int, int, int] = (16, 32, 64),
        blocks: tuple[int, int] = (1, 1),
        groups: Groups | None = None,
        rounding: bool = True,
    ):
        super().__init__()
        self.groups, self.rounding = groups, rounding
        self.group_class = -1 if groups is None else classes.index(groups.kind)
        self.objects = tuple(name for i, name in enumerate(classes) if i != self.group_class)
        self.names = (*classes, "total")
        if groups is not None:
            each = (f"{name} {number + 1}" for number in range(groups.max_groups) for name in self.objects)
            self.names = (groups.kind, *each)
        self.channels, self.canvas, self.classes = channels, canvas, classes
        reduction = min(8, 2 ** max(0, round(math.log2(max(canvas) / 128))))
        self.register_buffer("reduction", torch.tensor(reduction))
        a, b, c = width
        self.body = nn.Sequential(
            *conv(channels, a, 5, 2),
            *conv(a, b, 3, 2),
            *(Residual(b) for _ in range(blocks[0])),
            *conv(b, c, 3, 2),
            *(Residual(c) for _ in range(blocks[1])),
            nn.Conv2d(c, 1 + len(self.objects) + (0 if groups is None else 3), 1),
        )
        self.register_buffer("group_cells", torch.ones(()))  # cells that an ordinary group covers
        with torch.no_grad():  # start from "nothing here", which nearly every cell holds
            last = cast(nn.Conv2d, self.body[-1])
            last.weight.mul_(0.3)
            bias = cast(Tensor, last.bias)
            bias.zero_()
            bias[0] = 3.0
        self._fused: nn.Module | None = None

    def place(self, device: torch.device) -> None:
        """See ``Placeable``."""
        self._fused = None
        self.to(device)

    @property
    def reduce(self) -> int:
        """By how much images are reduced."""
        return int(self.reduction)

    @property
    def area(self) -> float:
        """Pixels of a reduced image."""
        return math.prod(self.canvas) / self.reduce**2

    def stages(self) -> tuple[nn.Sequential, nn.Sequential, tuple[int, int]]:
        """Its convolutions to stride 4 and from there to stride 8, and how many channels each gives."""
        parts = list(self.body)[:-1]
        second = [i for i, part in enumerate(parts) if isinstance(part, nn.Conv2d)][2]
        fine, coarse = parts[:second], parts[second:]
        between = cast(nn.Conv2d, parts[second])
        return nn.Sequential(*fine), nn.Sequential(*coarse), (between.in_channels, between.out_channels)

    def fit_to(self, size: float) -> None:
        """Reduce images so much less that objects of ``size`` pixels keep 6: below that too many share a cell."""
        while self.reduce > 1 and size / self.reduce < 6:
            self.reduction //= 2

    def forward(self, x: Tensor) -> Tensor:
        """Logits of the cells ``(N, 1 + objects, h, w)`` of reduced images ``x (N, C, 8h, 8w)``.

        If there are groups, three more channels: the logit that a cell shows a group, how many cells away that group's
        middle is, and how many that of the group of the object that the cell holds.
        """
        return layers(self.body, x)

    def enter(self, images: Tensor) -> Tensor:
        """Reduced images with a clear border, padded to whole cells."""
        x = enter(images, self.channels, self.reduce)
        right, below = ((-n - 2 * BORDER) % STRIDE + BORDER for n in (x.shape[-1], x.shape[-2]))
        return F.pad(x, (BORDER, right, BORDER, below))

    @torch.no_grad()
    def embed(self, images: Tensor) -> Tensor:
        """``(N, D)`` soft counts of ``(N, 1 or 3, H, W)`` uint8 images."""
        if self._fused is None:
            self._fused = _fuse(self.body)
        out, device = [], device_of(self)
        for some in images.split(images_at_once(self.area)):
            x = self.enter(some.to(device)).contiguous(memory_format=torch.channels_last)
            out.append(self._read(self._fused(x)).cpu())
        soft = torch.cat(out) if out else torch.zeros(0, len(self.names))
        return toward_whole(soft) if self.rounding else soft

    @torch.no_grad()
    def cells(self, images: Tensor) -> Tensor:
        """How many objects of each class each cell is expected to hold, ``(N, C, h, w)``, of ``(N, 1 or 3, H, W)``
        uint8 images, in the order of ``classes``; of a group, what part of an ordinary one."""
        number, out, device = 1 + len(self.objects), [], device_of(self)
        for some in images.split(images_at_once(self.area)):
            logits = self(self.enter(some.to(device)))
            found = dict(zip(self.objects, logits[:, :number].softmax(1)[:, 1:].unbind(1), strict=True))
            if self.groups is not None:
                found[self.groups.kind] = logits[:, number].sigmoid() / self.group_cells
            out.append(torch.stack([found[name] for name in self.classes], 1).cpu())
        return torch.cat(out)

    def _read(self, logits: Tensor) -> Tensor:
        number = 1 + len(self.objects)
        objects = logits[:, :number].softmax(1)[:, 1:]
        if self.groups is None:
            counts = objects.sum((2, 3))
            return torch.cat([counts, counts.sum(1, keepdim=True)], 1)
        height, width = logits.shape[2:]
        size = height if self.groups.along == "y" else width
        here = torch.arange(size, device=logits.device) + 0.5
        here = here.view(-1, 1) if self.groups.along == "y" else here
        surface, way, pull = logits[:, number:].unbind(1)
        votes = STRIDE * (here + way), STRIDE * (here + pull)
        length, mass, number = size * STRIDE, float(self.group_cells), self.groups.max_groups
        return tally_groups(objects, surface.sigmoid(), *votes, length, mass, number)

    def train(self, mode: bool = True) -> "CountNet":
        """As in torch; what inference has fused is made anew."""
        self._fused = None
        return super().train(mode)


def images_at_once(area: float) -> int:
    """How many images a network that does not learn is shown together: fewer where reduced ones have a large area."""
    return max(1, min(IMAGES_AT_ONCE, int(PIXELS_AT_ONCE / area)))


def toward_whole(counts: Tensor) -> Tensor:
    """Soft counts drawn toward the nearest whole number, smoothly and in order: ``x - sin(2 pi x) / (2 pi)``.

    Objects unlike any in the prior's renders count a few hundredths less each; what adds up over an image is taken back
    here, so that an image of seven is like a render of seven and not like a mixture of six and seven. It serves counts
    whose errors are far below one half. It makes others worse, as readings near a whole number become alike.
    """
    return counts - torch.sin(2 * math.pi * counts) / (2 * math.pi)


def layers(body: nn.Sequential, x: Tensor) -> Tensor:
    """What a body, or its first layers, make of reduced images ``x (N, C, 8h, 8w)``."""
    if x.shape[1] > 1:
        return body(x.contiguous(memory_format=torch.channels_last))
    first = body[0]
    assert isinstance(first, nn.Conv2d)
    return body[1:](_halve(x, first.weight))


def _halve(x: Tensor, weight: Tensor) -> Tensor:
    """The 5 x 5 convolution at stride 2 of grey images ``(N, 1, H, W)``, as one of 3 x 3 at stride 1 of their blocks of
    2 x 2: with its gradient it takes two fifths of the time where there is AVX2 alone."""
    blocks = F.pixel_unshuffle(x, 2).contiguous(memory_format=torch.channels_last)
    return F.conv2d(blocks, F.pixel_unshuffle(F.pad(weight, (0, 1, 0, 1)), 2), padding=1)


def conv(inner: int, outer: int, size: int, stride: int) -> list[nn.Module]:
    convolution = nn.Conv2d(inner, outer, size, stride, size // 2, bias=False)
    return [convolution, nn.BatchNorm2d(outer), nn.ReLU(inplace=True)]


class Residual(nn.Module):
    def __init__(self, width: int):
        super().__init__()
        self.a, self.b = nn.Sequential(*conv(width, width, 3, 1)), nn.Sequential(*conv(width, width, 3, 1)[:2])
        nn.init.zeros_(cast(nn.BatchNorm2d, self.b[1]).weight)

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(x + self.b(self.a(x)), inplace=True)


def _fuse(body: nn.Module) -> nn.Module:
    """A copy for inference with every batch norm folded into the convolution before it."""
    fused = copy.deepcopy(body).eval()
    for parent in [m for m in fused.modules() if isinstance(m, nn.Sequential)]:
        for i, (first, second) in enumerate(zip(list(parent), list(parent)[1:], strict=False)):
            if isinstance(first, nn.Conv2d) and isinstance(second, nn.BatchNorm2d):
                parent[i], parent[i + 1] = fuse_conv_bn_eval(first, second), nn.Identity()
    return fused.to(memory_format=torch.channels_last)
