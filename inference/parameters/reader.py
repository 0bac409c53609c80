"""The reader: a detector that also gives the values of an object's sites.

A small network gives for every cell of an image which class has its middle there, where that object's parent is, and
the u of each of its sites (``sites``): a truncated normal distribution, and, as some sites turn in a circle, where
u = 0 and u = 1 look alike, the cosine and sine of one and of two turns of u. Cells have their own place as an input,
so that a place is read like any other site. Sites of the whole scene are read from the whole image
(``global_head``). Axis letters: N images, C classes, S sites of nodes, G sites of scenes, h w cells.

References:
    [1] Seitzer et al., *On the pitfalls of heteroscedastic uncertainty estimation*, ICLR 2022.
"""

import math
from typing import NamedTuple, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from probscene.device import device_of

from .backbone import WIDTH, Backbone
from .global_head import GlobalHead, global_features

HIDDEN = 96
SCORE_THRESHOLDS = 0.2, 0.25, 0.3, 0.35, 0.4, 0.5, 0.6  # of which calibration chooses one
MAX_OBJECTS = 200  # objects in an image
LOG_SD_RANGE = -6.0, -0.7  # of u, least and largest; a uniform one's is -1.2
MEAN_REACH = 1.5  # of the mean, from the middle
HARMONICS = 4  # cosine and sine of one turn, and of two


class Detections(NamedTuple):
    """Objects detected in N images, K of them in all, image by image.

    Attributes:
        image: ``(K,)`` int64 which image.
        score: ``(K,)`` probability of an object, summed over four cells.
        label: ``(K,)`` int64 class.
        centre, parent: ``(K, 2)`` x and y of its middle, and of its parent's, pixels.
        raw: ``(K, S, 2 + HARMONICS)`` the network's output for u.
        scene_raw: ``(N, G, 2 + HARMONICS)`` of the scenes' sites.
    """

    image: Tensor
    score: Tensor
    label: Tensor
    centre: Tensor
    parent: Tensor
    raw: Tensor
    scene_raw: Tensor

    def select(self, which: Tensor) -> "Detections":
        """Some of the objects, ``(K,)`` bool."""
        return self._replace(**{name: getattr(self, name)[which] for name in self._fields if name != "scene_raw"})


