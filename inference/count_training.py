"""Training the count network on prior renders with their free labels.

The loss is the cross-entropy of the cells and the squared error of the soft counts, and the error of the votes where
objects are counted by groups. Most of an image is empty, so the first part trains on crops around objects, which shows
the network several times as many of them a second; the last part trains on whole images, without which crops leave a
bias in the background. Axis letters: N images, M nodes, K crops.

Reference:
    [1] Jordan et al., *Muon: an optimizer for hidden layers in neural networks*, 2024; on Multi-MNIST it needs a third
        of the time that AdamW alone takes.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from probscene.errors import ProbsceneError
from probscene.inference.count_net import BORDER, STRIDE, CountNet
from probscene.inference.features import Draw, Examples
from probscene.inference.resume import batch_seed, restore_training, training_state
from probscene.sampling import seed_everything


@dataclass(frozen=True)
class CountSchedule:
    """How long and how; the defaults were chosen on Multi-MNIST.

    Args:
        steps: of Adam.
        whole: fraction of the steps, the last ones, on whole images.
        images: images a step.
        crops: crops a step, from those images.
        crop: their side in pixels of the reduced image.
        window: side of the middle part of a crop that counts, cells; the rest is context.
        anywhere: fraction of the crops at random places.
        learning_rate: of Adam, after a warm-up of 50 steps; it falls to 0 along a cosine.
        muon_rate: of Muon, which takes the inner convolutions, likewise.
        count_weight: of the squared error of the soft counts.
        group_weight: of the cross-entropy and the error of the cells' votes for their group, a cell.
        min_visible: objects less visible than this are not counted.
    """

    steps: int = 3600
    whole: float = 0.25
    images: int = 16
    crops: int = 64
    crop: int = 48
    window: int = 4
    anywhere: float = 0.2
    learning_rate: float = 8e-3
    muon_rate: float = 0.1
    count_weight: float = 0.5
    group_weight: float = 0.5
    min_visible: float = 0.25


class CountTraining:
    """Resumable training: images are drawn 16 steps at a time, each draw seeded by its number.

    Args:
        net: trained in place.
        draw: labelled prior renders.
        schedule: how long and how.
        seed: of everything random.

    Attributes:
        done: steps taken.
    """

    STEPS_A_DRAW = 16

    def __init__(self, net: CountNet, draw: Draw, schedule: CountSchedule = CountSchedule(), seed: int = 0):
        self.net, self.draw, self.schedule, self.seed = net, draw, schedule, seed
        # Muon [1] takes matrices: a second parameter over the storage of each convolution that batch norm follows.
        inner = [m.weight for m in net.modules() if isinstance(m, nn.Conv2d) and m.bias is None and m.in_channels > 3]
        self.matrices = [(weight, nn.Parameter(weight.detach().view(len(weight), -1))) for weight in inner]
        rest = [p for p in net.parameters() if not any(p is weight for weight in inner)]
        self.optimisers = {
            "adam": torch.optim.AdamW(rest, lr=schedule.learning_rate, betas=(0.9, 0.99), weight_decay=1e-3),
            "muon": torch.optim.Muon(
                [matrix for _, matrix in self.matrices], lr=schedule.muon_rate, momentum=0.8, weight_decay=0.0
            ),
        }
        self.done = 0

    def run(self, each: Callable[["CountTraining", float], None] | None = None) -> None:
        """Take the steps that are left; ``each`` sees the training and the mean loss after every draw.

        Raises:
            ProbsceneError: the loss is no longer finite.
        """
        s = self.schedule
        self.net.train()
        while self.done < s.steps:
            seed_everything(batch_seed(self.seed, self.done))
            steps = min(self.STEPS_A_DRAW, s.steps - self.done)
            drawn = self.draw(steps * s.images)
            total = 0.0
            for i in range(steps):
                rows = slice(i * s.images, (i + 1) * s.images)
                total += self._step(Examples(*(x[rows] for x in drawn)))
                self.done += 1
            if not math.isfinite(total) or not all(torch.isfinite(p).all() for p in self.net.parameters()):
                raise ProbsceneError(
                    f"Expected a finite loss of the count network, actual {total} at step {self.done}; begin again "
                    f"with lower rates, such as count.muon_rate={s.muon_rate / 4:g} and "
                    f"count.learning_rate={s.learning_rate / 4:g}."
                )
            if each is not None:
                each(self, total / steps)
        self.net.eval()

    def state(self) -> dict[str, Tensor]:
        """All that ``restore`` needs, as named tensors."""
        return training_state(self.net, self.optimisers, done=self.done)

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Go on from a ``state``."""
        numbers = restore_training(self.net, self.optimisers, tensors)
        self.done = int(numbers["done"])

    def _step(self, batch: Examples) -> float:
        s = self.schedule
        factor = min(1.0, (self.done + 1) / 50) * 0.5 * (1 + math.cos(math.pi * self.done / s.steps))
        for optimiser, rate in zip(self.optimisers.values(), (s.learning_rate, s.muon_rate), strict=True):
            for group in optimiser.param_groups:
                group["lr"] = rate * factor
        image = self.net.enter(batch.image)
        centre = batch.centre / self.net.reduce + BORDER
        label = self._objects(batch.label).masked_fill(batch.visible < s.min_visible, -1)
        which, corner, margin = torch.arange(len(image)), torch.zeros(len(image), 2, dtype=torch.int64), 0
        if self.done < s.steps * (1 - s.whole) and min(image.shape[-2:]) > s.crop:
            which, corner = self._places(centre, label, *image.shape[-2:])
            image, centre, label = _cut(image, which, corner, s.crop), centre[which] - corner[:, None], label[which]
            margin = (s.crop // STRIDE - s.window) // 2
        height, width = image.shape[-2] // STRIDE, image.shape[-1] // STRIDE
        target = cells(centre, label, len(self.net.objects), height, width)
        number = 1 + len(self.net.objects)
        logits = self.net(image)
        loss = count_loss(logits[:, :number], target, margin, s.count_weight)
        if self.net.groups is not None:
            axis = "xy".index(self.net.groups.along)
            middle = batch.middle[which] / self.net.reduce + BORDER - corner[:, axis, None]
            shown = self._shown(batch, which, corner, height, width)
            votes = (*shown, *object_targets(centre, label, middle, axis, height, width))
            loss = loss + s.group_weight * group_loss(logits[:, number:], votes, margin)
        self.net.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(self.net.parameters(), 5.0)
        for weight, matrix in self.matrices:
            matrix.grad = weight.grad.view_as(matrix)
            with torch.no_grad():  # batch norm makes the scale free; fixed, the rate means the same all the way
                matrix.mul_(len(matrix) ** 0.5 / matrix.norm())
        for optimiser in self.optimisers.values():
            optimiser.step()
        return loss.item()

    def _objects(self, label: Tensor) -> Tensor:
        """Classes as the network counts them: groups are none of its objects."""
        if self.net.groups is None:
            return label
        return label.where(label != self.net.group_class, -1) - (label > self.net.group_class).long()

    def _shown(self, batch: Examples, which: Tensor, corner: Tensor, height: int, width: int) -> tuple[Tensor, Tensor]:
        """Whether the cells show a group at their middles, and how many cells away that group's middle is; each
        ``(K, height, width)``.

        Args:
            which, corner: ``(K,)`` and ``(K, 2)``, where in which bordered reduced image the cells begin.
        """
        r, groups = self.net.reduce, self.net.groups
        node = batch.instance[:, r // 2 :: r, r // 2 :: r].long() - 1  # of every reduced pixel
        N, h, w = node.shape
        seen = (node >= 0) & (batch.middle >= 0).gather(1, node.clamp(min=0).flatten(1)).view(N, h, w)
        cells_each = seen.sum() / STRIDE**2 / (batch.label == self.net.group_class).sum().clamp(min=1)
        self.net.group_cells.lerp_(cells_each, max(0.01, 1 / (self.done + 1)))
        x, y = (
            corner[:, axis, None] + STRIDE * torch.arange(size) + STRIDE // 2 - BORDER
            for axis, size in ((0, width), (1, height))
        )  # (K, width) and (K, height), pixels of the reduced image
        inside = ((y >= 0) & (y < h))[:, :, None] & ((x >= 0) & (x < w))[:, None, :]
        at = which[:, None, None], y.clamp(0, h - 1)[:, :, None], x.clamp(0, w - 1)[:, None, :]
        shown = seen[at] & inside
        middle = batch.middle[which].gather(1, node[at].clamp(min=0).flatten(1)).view(shown.shape)
        here = x[:, None, :] if groups.along == "x" else y[:, :, None]
        return shown.float(), (middle / r - here).where(shown, 0.0) / STRIDE

    def _places(self, centre: Tensor, label: Tensor, height: int, width: int) -> tuple[Tensor, Tensor]:
        """Image ``(K,)`` and upper left corner ``(K, 2)`` of crops with an object somewhere in their window, or at
        random places."""
        s = self.schedule
        scene, node = (label >= 0).nonzero(as_tuple=True)
        near = round(s.crops * (1 - s.anywhere)) if len(scene) else 0
        pick = torch.randperm(len(scene))[:near] if near <= len(scene) else torch.randint(len(scene), (near,))
        jitter = (torch.rand(near, 2) - 0.5) * (s.window * STRIDE)
        which = torch.cat([scene[pick], torch.randint(len(label), (s.crops - near,))])
        size = torch.tensor([width, height])
        around = torch.cat([centre[scene[pick], node[pick]] + jitter, torch.rand(s.crops - near, 2) * size])
        return which, torch.minimum((around.floor().long() - s.crop // 2).clamp(min=-s.crop), size)


def _cut(image: Tensor, which: Tensor, corner: Tensor, size: int) -> Tensor:
    """Crops ``(K, C, size, size)`` of images ``(N, C, H, W)``, 0 beyond them."""
    H, W = image.shape[-2:]
    x, y = (corner[:, axis, None] + torch.arange(size) for axis in (0, 1))
    inside = ((y >= 0) & (y < H))[:, :, None] & ((x >= 0) & (x < W))[:, None, :]
    at = which[:, None, None], y.clamp(0, H - 1)[:, :, None], x.clamp(0, W - 1)[:, None, :]
    return (image.permute(0, 2, 3, 1)[at] * inside[..., None]).permute(0, 3, 1, 2)


def cells(centre: Tensor, label: Tensor, classes: int, height: int, width: int) -> Tensor:
    """What each cell should hold: probabilities of background and classes, ``(N, 1 + classes, height, width)``.

    An object spreads one unit bilinearly over the four cells around its centre; where objects crowd into a cell it
    holds at most one between them.
    """
    mass = torch.zeros(len(label), classes, height, width)
    for n, m, y, x, share in _shares(centre, label, height, width):
        mass.index_put_((n, label[n, m], y, x), share, accumulate=True)
    mass = mass / mass.sum(1, keepdim=True).clamp(min=1.0)
    return torch.cat([1 - mass.sum(1, keepdim=True), mass], 1)


def object_targets(
    centre: Tensor, label: Tensor, middle: Tensor, axis: int, height: int, width: int
) -> tuple[Tensor, Tensor]:
    """How much of an object each cell holds, and how many cells away the middle of that object's group is; each
    ``(N, height, width)``.

    Args:
        centre, label: ``(N, M, 2)`` and ``(N, M)`` of the objects.
        middle: ``(N, M)`` of their groups, pixels along the axis.
        axis: 0 for x, 1 for y.
    """
    mass, pull = torch.zeros(len(label), height, width), torch.zeros(len(label), height, width)
    for n, m, y, x, share in _shares(centre, label, height, width):
        mass.index_put_((n, y, x), share, accumulate=True)
        away = middle[n, m] - ((x, y)[axis] + 0.5) * STRIDE
        pull.index_put_((n, y, x), share * away, accumulate=True)
    return mass, pull / mass.clamp(min=1e-6) / STRIDE


def _shares(centre: Tensor, label: Tensor, height: int, width: int) -> Iterator[tuple[Tensor, ...]]:
    """The objects' shares of the four cells around their centres: image, node, row, column and share, each ``(S,)``."""
    at = centre / STRIDE - 0.5
    low = at.floor()
    part = at - low
    low = low.long()
    for dx in (0, 1):
        for dy in (0, 1):
            x, y = low[..., 0] + dx, low[..., 1] + dy
            share = (part[..., 0] if dx else 1 - part[..., 0]) * (part[..., 1] if dy else 1 - part[..., 1])
            n, m = ((label >= 0) & (x >= 0) & (x < width) & (y >= 0) & (y < height)).nonzero(as_tuple=True)
            yield n, m, y[n, m], x[n, m], share[n, m]


def count_loss(logits: Tensor, target: Tensor, margin: int, count_weight: float) -> Tensor:
    """Cross-entropy of the cells, summed over an image, and the squared error of its soft counts and their total.

    Args:
        logits, target: ``(N, 1 + classes, h, w)``.
        margin: cells at the border that do not count.
    """
    h, w = logits.shape[-2:]
    inner = (..., slice(margin, h - margin), slice(margin, w - margin))
    log_prob, target = F.log_softmax(logits[inner], 1), target[inner]
    entropy = -(target * log_prob).sum((1, 2, 3))
    error = (log_prob.exp() - target)[:, 1:].sum((2, 3))
    return (entropy + count_weight * (error.square().sum(1) + error.sum(1).square())).mean()


def group_loss(votes: Tensor, target: tuple[Tensor, Tensor, Tensor, Tensor], margin: int) -> Tensor:
    """Cross-entropy of where groups are seen, and the absolute error, in cells, of the votes of what is seen and of
    objects; summed over an image.

    Args:
        votes: ``(N, 3, h, w)``: logit that a cell shows a group, its vote and its object's vote, see ``CountNet``.
        target: ``(N, h, w)`` each: whether a cell shows a group, how many cells away its middle is, how much of an
            object the cell holds and how many cells away the middle of that object's group is.
        margin: cells at the border that do not count.
    """
    h, w = votes.shape[-2:]
    inner = (..., slice(margin, h - margin), slice(margin, w - margin))
    logit, way, pull = votes[inner].unbind(1)
    shown, true_way, mass, true_pull = (x[inner] for x in target)
    entropy = F.binary_cross_entropy_with_logits(logit, shown, reduction="none")
    error = shown * (way - true_way).abs() + 4 * mass * (pull - true_pull).abs()
    return (entropy + error).sum((1, 2)).mean()
