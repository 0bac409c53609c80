"""What the steps of a count network's training look at: prior renders, cut and with what each cell should hold.

Most of an image is empty, so the first part trains on crops around objects, which shows the network several times as
many of them a second; the last part trains on whole images, without which crops leave a bias in the background. Axis
letters: N images, M nodes, K crops.
"""

from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from probscene.device import device_of
from probscene.prefetch import ahead
from probscene.sampling import seed_everything

from ...training import batch_seed
from ..base import Draw, Examples
from .net import BORDER, STRIDE, CountNet

STEPS_A_DRAW = 16
FULL_AREA = 128**2  # pixels of a reduced image of which a step takes as many as the schedule says
MIN_IMAGES = 4  # images a step, however large


@dataclass(frozen=True)
class CountSchedule:
    """How long and how; the defaults were chosen on Multi-MNIST.

    Args:
        steps: of Adam.
        beyond_prior: whether scenes are drawn by the policy that guides are pretrained on, instead of the prior. Guides
            can pass the prior's longest lists, and a network that has not seen so many objects reads too few.
        whole: fraction of the steps, the last ones, on whole images.
        images: images a step, of up to 128 x 128 pixels when reduced; of larger ones, whose crops are as many and
            whose drawing takes longer, fewer to the same number of pixels, but at least 4.
        crops: crops a step, from those images.
        crop: their side in pixels of the reduced image.
        window: side of the middle part of a crop that counts, cells; the rest is context.
        anywhere: fraction of the crops at random places.
        balanced: whether the others are around objects of every class in a step's images alike; else around all objects
            alike, of which a class that is rare has few.
        learning_rate: of Adam, after a warm-up of 50 steps; it falls to 0 along a cosine.
        muon_rate: of Muon, which takes the inner convolutions, likewise.
        count_weight: of the squared error of the soft counts.
        relative: whether each squared error is over one more than the count, as counts vary with their size: where
            there are twenty trees, the errors of what is rare are as nothing beside theirs.
        group_weight: of the cross-entropy and the error of the cells' votes for their group, a cell.
        min_visible: objects less visible than this are not counted.
        rounding: whether what is read is drawn toward whole numbers, see ``toward_whole``; for counts whose
            errors are far below one half.
    """

    steps: int = 3600
    beyond_prior: bool = False
    whole: float = 0.25
    images: int = 16
    crops: int = 64
    crop: int = 48
    window: int = 4
    anywhere: float = 0.2
    balanced: bool = False
    learning_rate: float = 8e-3
    muon_rate: float = 0.1
    count_weight: float = 0.5
    relative: bool = False
    group_weight: float = 0.5
    min_visible: float = 0.25
    rounding: bool = True


class Votes(NamedTuple):
    """What the cells should vote for; each ``(K, h, w)``.

    Attributes:
        shown: 1 where a cell shows a group at its middle.
        way: how many cells away that group's middle is.
        mass: how much of an object the cell holds.
        pull: how many cells away the middle of that object's group is.
    """

    shown: Tensor
    way: Tensor
    mass: Tensor
    pull: Tensor


class CountBatch(NamedTuple):
    """What one step looks at.

    Attributes:
        image: ``(K, C, 8h, 8w)`` float32, crops or whole images as the network reads them.
        target: ``(K, 1 + objects, h, w)``, what each cell should hold, see ``cells``.
        margin: cells at the border that do not count.
        votes: where there are groups.
        group_cells: how many cells a group covers in these images, in the mean, 0-dimensional.
    """

    image: Tensor
    target: Tensor
    margin: int
    votes: Votes | None
    group_cells: Tensor | None

    def to(self, device: torch.device) -> "CountBatch":
        """On a device; what is pinned is copied while the CPU goes on."""
        return self._each(lambda part: part.to(device, non_blocking=part.is_pinned()))

    def pinned(self) -> "CountBatch":
        """In memory that a CUDA GPU copies from while the CPU goes on."""
        return self._each(Tensor.pin_memory)

    def _each(self, move: Callable[[Tensor], Tensor]) -> "CountBatch":
        votes = None if self.votes is None else Votes(*map(move, self.votes))
        group_cells = None if self.group_cells is None else move(self.group_cells)
        return CountBatch(move(self.image), move(self.target), self.margin, votes, group_cells)


def images_per_step(most: int, area: float) -> int:
    """``most``, of images of up to 128 x 128 pixels when reduced; of images of a larger ``area``, which hold more
    objects, as many as have those pixels together, but at least 4."""
    return min(most, max(MIN_IMAGES, round(most * FULL_AREA / area)))


