"""Reading what is of the whole scene, such as a camera's pitch, the light or the exposure.

Cells say what objects show, and pooling them loses where. So beside their means and maxima, this looks at the image
itself: a coarse picture of it, of how colourful and of how rough it is, and its profiles along rows and columns, in
which a horizon stands higher or lower. Each number enters in its own deviations from a running mean, without which the
few that say something are lost among the others. Axis letters: N images, G sites of scenes, h w cells, E numbers.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .eyes import WIDTH

HIDDEN = 96
PICTURE, PROFILE = (8, 12), 48  # rows and columns of coarse pictures; parts of a profile
SLOWEST, FARTHEST = 0.02, 5.0  # share of a step in the running mean, at least; deviations that enter, at most


class Overall(nn.Module):
    """What is said of the scenes' sites.

    Args:
        sites: G.
        each: how many numbers are said of a site.
    """

    mean: Tensor
    variance: Tensor
    steps: Tensor

    def __init__(self, sites: int, each: int):
        super().__init__()
        enters = 2 * WIDTH + 6 + 5 * PICTURE[0] * PICTURE[1] + 4 * PROFILE
        self.each, self.join = each, nn.Linear(enters, HIDDEN)
        self.out = nn.Linear(HIDDEN, sites * each)
        self.register_buffer("mean", torch.zeros(enters))
        self.register_buffer("variance", torch.ones(enters))
        self.register_buffer("steps", torch.zeros(()))

    def forward(self, images: Tensor, seen: Tensor) -> Tensor:
        """``(N, G, each)``.

        Args:
            images: ``(N, 1 or 3, H, W)``, float32 in 0..1 or uint8.
            seen: ``(N, WIDTH, h, w)``, what cells show.
        """
        x = torch.cat([seen.mean((2, 3)), seen.amax((2, 3)), looks(images)], 1)
        if self.training:
            self._follow(x.detach())
        x = (x - self.mean) / (self.variance + 1e-8).sqrt()
        return self.out(F.relu(self.join(x.clamp(-FARTHEST, FARTHEST)))).unflatten(1, (-1, self.each))

    @torch.no_grad()
    def _follow(self, x: Tensor) -> None:
        """A few images' own mean and variance, as batch norm takes them, would hide how bright each is."""
        self.steps += 1
        share = (1 / self.steps).clamp(min=SLOWEST)
        self.mean.lerp_(x.mean(0), share)
        self.variance.lerp_((x - self.mean).square().mean(0), share)


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
