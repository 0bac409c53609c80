"""What is seen of single objects, alike in labelled images and in renders, and how parameters change it.

An object is measured in its box: size, place, and the light inside and around. The renders' objects o have, in each of
these aspects, an energy distance from the labelled ones r of their class; with others of the renders o', it changes
with the probability of o by

    w(o) = E |o - r| - E |o - o'|

in units of the mean distance of two labelled ones. A site is judged by the aspect that goes by it most (``aspect_of``):
in the others models differ from photographs in ways that it cannot mend. What a linear regression says of w by the
site's u is the way that the site has to go. How much of that is chance is known from both sides: labelled images
differ, and so do scenes. The test of a site is Hotelling's T² [1], images and scenes taken as a whole each [2]. Axis
letters: N scenes, M nodes, C H W, n objects of the renders, r labelled ones, K labelled images, D measurements, A
aspects, P of a site's basis.

References:
    [1] Hotelling, *The generalization of Student's ratio*, 1931.
    [2] Liang, Zeger, *Longitudinal data analysis using generalized linear models*, Biometrika 1986.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial.distance import cdist
from scipy.stats import chi2
from scipy.stats import f as fisher
from torch import Tensor

from ...features.base import Examples
from ...statistics.energy import Features
from ..reader_training import MIN_VISIBLE

ASPECTS = {"size": slice(0, 2), "place": slice(2, 4), "inside": slice(4, 8), "around": slice(8, 11)}
BOX = ("size", "place")  # the first of them
WIDTH = ASPECTS["around"].stop
AROUND = 0.25  # of a box's width and height, on each side
MIN_SIDE = 1.0  # pixels of a box
MAX_OBJECTS = 3000  # of a class that others are compared with
MIN_OBJECTS = 4  # labelled ones of a class
MIN_SPREAD = 1e-6
RIDGE = 1e-12
ASPECT_P_VALUE = 1e-3  # of "nothing that is seen goes by the site", below which something does
MIN_SD = 1e-5  # standard deviation of a number that tells scenes apart


class Objects(NamedTuple):
    """Objects of images.

    Attributes:
        image, node: ``(n,)`` int64 the number of the image of each, and its place among the image's boxes.
        label: ``(n,)`` int64 its class.
        seen: ``(n, D)`` float64 what is measured of it, see ``ASPECTS``.
        images: how many there are, those without objects included.
    """

    image: np.ndarray
    node: np.ndarray
    label: np.ndarray
    seen: Features
    images: int


class Witness(NamedTuple):
    """w of the renders' objects of all classes that can be compared.

    Attributes:
        rows: ``(n',)`` int64 which of the renders' objects they are.
        owner: ``(n',)`` int64 the number of the scene of each.
        label: ``(n',)`` int64 its class.
        weight: ``(n',)`` so that classes count as often as among the labelled objects; 1 in the mean.
        w: ``(A, n')``, 0 in the mean of each class.
        each: ``(A, n', K)`` by how much w differs from that of each labelled image alone, so that these are 0 in all.
    """

    rows: np.ndarray
    owner: np.ndarray
    label: np.ndarray
    weight: Features
    w: Features
    each: Features


class Slope(NamedTuple):
    """How w depends on a site's u.

    Attributes:
        p: the p-value of "not at all"; 1 where there are too few labelled images to say.
        sure: share of the slope that is more than chance, 0 to 1: James and Stein's, positive part.
        slope: ``(P,)``, see ``object_basis``.
    """

    p: float
    sure: float
    slope: Features


def objects_of(drawn: Examples) -> Objects:
    """Of renders, those that show enough of themselves."""
    half = drawn.size / 2
    label = drawn.label.where(drawn.visible >= MIN_VISIBLE, -1)
    return measure(drawn.image, torch.cat([drawn.centre - half, drawn.centre + half], -1), label)


def concatenate_objects(parts: Sequence[Objects]) -> Objects:
    """Those of several sets of images."""
    before = np.cumsum([0, *(part.images for part in parts)])
    image = np.concatenate([part.image + first for part, first in zip(parts, before, strict=False)])
    node, label, seen = (np.concatenate(some) for some in zip(*(part[1:4] for part in parts), strict=True))
    return Objects(image, node, label, seen, int(before[-1]))


def measure(images: Tensor, box: Tensor, label: Tensor) -> Objects:
    """Of images ``(N, 1 or 3, H, W)`` uint8 the objects in boxes ``(N, M, 4)``, x0 y0 x1 y1 in pixels, ends exclusive;
    of classes ``label (N, M)`` int64, -1 for none."""
    N, _, H, W = images.shape
    image, node = (label >= 0).nonzero().unbind(1)
    low, high = torch.zeros(4), torch.tensor([W, H, W, H], dtype=torch.float32)
    inner = box[image, node].float().clamp(low, high)
    size = (inner[:, 2:] - inner[:, :2]).clamp(min=MIN_SIDE)
    margin = AROUND * torch.cat([-size, size], 1)
    outer = (inner + margin).clamp(low, high)
    inside, area = _box_sums(images, image, inner)
    around, whole = _box_sums(images, image, outer)
    mean = inside[:, :3] / area
    deviation = (inside[:, 3] / area[:, 0] - mean.mean(1).square()).clamp(min=0).sqrt()
    ring = (around - inside)[:, :3] / (whole - area).clamp(min=1)
    middle = (inner[:, :2] + inner[:, 2:]) / 2 / torch.tensor([W, H])
    seen = torch.cat([size.log(), middle, mean / 255, deviation[:, None] / 255, ring / 255], 1)
    return Objects(image.numpy(), node.numpy(), label[image, node].numpy(), seen.double().numpy(), N)


def _box_sums(images: Tensor, image: Tensor, box: Tensor) -> tuple[Tensor, Tensor]:
    """Sums ``(n, 4)`` of the three colours and of the squared grey over the pixels of boxes ``(n, 4)``, at least one
    pixel each; and how many pixels these are, ``(n, 1)``."""
    H, W = images.shape[2:]
    x0, y0 = (box[:, i].floor().long().clamp(0, most - 1) for i, most in ((0, W), (1, H)))
    x1, y1 = box[:, 2].ceil().long().maximum(x0 + 1), box[:, 3].ceil().long().maximum(y0 + 1)
    sums = torch.zeros(len(box), 4, dtype=torch.float64)
    for i in image.unique().tolist():  # the whole batch's integral images would take gigabytes
        x, of = images[i].expand(3, -1, -1).double(), image == i
        x = torch.cat([x, x.mean(0, keepdim=True).square()])
        integral = torch.nn.functional.pad(x.cumsum(1).cumsum(2), (1, 0, 1, 0))
        left, right = (integral[:, :, column[of]] for column in (x0, x1))
        rows = torch.arange(int(of.sum()))
        sums[of] = (right[:, y1[of], rows] - right[:, y0[of], rows] - left[:, y1[of], rows] + left[:, y0[of], rows]).T
    return sums, ((x1 - x0) * (y1 - y0)).double()[:, None]


def object_witness(own: Objects, real: Objects) -> Witness | None:
    """w of the renders' objects by the labelled ones; None where no class can be compared."""
    parts = [part for c in np.unique(real.label) if (part := _of_class(own, real, c)) is not None]
    if not parts:
        return None
    rows, weight = np.concatenate([part[0] for part in parts]), np.concatenate([part[1] for part in parts])
    w, each = np.concatenate([part[2] for part in parts], 1), np.concatenate([part[3] for part in parts], 1)
    return Witness(rows, own.image[rows], own.label[rows], weight / weight.mean(), w, each)


def _of_class(own: Objects, real: Objects, c: int) -> tuple[np.ndarray, Features, Features, Features] | None:
    rows, labelled = np.flatnonzero(own.label == c), np.flatnonzero(real.label == c)[:MAX_OBJECTS]
    if min(len(rows), len(labelled)) < MIN_OBJECTS:
        return None
    x, r = own.seen[rows], real.seen[labelled]
    w, each = np.zeros((len(ASPECTS), len(rows))), np.zeros((len(ASPECTS), len(rows), real.images))
    for a, columns in enumerate(ASPECTS.values()):
        toward, within = cdist(x[:, columns], r[:, columns]), cdist(r[:, columns], r[:, columns])
        spread = max(within.sum() / (len(r) * (len(r) - 1)), MIN_SPREAD)
        mean = toward.mean(1)
        w[a] = (mean - _mean_distance(x[:, columns])) / spread
        np.add.at(each[a].T, real.image[labelled], (toward - mean[:, None]).T / spread * real.images / len(r))
    weight = np.full(len(rows), len(labelled) / len(rows))
    return rows, weight, w - w.mean(1, keepdims=True), each - each.mean(1, keepdims=True)


def _mean_distance(x: Features) -> Features:
    """``(n,)`` of each row from some others."""
    others = x[:MAX_OBJECTS]
    number = np.full(len(x), len(others))
    number[: len(others)] -= 1
    return cdist(x, others).sum(1) / number


def scene_witness(witness: Witness, scenes: int) -> Features:
    """w of whole scenes ``(scenes,)``, by the light of their objects."""
    light = np.asarray(witness.weight * witness.w[len(BOX) :].sum(0), np.float64)
    return np.bincount(witness.owner, light, scenes).astype(np.float64)


def aspect_of(seen: Features, u: Tensor, aspects: Sequence[str] = tuple(ASPECTS)) -> int:
    """Which aspect of what is seen ``(n, D)`` goes by u ``(n,)`` most, by the largest share of variance that is
    explained of one of its measurements; -1 where all could be chance.

    Args:
        aspects: that come into question, the first ones of all.
    """
    best, largest = -1, 0.0
    for number, name in enumerate(aspects if len(seen) else ()):
        for one in seen[:, ASPECTS[name]].T:
            (found, freedom), *_ = dependence(u[:, None], one).tolist()
            if found > largest and chi2.sf(found, max(freedom, 1)) < ASPECT_P_VALUE / WIDTH:
                best, largest = number, found
    return best


def scene_means(objects: Objects) -> tuple[np.ndarray, Features]:
    """The numbers of the scenes ``(N',)`` that have objects, and what is seen of these in the mean ``(N', D)``, less
    that of all of their class."""
    seen, number = objects.seen.copy(), np.bincount(objects.image, minlength=objects.images)
    for c in np.unique(objects.label):
        seen[objects.label == c] -= seen[objects.label == c].mean(0)
    mean = np.stack([np.bincount(objects.image, one, objects.images) for one in seen.T], 1)
    scenes = np.flatnonzero(number)
    return scenes, mean[scenes] / number[scenes, None]


def dependence(u: Tensor, w: Features) -> Tensor:
    """``(G, 2)``: N times the share of w's variance that a linear regression on numbers of each site's u ``(N, G)``
    explains, and the degrees of freedom; if w does not depend on the site, a draw of their chi-squared distribution."""
    rows, y = [], w - w.mean()
    for one in u.unbind(1):
        left, singular, _ = np.linalg.svd(basis(one), full_matrices=False)
        left = left[:, singular > MIN_SD * len(y) ** 0.5]
        found, whole = np.square(left.T @ y).sum(), np.square(y).sum()
        rows.append((len(y) * float(found / whole) if whole else 0.0, float(left.shape[1])))
    return torch.tensor(rows).reshape(-1, 2)


def basis(u: Tensor) -> Features:
    """``(N, 4)`` of a site's u ``(N,)``, by which anything may depend on it: smooth on a line or on a circle."""
    x = torch.stack([u, u.square(), (2 * torch.pi * u).cos(), (2 * torch.pi * u).sin()], 1).double().numpy()
    return x - x.mean(0)


def object_basis(u: Features) -> Features:
    """``(n, P)`` of u ``(n,)``: it and its square, from its middle, so that a site's mean and spread can be moved."""
    return np.stack([u - 0.5, np.square(u - 0.5)], 1)


def slope_of(witness: Witness, u: Features, aspect: int) -> Slope:
    """Of a site that some of the objects have: u ``(n',)``, NaN for the others; in one aspect."""
    has = ~np.isnan(u)
    scene, label, weight = witness.owner[has], witness.label[has], witness.weight[has]
    w, each = witness.w[aspect, has], witness.each[aspect, has]
    none, K = Slope(1.0, 0.0, np.zeros(2)), int(np.abs(each).any(0).sum())
    if not has.any():
        return none
    x = object_basis(u[has])
    for c in np.unique(label):
        x[label == c] -= np.average(x[label == c], axis=0, weights=weight[label == c])
    P = x.shape[1]
    gram = x.T @ (weight[:, None] * x)
    if K <= P or np.linalg.matrix_rank(gram) < P:
        return none
    solve = np.linalg.solve(gram, (weight[:, None] * x).T)  # (P, n')
    slope, of_images = solve @ w, solve @ each
    left = w - x @ slope
    of_scenes = np.zeros((P, int(scene.max()) + 1))
    np.add.at(of_scenes.T, scene, (solve * left).T)
    covariance = of_images @ of_images.T / each.shape[1] / (each.shape[1] - 1) + of_scenes @ of_scenes.T
    t2 = float(slope @ np.linalg.solve(covariance + RIDGE * np.eye(P), slope))
    p = float(fisher.sf(t2 * (K - P) / (P * (K - 1)), P, K - P))
    return Slope(p, max(0.0, 1 - P / t2) if t2 > 0 else 0.0, slope)