class Reader(nn.Module):
    """Heads on a backbone. What it detects is on the CPU, wherever it computes.

    Args:
        backbone: the backbone, on the device where the reader computes.
        classes, sites, scene_sites: C, S and G.

    Attributes:
        scene_head: for the scenes' sites.
        thresholds: of scores, from which ``CalibratedReader`` chooses.
        score_threshold: the one that is chosen; detections have higher scores.
    """

    score_threshold: Tensor

    def __init__(self, backbone: Backbone, classes: int, sites: int, scene_sites: int):
        super().__init__()
        self.backbone, self.classes, self.sites, self.scene_sites = backbone, classes, sites, scene_sites
        self.class_head = nn.Conv2d(WIDTH, 1 + classes, 1)
        self.hidden = nn.Linear(WIDTH + 2, HIDDEN)
        self.value_head = nn.Linear(HIDDEN, 2 + sites * (2 + HARMONICS))
        self.scene_head = GlobalHead(max(1, scene_sites), 2 + HARMONICS)
        self.thresholds = SCORE_THRESHOLDS
        self.register_buffer("score_threshold", torch.tensor(SCORE_THRESHOLDS[0]))
        with torch.no_grad():  # nearly every cell holds nothing
            self.class_head.weight.mul_(0.3)
            bias = cast(Tensor, self.class_head.bias)
            bias.zero_()
            bias[0] = 3.0
        self.to(device_of(backbone))

    def forward(self, entered: Tensor) -> tuple[Tensor, Tensor]:
        """Of what has entered the backbone: what it sees ``(N, WIDTH, h, w)``, and logits ``(N, 1 + C, h, w)``."""
        seen = self.backbone(entered)
        return seen, self.class_head(seen)

    def values_at(self, seen: Tensor, image: Tensor, row: Tensor, column: Tensor) -> tuple[Tensor, Tensor]:
        """Of cells ``(...)``, as few hold an object: how many cells away its parent is ``(..., 2)``; the output for u
        ``(..., S, 2 + HARMONICS)``."""
        h, w = seen.shape[-2:]
        place = torch.stack([2 * column / max(1, w - 1) - 1, 2 * row / max(1, h - 1) - 1], -1)
        hidden = F.relu(self.hidden(torch.cat([seen[image, :, row, column], place], -1)))
        parent, values = self.value_head(hidden).tensor_split([2], -1)
        return parent, values.unflatten(-1, (self.sites, 2 + HARMONICS))

    @torch.no_grad()
    def detect(self, images: Tensor) -> Detections:
        """Objects in ``(N, 1 or 3, H, W)`` uint8 images."""
        found = self.detect_all(images)
        return found.select(found.score > float(self.score_threshold))

    @torch.no_grad()
    def detect_all(self, images: Tensor) -> Detections:
        """Detections with scores above the first of ``thresholds``."""
        at_once = self.backbone.at_once
        parts = [self._detect(some, i * at_once) for i, some in enumerate(images.split(at_once))]
        return Detections(*(torch.cat(part) for part in zip(*parts, strict=True)))

    @torch.no_grad()
    def count(self, images: Tensor) -> Tensor:
        """How many objects of each class it detects, ``(N, C)``, in ``(N, 1 or 3, H, W)`` uint8 images."""
        counts, device, at_once = torch.zeros(len(images), self.classes), device_of(self), self.backbone.at_once
        for i, some in enumerate(images.split(at_once)):
            mass = self(self.backbone.enter(some.to(device)))[1].softmax(1)[:, 1:]
            n, y, x, inside = find_objects(mass.sum(1), float(self.score_threshold))
            label = held(mass, n, y, x)[0]
            counts.index_put_((n.cpu() + at_once * i, label.cpu()), torch.ones(len(n)), accumulate=True)
        return counts

    def _detect(self, images: Tensor, first: int) -> Detections:
        entered = self.backbone.enter(images.to(device_of(self)))
        seen, logits = self(entered)
        mass = logits.softmax(1)[:, 1:]
        n, y, x, inside = find_objects(mass.sum(1), self.thresholds[0])
        label, image, rows, columns = held(mass, n, y, x)
        share = mass[image, label[:, None], rows, columns]
        share = (share / share.sum(1, keepdim=True).clamp(min=1e-6)).unsqueeze(-1)  # of what each of the cells says
        parent, values = self.values_at(seen, image, rows, columns)
        here = torch.stack([columns, rows], -1) + 0.5
        scale = self.backbone.cell.to(here.device)
        scene_raw = self._read_scene(entered) if self.scene_sites else seen.new_zeros(len(seen), 0, 2 + HARMONICS)
        found = Detections(
            n + first,
            inside,
            label,
            scale * (share * here).sum(1),
            scale * (share * (here + parent)).sum(1),
            (share.unsqueeze(-1) * values).sum(1),
            scene_raw,
        )
        return Detections(*(part.cpu() for part in found))

    def _read_scene(self, entered: Tensor) -> Tensor:
        # On the CPU: MPS does not pool to parts of unequal size.
        return self.scene_head.from_features(global_features(entered.cpu()).to(entered.device))


