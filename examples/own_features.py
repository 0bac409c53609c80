"""Features of one's own, in the short form and in the long one; they suit any model with classes.

    probscene fit examples/tabletop.py --target photos/ --out runs/own --features examples/own_features.py:TinyCounts

In Python, ``FitConfig(features=TinyCounts(steps=1000))``. ``Colours`` in its place is the short form.
"""

from collections.abc import Callable

import torch
from torch import Tensor, nn

import probscene as ps
from probscene.inference.features.base import Examples, Photographs, Renders
from probscene.inference.training import TrainingLoop


class Colours:
    """The short form, ``names`` and ``embed``: nothing is trained. Mean and deviation of each colour, in twentieths."""

    names = ("red", "green", "blue", "red deviation", "green deviation", "blue deviation")

    def embed(self, images: Tensor) -> Tensor:
        """Features ``(N, 6)`` of images ``(N, 1 or 3, H, W)`` uint8. A kernel of the density has variance 1."""
        pixels = images.expand(-1, 3, -1, -1).flatten(2) * (20 / 255)
        return torch.cat([pixels.mean(2), pixels.std(2)], 1)


class TinyNet(nn.Module):
    """Three convolutions over a small image; the outputs for each class are added up over all places."""

    def __init__(self, classes: tuple[str, ...]):
        super().__init__()
        self.names = classes
        hidden = nn.Sequential(nn.Conv2d(3, 16, 5, 2, 2), nn.ReLU(), nn.Conv2d(16, 32, 5, 1, 2), nn.ReLU())
        self.places = nn.Sequential(hidden, nn.Conv2d(32, len(classes), 1))

    def forward(self, images: Tensor) -> Tensor:
        small = nn.functional.adaptive_avg_pool2d(images.expand(-1, 3, -1, -1) / 255, 64)
        return self.places(small - 0.5).sum((2, 3)) / 16

    @torch.no_grad()
    def embed(self, images: Tensor) -> Tensor:
        """Features ``(N, classes)``: counts, so that 1 is worth noticing."""
        return self(images)


class TinyCounts(ps.Features):
    """The long form: ``TinyNet``, trained to count what is seen in renders of the prior.

    Args:
        steps: of its training.
    """

    name = "tiny counts"
    resolution = 0.5  # of a count

    def __init__(self, steps: int = 200):
        self.steps = steps

    def build(self, model: ps.SceneModel) -> TinyNet:
        return TinyNet(model.classes)

    def training(
        self, net: TinyNet, renders: Renders, photographs: Callable[[], Photographs], seed: int
    ) -> "TinyTraining":
        return TinyTraining(net, renders, self.steps, seed)


class TinyTraining(TrainingLoop):
    """Adam on the squared error of the counts. ``TrainingLoop`` seeds each step by its number, checks that all stays
    finite and keeps what a training that was interrupted needs to go on to the same bits."""

    subject = "TinyNet"

    def __init__(self, net: TinyNet, renders: Renders, steps: int, seed: int):
        self.net, self.renders = net, renders
        self.adam = torch.optim.Adam(net.parameters(), lr=3e-3)
        super().__init__(net, {"adam": self.adam}, steps, seed)

    def step(self) -> float:
        examples = self.renders.draw(16)
        loss = (self.net(examples.image) - visible_counts(examples, len(self.net.names))).square().mean()
        self.adam.zero_grad()
        loss.backward()
        self.adam.step()
        return loss.item()


def visible_counts(examples: Examples, classes: int) -> Tensor:
    """How many nodes of each class are visible, ``(N, classes)`` float; a label of -1 is none."""
    return (examples.label.unsqueeze(-1) == torch.arange(classes)).sum(1).float()
