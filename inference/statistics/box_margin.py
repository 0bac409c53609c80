"""How much room labels leave around objects, whose edges are in their boxes.

An object's contrast is how far its pixels are from the light around it, in the mean of a ring around the middle of its
box, which is stretched to a square:

    c(r), r = 1 at the middle of the box's edges

Renders' boxes touch their objects. Where labels' are s times as wide, their contrast is the renders' at s r, whatever
the size of the objects; s is fitted by least squares, with a gain and an offset, since light and noise differ. Axis
letters: N images, M boxes of one, C H W, n boxes that can be used, R rings, B resamples.
"""

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import grid_sample

Array = NDArray[np.float64]

REACH, SIDE, RINGS = 1.5, 60, 25  # of a ring, in half box sides; pixels of a stretched box; rings
AROUND = 1.2  # from which ring on the light around is taken
MAX_COVERED = 0.1  # of a box by another one
SCALES = np.linspace(0.6, 2.2, 161)
USED = 1.35  # the largest ring that is compared; beyond it others' edges come in
MIN_BOXES = 8  # of a class
MIN_EXPLAINED = 0.9  # of the variance of c over r: with less the two look too different to compare
MIN_MARGIN = 1.0  # pixels, from which on there is one
RESAMPLES = 200


class EdgeProfiles(NamedTuple):
    """Contrast of objects from the middle of their boxes to beyond the edges.

    Attributes:
        image: ``(n,)`` int64 the number of the image of each.
        label: ``(n,)`` int64 its class.
        side: ``(n,)`` the square root of its box's area, pixels.
        contrast: ``(n, R)``.
    """

    image: NDArray[np.int64]
    label: NDArray[np.int64]
    side: Array
    contrast: Array


class MarginEstimate(NamedTuple):
    """By how much labels of one class are wider than their objects.

    Attributes:
        scale: how many times.
        pixels: on each side, of the median box; ``low`` and ``high`` its 90 % limits, of a bootstrap over the images of
            labels and renders.
    """

    scale: float
    pixels: float
    low: float
    high: float

    def resized(self, factor: float) -> "MarginEstimate":
        """In images that are so many times as large."""
        return self._replace(pixels=self.pixels * factor, low=self.low * factor, high=self.high * factor)

    def __str__(self) -> str:
        return f"{self.pixels:.1f} ({self.low:.1f} to {self.high:.1f})"


def edge_profiles(images: Tensor, box: Tensor, label: Tensor) -> EdgeProfiles:
    """Of images ``(N, 1 or 3, H, W)`` uint8 the objects in boxes ``(N, M, 4)``, x0 y0 x1 y1 in pixels, of classes
    ``label (N, M)`` int64, -1 for none; without those that touch the image's edge or are covered by another's box."""
    image, node = _whole(box, label, images.shape[2:]).nonzero().unbind(1)
    ring = _rings()
    share = (ring.flatten()[:, None] == torch.arange(RINGS)).float()  # of a ring, that each pixel is
    share /= share.sum(0)
    contrast = torch.zeros(len(image), RINGS, dtype=torch.float64)
    for i in image.unique().tolist():
        of = image == i
        patch = _stretched(images[i], box[i, node[of]])  # (n, C, SIDE, SIDE)
        ground = patch[:, :, ring >= AROUND * RINGS / REACH].median(-1).values
        off = (patch - ground[..., None, None]).abs().mean(1)
        contrast[of] = (off.flatten(1) @ share).double()
    extent = box[image, node, 2:] - box[image, node, :2]
    side = extent.prod(1).sqrt().double()
    return EdgeProfiles(image.numpy(), label[image, node].numpy(), side.numpy(), contrast.numpy())


