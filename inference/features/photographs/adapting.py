"""Suiting a ``PretrainedCountNet`` to photographs: a rule for each class, and which classes are compared.

Axis letters: L photographs, K labelled images, S scopes, R rules, C classes.
"""

from typing import Any

import torch
from torch import Tensor

from ..base import ImageCallback, Photographs
from .net import MIN_PIXELS, PretrainedCountNet
from .readability import Read, Reading, rules_for_renders, with_labels, without_labels
from .reading import RULES, SCOPES

LOOKED_AT_ONCE = 64  # images
MIN_VISIBLE = min(scope.visible for scope in SCOPES)  # of an object that people are taken to label


def adapt(net: PretrainedCountNet, photographs: Photographs, most: int, callback: ImageCallback) -> dict[str, Any]:
    """Choose rules, scopes and what is compared, in place.

    Args:
        net: with heads that are trained and have learnt from photographs.
        most: photographs that are looked at, beside the labelled ones.
        callback: see ``Features.adapt``.

    Returns:
        ``"classes"``: a record of each.
    """
    images, labelled = photographs.subset(most), photographs.labelled
    marked = images[:0] if labelled is None else labelled.images
    total = len(images) + len(marked)
    whole = _read_images(net, images, 0, total, callback)
    of_labelled = _read_images(net, marked, len(images), total, callback) if len(marked) else whole[:0]
    read = Read(whole, of_labelled, net.apart, net.held_read, net.held_true)
    counts = {} if labelled is None else dict(zip(labelled.classes, labelled.counts.T, strict=True))
    records: dict[str, Any] = {}
    for c, name in enumerate(net.classes):
        if name in net.stuff:
            found = without_labels(read, c)
            because = f"{found.mean:.1f} an image, not compared, as stuff has no count"
            found = found._replace(readable=True, because=because)
        elif net.size[c] < MIN_PIXELS:
            found = without_labels(read, c)._replace(readable=False, because=_too_small(net, c))
        elif name in counts:
            found = with_labels(read, c, counts[name])
        else:
            found = without_labels(read, c)
        visible, pixels = SCOPES[found.scope][:2]
        if labelled is not None and labelled.boxes is not None and found.by != "agreement":
            smallest = _smallest(net, labelled.boxes, labelled.classes.index(name))
            visible, pixels = MIN_VISIBLE, min(smallest, pixels)  # the smallest of few is larger than that of all
            found = found._replace(because=f"{found.because}; in scenes, objects count from {pixels:.0f} pixels")
        net.counted_from[c] = torch.tensor([visible, pixels])
        _keep(net, c, found)
        records[name] = _record(net, c, found) | {"visible": visible, "from_pixels": pixels}
    net.bind(photographs.fingerprint)
    return {"classes": records}


def _read_images(net: PretrainedCountNet, images: Tensor, done: int, total: int, callback: ImageCallback) -> Tensor:
    """Readings ``(L, S, R, C)``."""
    parts = []
    for some in images.split(LOOKED_AT_ONCE):
        parts.append(net.readings(net.compute_maps(some))[0])
        done += len(some)
        callback(done, total)
    return torch.cat(parts)


def _smallest(net: PretrainedCountNet, boxes: tuple[Tensor, ...], number: int) -> float:
    """The longer side of the smallest of a class's boxes, pixels of what enters."""
    of_class = torch.cat([some[some[:, 0] == number, 1:] for some in boxes])
    return float(((of_class[:, 2:] - of_class[:, :2]) * net.scale()).amax(1).min())


def _keep(net: PretrainedCountNet, c: int, found: Reading) -> None:
    scope = found.scope
    net.scope[c] = scope
    net.rules[0, c] = rules_for_renders(
        net.held_read[:, scope, :, c : c + 1].transpose(1, 2), net.held_true[:, scope, c : c + 1]
    )[0]
    net.rules[1, c] = False
    net.rules[1, c, list(found.rules)] = True
    net.steps[c] = torch.inf
    net.steps[c, : len(found.steps)] = torch.tensor(found.steps)
    net.read[net.order.index(c)] = found.readable


def _record(net: PretrainedCountNet, c: int, found: Reading) -> dict[str, Any]:
    """For JSON, but for what counts in scenes."""
    return {
        "readable": found.readable,
        "because": found.because,
        "by": found.by,
        "rules": [str(RULES[rule]) for rule in found.rules],
        "mean": found.mean,
        "disagreement": found.disagreement,
        "spread": found.spread,
        "skill": found.skill,
        "error": found.error if found.error == found.error else None,
        "pixels": float(net.size[c]),
    }


def _too_small(net: PretrainedCountNet, c: int) -> str:
    pixels, needed = float(net.size[c]), MIN_PIXELS
    height, width = net.canvas
    entering = net.frozen[0].entering(height, width)
    scale = needed / pixels * 1.1
    if entering[0] >= 0.9 * height:
        remedy = f"a canvas of at least {round(height * scale)} x {round(width * scale)} pixels shows it"
    else:
        remedy = "cut the photographs into parts"
    return f"not readable, {pixels:.1f} pixels in the network's input of {needed:.1f} needed: {remedy}"