def find_objects(mass: Tensor, threshold: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Image, row and column of the first cell ``(K,)`` of blocks of 2 x 2 cells that hold an object each, and their
    scores, image by image: highest score first, without the cells of earlier blocks. A higher threshold leaves those of
    the same blocks that have higher scores.

    Args:
        mass: ``(N, h, w)`` probability of an object in each cell; an object is spread over four cells.
        threshold: of the scores.
    """
    N, h, w = mass.shape
    left, found = mass.clone(), []
    for _ in range(MAX_OBJECTS):
        inside = 4 * F.avg_pool2d(left.unsqueeze(1), 2, 1).flatten(1)
        most, at = inside.max(1)
        there = most > threshold
        if not there.any():
            break
        n, y, x = there.nonzero().flatten(), at[there] // (w - 1), at[there] % (w - 1)
        found.append((n, y, x, most[there]))
        for i in (0, 1):
            for j in (0, 1):
                left[n, y + i, x + j] = 0.0
    if not found:
        none = torch.zeros(0, dtype=torch.int64, device=mass.device)
        return none, none, none, mass.new_zeros(0)
    n, y, x, inside = (torch.cat(part) for part in zip(*found, strict=True))
    order = n.argsort(stable=True)
    return n[order], y[order], x[order], inside[order]


def held(mass: Tensor, n: Tensor, y: Tensor, x: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The class of which blocks ``(K,)`` hold most, and their cells: image, row and column ``(K, 4)``.

    Args:
        mass: ``(N, C, h, w)``.
    """
    rows, columns = torch.stack([y, y, y + 1, y + 1], 1), torch.stack([x, x + 1, x, x + 1], 1)
    image = n[:, None].expand(-1, 4)
    return mass[image, :, rows, columns].sum(1).argmax(1), image, rows, columns


def value_loss(output: Tensor, u: Tensor) -> Tensor:
    """``(...)`` of the output for u, ``(..., 2 + HARMONICS)``: the negative log density of the normal distribution,
    times its standard deviation without gradient [1], and the squared errors of the circles. Without the factor the
    gradient of a site that is read sharply, a place, would be all that shared weights follow."""
    mean, sd = normal(output)
    z, whole = (u - mean) / sd, cut_off_mass(mean, sd)
    nats = 0.5 * z.square().clamp(max=50.0) + sd.log() + whole.log()
    return 2 * sd.detach() * nats + (output[..., 2:] - harmonics(u)).square().sum(-1)


def normal(output: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation ``(...)`` of the normal distribution, before it is cut off. Smooth functions bound
    them: where a clamp cut them they would stay, as it has no gradient there."""
    low, high = LOG_SD_RANGE
    log_sd = low + F.softplus(high - F.softplus(high - output[..., 1]) - low)
    return 0.5 + MEAN_REACH * ((output[..., 0] - 0.5) / MEAN_REACH).tanh(), log_sd.exp()


def cut_off_mass(mean: Tensor, sd: Tensor) -> Tensor:
    """The probability of 0..1 under a normal distribution."""
    return (_phi((1 - mean) / sd) - _phi(-mean / sd)).clamp(min=1e-6)


def truncated_mean(mean: Tensor, sd: Tensor) -> Tensor:
    """The mean of a normal distribution that is cut off at 0 and 1."""
    low, high = -mean / sd, (1 - mean) / sd
    whole = (_phi(high) - _phi(low)).clamp(min=1e-6)
    density = (-0.5 * torch.stack([low, high]).square()).exp() / math.sqrt(2 * math.pi)
    return (mean + sd * (density[0] - density[1]) / whole).clamp(0, 1)


def truncated_quantile(mean: Tensor, sd: Tensor, v: Tensor) -> Tensor:
    """Its quantiles at ``v``."""
    low, high = _phi(-mean / sd), _phi((1 - mean) / sd)
    at = (low + v * (high - low)).clamp(1e-6, 1 - 1e-6)
    return (mean + sd * math.sqrt(2) * torch.erfinv(2 * at - 1)).clamp(0, 1)


def _phi(z: Tensor) -> Tensor:
    return 0.5 * (1 + torch.erf(z / math.sqrt(2)))


def harmonics(u: Tensor) -> Tensor:
    """``(..., HARMONICS)`` cosine and sine of one turn and of two."""
    turn = 2 * math.pi * u
    return torch.stack([turn.cos(), turn.sin(), (2 * turn).cos(), (2 * turn).sin()], -1)