class CountBatches:
    """The batches of a training, drawn 16 steps at a time, each draw seeded by its number.

    Args:
        net: whose shape and groups the batches are for.
        draw: labelled prior renders.
        schedule, seed: of the training.
    """

    def __init__(self, net: CountNet, draw: Draw, schedule: CountSchedule, seed: int):
        self.net, self.draw, self.schedule, self.seed = net, draw, schedule, seed

    @property
    def images(self) -> int:
        """Images a step."""
        return images_per_step(self.schedule.images, self.net.area)

    def after(self, done: int) -> Generator[list[CountBatch]]:
        """The batches that are left after ``done`` steps, a draw at a time, while another thread makes the next."""
        return ahead(self._draw, range(done, self.schedule.steps, STEPS_A_DRAW))

    def _draw(self, done: int) -> list[CountBatch]:
        seed_everything(batch_seed(self.seed, done))
        steps, images = min(STEPS_A_DRAW, self.schedule.steps - done), self.images
        drawn = self.draw(steps * images)
        rows = (slice(i * images, (i + 1) * images) for i in range(steps))
        made = [self._batch(Examples(*(x[some] for x in drawn)), done + i) for i, some in enumerate(rows)]
        return [batch.pinned() for batch in made] if device_of(self.net).type == "cuda" else made

    def _batch(self, batch: Examples, step: int) -> CountBatch:
        s = self.schedule
        image = self.net.enter(batch.image)
        centre = batch.centre / self.net.reduce + BORDER
        label = self._objects(batch.label).masked_fill(batch.visible < s.min_visible, -1)
        which, corner, margin = torch.arange(len(image)), torch.zeros(len(image), 2, dtype=torch.int64), 0
        if step < s.steps * (1 - s.whole) and min(image.shape[-2:]) > s.crop:
            which, corner = self._places(centre, label, *image.shape[-2:])
            image, centre, label = _cut(image, which, corner, s.crop), centre[which] - corner[:, None], label[which]
            margin = (s.crop // STRIDE - s.window) // 2
        height, width = image.shape[-2] // STRIDE, image.shape[-1] // STRIDE
        target = cells(centre, label, len(self.net.objects), height, width)
        if self.net.groups is None:
            return CountBatch(image, target, margin, None, None)
        axis = "xy".index(self.net.groups.along)
        middle = batch.middle[which] / self.net.reduce + BORDER - corner[:, axis, None]
        shown, way, group_cells = self._shown(batch, which, corner, height, width)
        votes = Votes(shown, way, *object_targets(centre, label, middle, axis, height, width))
        return CountBatch(image, target, margin, votes, group_cells)

    def _objects(self, label: Tensor) -> Tensor:
        """Classes as the network counts them: groups are none of its objects."""
        if self.net.groups is None:
            return label
        return label.where(label != self.net.group_class, -1) - (label > self.net.group_class).long()

    def _shown(
        self, batch: Examples, which: Tensor, corner: Tensor, height: int, width: int
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Whether the cells show a group at their middles, how many cells away that group's middle is, each
        ``(K, height, width)``, and how many cells a group covers.

        Args:
            which, corner: ``(K,)`` and ``(K, 2)``, where in which bordered reduced image the cells begin.
        """
        r, groups = self.net.reduce, self.net.groups
        node = batch.instance[:, r // 2 :: r, r // 2 :: r].long() - 1  # of every reduced pixel
        N, h, w = node.shape
        seen = (node >= 0) & (batch.middle >= 0).gather(1, node.clamp(min=0).flatten(1)).view(N, h, w)
        cells_each = seen.sum() / STRIDE**2 / (batch.label == self.net.group_class).sum().clamp(min=1)
        x, y = (
            corner[:, axis, None] + STRIDE * torch.arange(size) + STRIDE // 2 - BORDER
            for axis, size in ((0, width), (1, height))
        )  # (K, width) and (K, height), pixels of the reduced image
        inside = ((y >= 0) & (y < h))[:, :, None] & ((x >= 0) & (x < w))[:, None, :]
        at = which[:, None, None], y.clamp(0, h - 1)[:, :, None], x.clamp(0, w - 1)[:, None, :]
        shown = seen[at] & inside
        middle = batch.middle[which].gather(1, node[at].clamp(min=0).flatten(1)).view(shown.shape)
        here = x[:, None, :] if groups is not None and groups.along == "x" else y[:, :, None]
        return shown.float(), (middle / r - here).where(shown, 0.0) / STRIDE, cells_each

    def _places(self, centre: Tensor, label: Tensor, height: int, width: int) -> tuple[Tensor, Tensor]:
        """Image ``(K,)`` and upper left corner ``(K, 2)`` of crops with an object somewhere in their window, or at
        random places."""
        s = self.schedule
        scene, node = (label >= 0).nonzero(as_tuple=True)
        near = round(s.crops * (1 - s.anywhere)) if len(scene) else 0
        pick = self._pick(label[scene, node], near)
        jitter = (torch.rand(near, 2) - 0.5) * (s.window * STRIDE)
        which = torch.cat([scene[pick], torch.randint(len(label), (s.crops - near,))])
        size = torch.tensor([width, height])
        around = torch.cat([centre[scene[pick], node[pick]] + jitter, torch.rand(s.crops - near, 2) * size])
        return which, torch.minimum((around.floor().long() - s.crop // 2).clamp(min=-s.crop), size)

    def _pick(self, label: Tensor, num: int) -> Tensor:
        """``(num,)``, which objects crops are taken around, of objects of the classes ``label (S,)``."""
        if self.schedule.balanced and num:
            return torch.multinomial(1 / torch.bincount(label)[label], num, replacement=True)
        return torch.randperm(len(label))[:num] if num <= len(label) else torch.randint(len(label), (num,))


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
    for n, m, y, x, share in shares(centre, label, height, width):
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
    for n, m, y, x, share in shares(centre, label, height, width):
        mass.index_put_((n, y, x), share, accumulate=True)
        away = middle[n, m] - ((x, y)[axis] + 0.5) * STRIDE
        pull.index_put_((n, y, x), share * away, accumulate=True)
    return mass, pull / mass.clamp(min=1e-6) / STRIDE


def shares(centre: Tensor, label: Tensor, height: int, width: int) -> Iterator[tuple[Tensor, ...]]:
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
