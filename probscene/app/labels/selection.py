"""Which images to label next: those that are farthest from the ones chosen so far (k-centre greedy [1]).

Each image is a point, the features that a pretrained network gives it, so that no kind of image stays unlabelled. Where
a network has counted, two images of each class that is in few images go first, since a class that no labelled image
shows cannot be calibrated.

References:
    [1] Sener, Savarese, *Active Learning for Convolutional Neural Networks: A Core-Set Approach*, ICLR 2018.

Axis letters: L images, D features, C classes, K chosen.
"""

import torch
from torch import Tensor

MIN_CLASS_IMAGES = 2  # images of each class that are chosen, as far as counts say
PRESENT = 0.5  # a count from which an image shows a class


def propose(
    number: int,
    features: Tensor,
    counts: Tensor | None = None,
    labelled: Tensor | None = None,
    seed: int = 0,
) -> list[int]:
    """The numbers of the images to label, K = ``number`` or as many as are left, in the order they are chosen.

    Args:
        features: ``(L, D)``.
        counts: ``(L, C)`` that a network read; None where there is none.
        labelled: ``(k,)`` int64, images that are labelled already: they count as chosen, and are not proposed.
        seed: of the first image, where none is labelled.
    """
    before = [] if labelled is None else labelled.tolist()
    number = min(number, len(features) - len(set(before)))
    if number <= 0:
        return []
    first = [] if counts is None else _rare(number, counts, before)
    features = features.double() - features.double().mean(0)
    return first + _farthest(number - len(first), features, [*before, *first], seed)


def _farthest(number: int, points: Tensor, before: list[int], seed: int) -> list[int]:
    chosen = list(before)
    if number and not chosen:
        chosen.append(int(torch.randint(len(points), (), generator=torch.Generator().manual_seed(seed))))
    distance = torch.cdist(points, points[chosen]).amin(1)
    while len(chosen) < len(before) + number:
        distance[chosen] = -1.0
        chosen.append(int(distance.argmax()))
        distance = torch.minimum(distance, torch.cdist(points, points[chosen[-1:]])[:, 0])
    return chosen[len(before) :]


def _rare(number: int, counts: Tensor, before: list[int]) -> list[int]:
    """Images of classes that so many random images would hardly show; at most half of ``number``."""
    shown, chosen = counts >= PRESENT, list[int]()
    for c in shown.double().mean(0).argsort().tolist():
        if float(shown[:, c].double().mean()) * number >= MIN_CLASS_IMAGES:
            continue
        order = counts[:, c].argsort(descending=True, stable=True).tolist()
        free = [i for i in order if i not in before and i not in chosen and bool(shown[i, c])]
        missing = MIN_CLASS_IMAGES - int(shown[[*before, *chosen], c].sum())
        chosen += free[: min(max(missing, 0), number // 2 - len(chosen))]
    return chosen