def estimate_margin(labels: EdgeProfiles, renders: EdgeProfiles, label: int) -> MarginEstimate | None:
    """Of one class; None where labels leave no room, or nobody can say."""
    own, there = labels.label == label, renders.label == label
    if min(own.sum(), there.sum()) < MIN_BOXES:
        return None
    rng = np.random.default_rng(0)
    sides = [_resampled(each.image[of], each.contrast[of], rng) for each, of in ((labels, own), (renders, there))]
    found = np.array([_scale(contrast, touching) for contrast, touching in zip(*sides, strict=True)])
    scale, explained = found.T
    pixels = np.median(labels.side[own]) * (1 - 1 / scale) / 2
    low, high = np.quantile(pixels[1:], [0.05, 0.95])
    if explained[0] < MIN_EXPLAINED or pixels[0] < MIN_MARGIN or low <= 0:
        return None
    return MarginEstimate(float(scale[0]), float(pixels[0]), float(low), float(high))


def _resampled(image: NDArray[np.int64], contrast: Array, rng: np.random.Generator) -> Array:
    """``(1 + B, R)`` the mean of all contrasts ``(n, R)``, then those of resamples of the images."""
    numbers, row = np.unique(image, return_inverse=True)
    total = np.zeros((len(numbers), contrast.shape[1]))
    np.add.at(total, row, contrast)
    boxes = np.bincount(row)
    drawn = rng.multinomial(len(numbers), np.full(len(numbers), 1 / len(numbers)), RESAMPLES)
    weight = np.concatenate([np.ones((1, len(numbers)), np.int64), drawn])
    return (weight @ total) / (weight @ boxes)[:, None]


def _scale(contrast: Array, touching: Array) -> tuple[float, float]:
    """By how much a contrast ``(R,)`` is wider than ``touching (R,)``, and the share of its variance that this
    explains."""
    radius = (np.arange(RINGS) + 0.5) * REACH / RINGS
    used = radius < USED
    x = np.interp(SCALES[:, None] * radius[used], radius, touching)
    x, y = x - x.mean(1, keepdims=True), contrast[used] - contrast[used].mean()
    common = (x @ y).clip(min=0)  # a negative gain is none
    explained = np.square(common) / np.maximum(np.square(x).sum(1) * np.square(y).sum(), 1e-12)
    best = explained.argmax()
    return float(SCALES[best]), float(explained[best])


def _whole(box: Tensor, label: Tensor, shape: torch.Size) -> Tensor:
    """``(N, M)`` bool: boxes inside their image that are not covered by another one."""
    there, (height, width) = label >= 0, shape
    inside = (box[..., :2] >= 1).all(-1) & (box[..., 2:] <= torch.tensor([width, height]) - 1).all(-1)
    low = torch.maximum(box[:, :, None, :2], box[:, None, :, :2])
    high = torch.minimum(box[:, :, None, 2:], box[:, None, :, 2:])
    common = (high - low).clamp(min=0).prod(-1) * (there[:, :, None] & there[:, None])
    common.diagonal(dim1=1, dim2=2).zero_()
    area = (box[..., 2:] - box[..., :2]).clamp(min=0).prod(-1)
    covered = common.amax(-1) if box.shape[1] else torch.zeros_like(area)
    return there & inside & (area > 0) & (covered <= MAX_COVERED * area)


def _rings() -> Tensor:
    """``(SIDE, SIDE)`` int64 the ring of each pixel; ``RINGS`` and more in the corners."""
    at = ((torch.arange(SIDE) + 0.5) / SIDE * 2 - 1) * REACH
    return (torch.hypot(at[:, None], at[None]) * RINGS / REACH).long()


def _stretched(image: Tensor, box: Tensor) -> Tensor:
    """``(n, C, SIDE, SIDE)`` float32: what boxes ``(n, 4)`` of an image ``(C, H, W)`` show, and what is around."""
    height, width = image.shape[1:]
    at = ((torch.arange(SIDE) + 0.5) / SIDE * 2 - 1) * REACH
    middle, half = (box[:, :2] + box[:, 2:]) / 2, (box[:, 2:] - box[:, :2]) / 2
    x, y = (middle[:, i, None] + half[:, i, None] * at for i in (0, 1))  # (n, SIDE) each
    grid = torch.stack(torch.broadcast_tensors(x[:, None] / width, y[:, :, None] / height), -1) * 2 - 1
    whole = image.float().expand(len(box), -1, -1, -1)
    return grid_sample(whole, grid.float(), padding_mode="reflection", align_corners=False)
