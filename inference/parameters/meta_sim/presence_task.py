"""A task for the task loss: which classes does an image show?

A small convolutional network is trained from scratch on generated scenes, whose labels come free, and scored on a few
target images of which it is known. Axis letters: N scenes, K labelled images, C H W.
"""

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from probscene.sampling import Scenes

from ...features.base import Examples

SIDE = 128  # pixels that the shorter side is brought to
PLACES = 4  # that features are looked at along each side


class PresenceTask:
    """A ``task.Score``: the mean of the share of present classes that are said to be there, and of the share of absent
    ones that are not, over the labelled images. Guessing gives 0.5.

    Args:
        label: renders scenes and labels them.
        images: ``(K, C, H, W)`` uint8 of the target.
        shown: ``(K, classes)`` bool, which classes each shows.
        epochs, batch, rate: of the network's training.
    """

    def __init__(
        self,
        label: Callable[[Scenes], Examples],
        images: Tensor,
        shown: Tensor,
        epochs: int = 5,
        batch: int = 20,
        rate: float = 2e-3,
    ):
        self.label, self.images, self.shown = label, _entering(images), shown
        self.epochs, self.batch, self.rate = epochs, batch, rate

    def __call__(self, scenes: Scenes) -> float:
        """Train on scenes, and score."""
        drawn, classes = self.label(scenes), self.shown.shape[1]
        images = _entering(drawn.image)
        labels = F.one_hot(drawn.label.where(drawn.label >= 0, classes), classes + 1)
        shown = labels.amax(1)[:, :classes].float()
        with torch.enable_grad():
            net = _network(images.shape[1], classes)
            optimiser = torch.optim.Adam(net.parameters(), lr=self.rate)
            for _ in range(self.epochs):
                for rows in torch.randperm(len(images)).split(self.batch):
                    loss = F.binary_cross_entropy_with_logits(net(images[rows]), shown[rows])
                    optimiser.zero_grad()
                    loss.backward()
                    optimiser.step()
        with torch.no_grad():
            said = torch.cat([net(some) for some in self.images.split(self.batch)]) > 0
        right = [(said == self.shown)[self.shown == there].double().mean() for there in (True, False)]
        return float(sum(right) / 2)


def _entering(images: Tensor) -> Tensor:
    """``(N, C, h, w)`` float32 of uint8."""
    scale = SIDE / min(images.shape[-2:])
    x = images.float() / 255
    return F.interpolate(x, scale_factor=scale, mode="bilinear", antialias=True) if scale < 1 else x


def _network(channels: int, classes: int) -> nn.Module:
    return nn.Sequential(
        nn.Conv2d(channels, 16, 5, stride=2, padding=2),
        nn.ReLU(),
        nn.Conv2d(16, 32, 3, stride=2, padding=1),
        nn.ReLU(),
        nn.Conv2d(32, 64, 3, padding=1),
        nn.ReLU(),
        nn.AdaptiveMaxPool2d(PLACES),
        nn.Flatten(),
        nn.Linear(64 * PLACES**2, classes),
    )
