"""Reading what is of the whole scene, such as a camera's pitch, the light or the exposure.

Cells say what objects show, and pooling them loses where. So this looks at the image itself: a coarse picture of it, of
how colourful and of how rough it is, and its profiles along rows and columns, in which a horizon stands high or low.
Axis letters: N images, G sites of scenes, E numbers.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

HIDDEN, DROPOUT = 96, 0.2
PICTURE, PROFILE = (16, 24), 48  # rows and columns of coarse pictures; parts of a profile
NUM_FEATURES = 6 + 5 * PICTURE[0] * PICTURE[1] + 4 * PROFILE
MAX_DEVIATIONS = 5.0  # deviations that enter, at most


class GlobalHead(nn.Module):
    """A head for the scenes' sites.

    Args:
        sites: G.
        outputs: numbers a site.
    """

    mean: Tensor
    deviation: Tensor

    def __init__(self, sites: int, outputs: int):
        super().__init__()
        self.sites, self.outputs, self.drop = sites, outputs, nn.Dropout(DROPOUT)
        self.join, self.out = nn.Linear(NUM_FEATURES, HIDDEN), nn.Linear(HIDDEN, sites * outputs)
        self.register_buffer("mean", torch.zeros(NUM_FEATURES))
        self.register_buffer("deviation", torch.zeros(NUM_FEATURES))

    def forward(self, images: Tensor) -> Tensor:
        """``(N, G, outputs)`` of ``(N, 1 or 3, H, W)`` images, float32 in 0..1 or uint8."""
        return self.from_features(global_features(images))

    def from_features(self, x: Tensor) -> Tensor:
        """``(N, G, outputs)`` of ``global_features``."""
        x = (x - self.mean) / (self.deviation + 1e-4)
        hidden = F.relu(self.join(self.drop(x.clamp(-MAX_DEVIATIONS, MAX_DEVIATIONS))))
        return self.out(hidden).unflatten(1, (-1, self.outputs))

    def fit_normalisation(self, x: Tensor) -> None:
        """Take the mean and the deviation of numbers that enter from these, if from none before."""
        if not self.deviation.any():
            self.mean.copy_(x.mean(0))
            self.deviation.copy_(x.std(0))


def global_features(images: Tensor) -> Tensor:
    """``(N, E)`` of ``(N, 1 or 3, H, W)`` images, see above."""
    x = (images if images.is_floating_point() else images / 255).expand(-1, 3, -1, -1)
    grey, colour = x.mean(1, keepdim=True), x.amax(1, keepdim=True) - x.amin(1, keepdim=True)
    right = F.pad((grey[..., 1:] - grey[..., :-1]).abs(), (0, 1))
    down = F.pad((grey[..., 1:, :] - grey[..., :-1, :]).abs(), (0, 0, 0, 1))
    parts = [x.mean((2, 3)), x.std((2, 3)), F.adaptive_avg_pool2d(torch.cat([x, colour, right], 1), PICTURE).flatten(1)]
    for size in ((PROFILE, 1), (1, PROFILE)):
        parts.append(F.adaptive_avg_pool2d(torch.cat([grey, down], 1), size).flatten(1))
    return torch.cat(parts, 1)
