"""Reading what is of the whole scene, such as a camera's pitch, the light or the exposure.

Cells say what objects show, and pooling them loses where. So this looks at the image itself: a coarse picture of it, of
how colourful and of how rough it is, and its profiles along rows and columns, in which a horizon stands high or low.
Axis letters: N images, G sites of scenes, E numbers.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

HIDDEN, DROPPED = 96, 0.2
PICTURE, PROFILE = (16, 24), 48  # rows and columns of coarse pictures; parts of a profile
NUMBERS = 6 + 5 * PICTURE[0] * PICTURE[1] + 4 * PROFILE
FARTHEST = 5.0  # deviations that enter, at most


class GlobalHead(nn.Module):
    """What is said of the scenes' sites.

    Args:
        sites: G.
        each: how many numbers are said of a site.
        dropped: share of what enters that is left out in training.
    """

    mean: Tensor
    deviation: Tensor

    def __init__(self, sites: int, each: int, dropped: float = DROPPED):
        super().__init__()
        self.sites, self.each, self.drop = sites, each, nn.Dropout(dropped)
        self.join, self.out = nn.Linear(NUMBERS, HIDDEN), nn.Linear(HIDDEN, sites * each)
        self.register_buffer("mean", torch.zeros(NUMBERS))
        self.register_buffer("deviation", torch.zeros(NUMBERS))

    def forward(self, images: Tensor) -> Tensor:
        """``(N, G, each)`` of ``(N, 1 or 3, H, W)`` images, float32 in 0..1 or uint8."""
        return self.said(looks(images))

    def said(self, x: Tensor) -> Tensor:
        """``(N, G, each)`` of ``looks``."""
        x = (x - self.mean) / (self.deviation + 1e-4)
        return self.out(F.relu(self.join(self.drop(x.clamp(-FARTHEST, FARTHEST))))).unflatten(1, (-1, self.each))

    def follow(self, x: Tensor) -> None:
        """Take the mean and the deviation of numbers that enter from these, if from none before."""
        if not self.deviation.any():
            self.mean.copy_(x.mean(0))
            self.deviation.copy_(x.std(0))


def looks(images: Tensor) -> Tensor:
    """``(N, E)`` of ``(N, 1 or 3, H, W)`` images, see above."""
    x = (images if images.is_floating_point() else images / 255).expand(-1, 3, -1, -1)
    grey, colour = x.mean(1, keepdim=True), x.amax(1, keepdim=True) - x.amin(1, keepdim=True)
    right = F.pad((grey[..., 1:] - grey[..., :-1]).abs(), (0, 1))
    down = F.pad((grey[..., 1:, :] - grey[..., :-1, :]).abs(), (0, 0, 0, 1))
    parts = [x.mean((2, 3)), x.std((2, 3)), F.adaptive_avg_pool2d(torch.cat([x, colour, right], 1), PICTURE).flatten(1)]
    for size in ((PROFILE, 1), (1, PROFILE)):
        parts.append(F.adaptive_avg_pool2d(torch.cat([grey, down], 1), size).flatten(1))
    return torch.cat(parts, 1)
