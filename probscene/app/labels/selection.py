"""Which images to label next: those that stand for all others.

Where a network has counted, each image is a point: the rank of its count of each class among all images, and what a
pretrained network sees in it. Kernel herding [1] then takes one image after the other so that the chosen ones are
spread as all are, with many objects and with few: their own histogram estimates the target's, and a rule of reading
must hold over all that occurs. Of a class that is in few images, two of those with the highest counts go first, since a
class that is never seen cannot be calibrated.

Without counts there are looks alone, which are spread by what is farthest from the chosen ones (k-centre greedy [2]),
so that no kind of image stays unseen.

References:
    [1] Chen, Welling, Smola, *Super-Samples from Kernel Herding*, UAI 2010.
    [2] Sener, Savarese, *Active Learning for Convolutional Neural Networks: A Core-Set Approach*, ICLR 2018.

Axis letters: L images, D features, C classes, K chosen.
"""

import math

import torch
from scipy.stats import rankdata
from torch import Tensor

LOOKS = 8  # principal components of the features that are told apart beside counts
SURE = 2  # images of each class, at least, as far as counts say
PRESENT = 0.5  # of an object


def propose(
    number: int,
    looks: Tensor,
    counts: Tensor | None = None,
    labelled: Tensor | None = None,
    seed: int = 0,
) -> list[int]:
    """The numbers of the images to label, K = ``number`` or as many as are left, those first that tell most.

    Args:
        looks: ``(L, D)`` features.
        counts: ``(L, C)`` that a network read; None where there is none.
        labelled: ``(k,)`` int64, images that are labelled already: they count as chosen, and are not proposed.
        seed: of the first image, where none is labelled.
    """
    before = [] if labelled is None else labelled.tolist()
    number = min(number, len(looks) - len(set(before)))
    if number <= 0:
        return []
    looks = looks.double() - looks.double().mean(0)
    if counts is None:
        return _farthest(number, looks, before, seed)
    points = torch.cat([torch.stack([_rank(column) for column in counts.double().T], 1), _shrunk(looks)], 1)
    first = _rare(number, counts, before)
    return first + _herded(number - len(first), points, [*before, *first], seed)


def _farthest(number: int, points: Tensor, before: list[int], seed: int) -> list[int]:
    chosen = list(before) or [_any(len(points), seed)]
    distance = torch.cdist(points, points[chosen]).amin(1)
    while len(chosen) < len(before) + number:
        distance[chosen] = -1.0
        chosen.append(int(distance.argmax()))
        distance = torch.minimum(distance, torch.cdist(points, points[chosen[-1:]])[:, 0])
    return chosen[len(before) :]


def _herded(number: int, points: Tensor, before: list[int], seed: int) -> list[int]:
    square = torch.cdist(points, points).square()
    kernel = torch.exp(-square / square.median().clamp(min=1e-12))
    mean, chosen = kernel.mean(1), list(before)
    if number and not chosen:
        chosen.append(_any(len(points), seed))
    while len(chosen) < len(before) + number:
        worth = mean - kernel[:, chosen].sum(1) / (len(chosen) + 1)
        worth[chosen] = -math.inf
        chosen.append(int(worth.argmax()))
    return chosen[len(before) :]


def _rare(number: int, counts: Tensor, before: list[int]) -> list[int]:
    """Images of classes of which so many images drawn at random would hardly have any; at most half of all."""
    shown, chosen = counts >= PRESENT, list[int]()
    for c in shown.double().mean(0).argsort().tolist():
        if float(shown[:, c].double().mean()) * number >= SURE:
            continue
        order = counts[:, c].argsort(descending=True, stable=True).tolist()
        free = [i for i in order if i not in before and i not in chosen and bool(shown[i, c])]
        missing = SURE - int(shown[[*before, *chosen], c].sum())
        chosen += free[: min(max(missing, 0), number // 2 - len(chosen))]
    return chosen


def _rank(column: Tensor) -> Tensor:
    """The ranks of numbers, of mean 0 and variance 1; 0 where all are the same."""
    ranks = torch.from_numpy(rankdata(column.numpy())).double()
    return (ranks - ranks.mean()) / ranks.std(correction=0).clamp(min=1e-12)


def _shrunk(looks: Tensor) -> Tensor:
    """Principal components of centred features, which weigh together as much as one count."""
    left, size, _ = torch.linalg.svd(looks, full_matrices=False)
    parts = (left * size)[:, :LOOKS]
    return parts / parts.square().sum(1).mean().sqrt().clamp(min=1e-12)


def _any(number: int, seed: int) -> int:
    return int(torch.randint(number, (), generator=torch.Generator().manual_seed(seed)))
