"""What a photographer would say of images: light, colour, sharpness and noise. Photographs and renders, which a network
sees as two worlds, are on one scale here. Axis letters: N images, D numbers."""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

ROWS = 8  # parts of an image from top to bottom
FINE = 10.0  # noise and edges are so many times smaller than light
AT_ONCE = 8  # images, so that they stay in the processor's cache from one number to the next


def image_statistics(images: Tensor) -> Tensor:
    """``(N, D)`` of ``(N, 1 or 3, H, W)`` uint8 images, all about 0 to 1: mean and deviation of each colour, brightness
    of each part from top to bottom, saturation, how strong edges are, and noise, by the Laplacian [1].

    References:
        [1] Immerkær, *Fast noise variance estimation*, Computer Vision and Image Understanding 1996.
    """
    return torch.cat([_plain(some) for some in images.split(AT_ONCE)])


def _plain(images: Tensor) -> Tensor:
    x = images.expand(-1, 3, -1, -1).contiguous() / 255
    red, green, blue = x.unbind(1)
    grey, most, least = (red + green + blue) / 3, red.maximum(green).maximum(blue), red.minimum(green).minimum(blue)
    right, down = grey.diff(dim=2), grey.diff(dim=1)
    edges = right.abs().mean((1, 2)) + down.abs().mean((1, 2))
    rough = right.diff(dim=2).diff(dim=1).diff(dim=1).abs().mean((1, 2))  # [1, -2, 1] along either axis
    saturation = ((most - least) / most.clamp(min=1 / 255)).mean((1, 2))
    rows = F.adaptive_avg_pool2d(grey.unsqueeze(1), (ROWS, 1)).flatten(1)
    fine = torch.stack([saturation, FINE * edges, FINE * math.sqrt(math.pi / 2) / 6 * rough], 1)
    mean = x.mean((2, 3), keepdim=True)
    deviation = (x - mean).square().mean((2, 3)).sqrt()  # std takes twice as long as the rest
    return torch.cat([mean.flatten(1), deviation, rows, fine], 1)
