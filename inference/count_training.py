"""Training the count network on prior renders with their free labels.

The loss is the cross-entropy of the cells and the squared error of the soft counts. Most of an image is empty, so the
first part trains on crops around objects, which shows the network several times as many of them a second; the last part
trains on whole images, without which crops leave a bias in the background. Axis letters: N images, M nodes, K crops.

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
        middle = torch.zeros_like(label, dtype=torch.float32)
        if self.net.groups is not None:
            middle = batch.middle / self.net.reduce + BORDER
            image = torch.cat([image, self._ways(batch, *image.shape[-2:])], 1)
        margin = 0
        if self.done < s.steps * (1 - s.whole) and min(image.shape[-2:]) > s.crop:
            image, centre, label, middle = self._crop(image, centre, label, middle)
            margin = (s.crop // STRIDE - s.window) // 2
        height, width = image.shape[-2] // STRIDE, image.shape[-1] // STRIDE
        target = cells(centre, label, len(self.net.objects), height, width)
        number = 1 + len(self.net.objects)
        logits = self.net(image[:, : self.net.channels])
        loss = count_loss(logits[:, :number], target, margin, s.count_weight)
        if self.net.groups is not None:
            ways, axis = image[:, self.net.channels :], "xy".index(self.net.groups.along)
            votes = group_targets(ways, centre, label, middle, axis, height, width)
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

    def _ways(self, batch: Examples, height: int, width: int) -> Tensor:
        """For each pixel of the bordered reduced images whether it shows a group, and how far that group's middle is,
        pixels, ``(N, 2, height, width)``."""
        r = self.net.reduce
        seen = batch.instance[:, r // 2 :: r, r // 2 :: r].long()
        N, h, w = seen.shape
        middle = batch.middle.gather(1, (seen - 1).clamp(min=0).flatten(1)).view(N, h, w)
        shown = (seen > 0) & (middle >= 0)
        here = torch.arange(h)[:, None] if self.net.groups.along == "y" else torch.arange(w)[None, :]
        way = (middle / r - here).where(shown, 0.0)
        cells_each = shown.sum() / STRIDE**2 / (batch.label == self.net.group_class).sum().clamp(min=1)
        self.net.group_cells.lerp_(cells_each, max(0.01, 1 / (self.done + 1)))
        return F.pad(torch.stack([shown.float(), way], 1), (BORDER, width - w - BORDER, BORDER, height - h - BORDER))

    def _crop(self, image: Tensor, centre: Tensor, label: Tensor, middle: Tensor) -> tuple[Tensor, ...]:
        """Crops ``(K, C, crop, crop)`` with an object somewhere in their window, or at random places."""
        s = self.schedule
        N, C, H, W = image.shape
        scene, node = (label >= 0).nonzero(as_tuple=True)
        near = round(s.crops * (1 - s.anywhere)) if len(scene) else 0
        pick = torch.randperm(len(scene))[:near] if near <= len(scene) else torch.randint(len(scene), (near,))
        jitter = (torch.rand(near, 2) - 0.5) * (s.window * STRIDE)
        which = torch.cat([scene[pick], torch.randint(N, (s.crops - near,))])
        around = torch.cat(
            [centre[scene[pick], node[pick]] + jitter, torch.rand(s.crops - near, 2) * torch.tensor([W, H])]
        )
        corner = around.floor().long() - s.crop // 2
        pad = s.crop
        corner = torch.minimum(corner.clamp(min=-pad), torch.tensor([W, H]))
        padded = F.pad(image, (pad,) * 4)
        span = torch.arange(s.crop)
        rows = (corner[:, 1:] + pad + span)[:, :, None]
        columns = (corner[:, :1] + pad + span)[:, None, :]
        crops = padded.permute(0, 2, 3, 1)[which[:, None, None], rows, columns].permute(0, 3, 1, 2)
        corner = corner[:, None].float()
        if self.net.groups is not None:
            middle = middle[which] - corner[..., "xy".index(self.net.groups.along)]
        return crops, centre[which] - corner, label[which], middle


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


def group_targets(
    ways: Tensor, centre: Tensor, label: Tensor, middle: Tensor, axis: int, height: int, width: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """What the cells should vote, each ``(N, height, width)``: whether a cell shows a group, how many cells away its
    middle is, how much of an object the cell holds and how many cells away the middle of that object's group is.

    Args:
        ways: ``(N, 2, H, W)`` the first two of the pixels, in pixels.
        centre, label: ``(N, M, 2)`` and ``(N, M)`` of the objects.
        middle: ``(N, M)`` of their groups, pixels along the axis.
        axis: 0 for x, 1 for y.
    """
    shown, way = ways[:, :, STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE].unbind(1)
    mass, pull = torch.zeros_like(shown), torch.zeros_like(shown)
    for n, m, y, x, share in _shares(centre, label, height, width):
        mass.index_put_((n, y, x), share, accumulate=True)
        away = middle[n, m] - ((x, y)[axis] + 0.5) * STRIDE
        pull.index_put_((n, y, x), share * away, accumulate=True)
    return shown, way / STRIDE, mass, pull / mass.clamp(min=1e-6) / STRIDE


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
        target: see ``group_targets``.
        margin: cells at the border that do not count.
    """
    h, w = votes.shape[-2:]
    inner = (..., slice(margin, h - margin), slice(margin, w - margin))
    logit, way, pull = votes[inner].unbind(1)
    shown, true_way, mass, true_pull = (x[inner] for x in target)
    entropy = F.binary_cross_entropy_with_logits(logit, shown, reduction="none")
    error = shown * (way - true_way).abs() + 4 * mass * (pull - true_pull).abs()
    return (entropy + error).sum((1, 2)).mean()
