"""The paper's feature networks: which classes an image shows, or how many objects of each (Meta-Sim2, supplement).

Six residual blocks of two 3x3 convolutions with batch norm and leaky ReLU, average pooling, three fully connected
layers; binary presences under sigmoid cross-entropy, for Aerial 2D one-hot counts under cross-entropy. The features are
the average pool and the first two fully connected layers. Widths are not given in the paper and are arguments here;
grey images are copied to three channels.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from probscene.device import device_of
from probscene.model import SceneModel
from probscene.sampling import seed_everything

from ..training import Callback, TrainingLoop, batch_seed
from .base import Draw, Examples, Features, Photographs, Renders

PRESENCE, PRESENCE_COUNTS = "presence", "presence=counts"
NUM_COUNTS = 25  # of the paper's counts
NHWC = torch.channels_last  # in memory; half as fast again on a CPU


class PresenceNet(nn.Module):
    """Features: average pool, first and second fully connected layer, D = 4 width + 2 hidden.

    Args:
        classes: whose presence is learnt.
        width: channels of the first two blocks; the next two have twice, the last two four times as many.
        hidden: units of the first two fully connected layers.
        ways: numbers that are told apart of each class, 0, 1, ... and so many or more; 0 for presence alone.
    """

    def __init__(self, classes: tuple[str, ...], width: int = 8, hidden: int = 64, ways: int = 0):
        super().__init__()
        self.ways = ways
        widths = [width, width, 2 * width, 2 * width, 4 * width, 4 * width]
        inner = [3, *widths[:-1]]
        self.blocks = nn.Sequential(*(_Block(i, o) for i, o in zip(inner, widths, strict=True)))
        self.fc1, self.fc2 = nn.Linear(widths[-1], hidden), nn.Linear(hidden, hidden)
        self.out = nn.Linear(hidden, len(classes) * max(ways, 1))
        self.names = tuple(
            [f"pool_{i}" for i in range(widths[-1])] + [f"fc{j}_{i}" for j in (1, 2) for i in range(hidden)]
        )

    def place(self, device: torch.device) -> None:
        """See ``Placeable``."""
        self.to(device)

    def layers(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Features ``(N, D)`` and logits, ``(N, classes)`` or ``(N, classes, ways)``, of uint8 images ``(N, 1 or 3, H,
        W)``."""
        images = images.to(device_of(self))
        pool = self.blocks(images.expand(-1, 3, -1, -1).contiguous(memory_format=NHWC).float() / 255).mean((2, 3))
        first = F.leaky_relu(self.fc1(pool), 0.01)
        second = F.leaky_relu(self.fc2(first), 0.01)
        logits = self.out(second)
        return torch.cat([pool, first, second], 1), logits.unflatten(1, (-1, self.ways)) if self.ways else logits

    @torch.no_grad()
    def embed(self, images: Tensor) -> Tensor:
        """``(N, D)`` features of ``(N, 1 or 3, H, W)`` uint8 images."""
        parts = [self.layers(some)[0].cpu() for some in images.split(50)]
        return torch.cat(parts) if parts else torch.zeros(0, len(self.names))


class _Block(nn.Module):
    """Halves the image; a 1x1 convolution carries the shortcut."""

    def __init__(self, inner: int, outer: int):
        super().__init__()
        self.a, self.na = nn.Conv2d(inner, outer, 3, 2, 1, bias=False), nn.BatchNorm2d(outer)
        self.b, self.nb = nn.Conv2d(outer, outer, 3, 1, 1, bias=False), nn.BatchNorm2d(outer)
        self.shortcut = nn.Conv2d(inner, outer, 1)

    def forward(self, x: Tensor) -> Tensor:
        y = F.leaky_relu(self.na(self.a(x)), 0.01)
        # Not a stride in the convolution: with 3 channels, last in memory, torch 2.14 then writes outside its buffers.
        return F.leaky_relu(self.nb(self.b(y)) + self.shortcut(x[..., ::2, ::2].contiguous(memory_format=NHWC)), 0.01)


@dataclass(frozen=True)
class PresenceFeatures(Features):
    """The paper's network, ``PresenceNet``, trained on the prior's renders.

    Args:
        images, epochs: of its training.
        width, hidden: see ``PresenceNet``.
        counts: it learns how many objects there are of each class, as for the paper's Aerial 2D.
    """

    images: int = 5000
    epochs: int = 10
    width: int = 8
    hidden: int = 64
    counts: bool = False

    @property
    def name(self) -> str:
        """In records and messages."""
        return PRESENCE_COUNTS if self.counts else PRESENCE

    def build(self, model: SceneModel) -> PresenceNet:
        """Untrained. Counts go to 24, as in the paper, or to as many as a derivation has rules, where that is more."""
        ways = max(NUM_COUNTS, model.max_steps + 1) if self.counts else 0
        return PresenceNet(model.classes, self.width, self.hidden, ways)

    def training(
        self, net: PresenceNet, renders: Renders, photographs: Callable[[], Photographs], seed: int
    ) -> "PresenceTraining":
        """On renders alone."""
        return PresenceTraining(net, renders.draw, self.images, self.epochs, seed=batch_seed(seed, 1))


class PresenceTraining(TrainingLoop):
    """Adam on one fixed set of prior renders until 75 % of the presences, or counts, are right, at most ``epochs``
    (supplement).

    Args:
        net: trained in place.
        draw: labelled prior renders.
        images, epochs, batch_size, learning_rate, accuracy: the paper's are the defaults.
        seed: of everything random.

    Attributes:
        unit, total, done: see ``Training``; it ends early where enough is right.
        reached: share of the presences, or counts, that were right in the last epoch.
    """

    unit = "epochs"
    subject = "the presence network"
    remedy = "begin again with features=count"
    seed_path = (1,)

    def __init__(
        self,
        net: PresenceNet,
        draw: Draw,
        images: int = 5000,
        epochs: int = 10,
        batch_size: int = 50,
        learning_rate: float = 1e-3,
        accuracy: float = 0.75,
        seed: int = 0,
    ):
        self.optimiser = torch.optim.Adam(net.parameters(), lr=learning_rate)
        super().__init__(net, {"adam": self.optimiser}, epochs, seed)
        self.net, self.draw, self.reached = net, draw, 0.0
        self.images, self.batch_size, self.accuracy = images, batch_size, accuracy
        self.image, self.number = torch.empty(0), torch.empty(0)

    def run(self, callback: Callback | None = None) -> None:
        """See ``Training``; the images are drawn first, also after an interruption."""
        seed_everything(batch_seed(self.seed, 0))
        self.image, self.number = self._draw()
        self.net.train()
        super().run(callback)
        self.net.eval()
        self.image, self.number = torch.empty(0), torch.empty(0)

    @property
    def finished(self) -> bool:
        """See ``TrainingLoop``."""
        return super().finished or self.reached >= self.accuracy

    def step(self) -> float:
        """An epoch."""
        total, right, ways = 0.0, 0.0, self.net.ways
        for rows in torch.randperm(self.images).split(self.batch_size):
            logits = self.net.layers(self.image[rows])[1]
            number = self.number[rows].to(logits.device)
            if ways:
                loss = F.cross_entropy(logits.flatten(0, 1), number.flatten())
            else:
                loss = F.binary_cross_entropy_with_logits(logits, number.float())
            self.optimiser.zero_grad()
            loss.backward()
            self.optimiser.step()
            total += loss.item() * len(rows)
            predicted = logits.argmax(-1) if ways else (logits > 0).long()
            right += (predicted == number).float().mean().item() * len(rows)
        self.reached = right / self.images
        return total / self.images

    def report(self, loss: float) -> dict[str, float]:
        """See ``TrainingLoop``."""
        return {"loss": loss, "accuracy": self.reached, "demanded": self.accuracy}

    def summary(self) -> dict[str, Any]:
        """See ``Training``: the accuracy of the last epoch, and what is demanded."""
        return {"stage": "accuracy", "accuracy": self.reached, "demanded": self.accuracy}

    def state(self) -> dict[str, Tensor]:
        """See ``Training``."""
        return super().state() | {"number.reached": torch.tensor(self.reached, dtype=torch.float64)}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """See ``Training``."""
        super().restore(tensors)
        self.reached = tensors["number.reached"].item()

    def _draw(self) -> tuple[Tensor, Tensor]:
        """Images, and ``(N, classes)`` int64 how many objects of each class they show, at most what is told apart."""
        ways = self.net.ways
        classes = self.net.out.out_features // max(ways, 1)
        image, number = torch.empty(0), torch.zeros(self.images, classes, dtype=torch.long)
        for start in range(0, self.images, 250):  # kept as bytes: 5,000 images of 256 x 256 are 1 GB
            part = self.draw(min(250, self.images - start))
            if start == 0:
                image = torch.empty(self.images, *part.image.shape[1:], dtype=torch.uint8)
            image[start : start + 250] = part.image
            number[start : start + 250] = _number(part, classes).clamp(max=max(ways, 2) - 1)
        return image, number


def _number(part: Examples, classes: int) -> Tensor:
    """``(N, classes)`` int64 visible objects."""
    label = part.label.where(part.label >= 0, classes)
    return F.one_hot(label, classes + 1).sum(1)[:, :classes]
