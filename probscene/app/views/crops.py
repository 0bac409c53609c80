"""Objects cut out with what is around them, by size: of photographs whose boxes are known, and of scenes."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from probscene.dataset import Images
from probscene.policy import Policy

from ..chunks import CHUNK, draw_chunk
from ..datasets.coco import labelled
from ..fitting.run import RunFolder
from ..labels.boxes import Boxes
from ..loading import renderer_for
from ..pictures import Pixels, pixels

NUM_SCENES = 128  # of a policy
MAX_IMAGES = 500  # of the target
NUM_CROPS = 12  # of a class
AROUND = 1.3  # times the side of the largest object that is shown
MIN_CROP = 12  # pixels


class Crops(NamedTuple):
    """Of one class and one source.

    Attributes:
        images: from the smallest object to the largest, all of one scale; ``(S, S, 3)``.
        median: the median width and height of all the source's objects, pixels.
        number: of these.
    """

    images: list[Pixels]
    median: tuple[float, float]
    number: int


class _Found(NamedTuple):
    """Objects of images: ``(n, 4)`` boxes, ``(n,)`` classes and numbers of images."""

    images: list[Pixels]
    box: Tensor
    label: Tensor
    image: Tensor


def object_crops(
    run: RunFolder, policies: dict[str, Policy], target: Images | None, boxes: Boxes | None
) -> dict[str, dict[str, Crops]]:
    """By class and source, ``"target"`` first, of those that have any; at equally spaced quantiles of their sizes.

    Args:
        policies: by source what draws scenes.
        boxes: of some of the target's images.
    """
    found = {} if target is None or boxes is None else {"target": _of_target(run, target, boxes)}
    found |= {source: _of_scenes(run, policy) for source, policy in policies.items()}
    return {name: crops for c, name in enumerate(run.model.classes) if (crops := _of_class(found, c))}


def _of_target(run: RunFolder, target: Images, boxes: Boxes) -> _Found:
    boxes = boxes.some(MAX_IMAGES)
    images = [pixels(target.load(row)[None])[0] for row in boxes.rows]
    number = torch.tensor([run.model.classes.index(name) for name in boxes.classes])
    every = torch.cat([*boxes.boxes, torch.zeros(0, 5)])
    image = torch.arange(len(images)).repeat_interleave(torch.tensor([len(each) for each in boxes.boxes]))
    return _Found(images, every[:, 1:], number[every[:, 0].long()], image)


def _of_scenes(run: RunFolder, policy: Policy) -> _Found:
    render, images, parts = renderer_for(run.model), list[Pixels](), []
    for chunk in range(NUM_SCENES // CHUNK):
        batch = render(draw_chunk(run.model, policy, 0, chunk).drawing)
        category = labelled(run.model, batch)
        scene, node = category.nonzero().unbind(1)
        parts.append((batch.box[scene, node].float(), category[scene, node] - 1, scene + len(images)))
        images += pixels(batch.image)
    return _Found(images, *map(torch.cat, zip(*parts, strict=True)))


def _of_class(found: dict[str, _Found], c: int) -> dict[str, Crops]:
    chosen: dict[str, tuple[_Found, Tensor, Tensor]] = {}
    for source, (images, box, label, image) in found.items():
        mine = label == c
        own = _Found(images, box[mine], label[mine], image[mine])
        extent = own.box[:, 2:] - own.box[:, :2]
        if len(extent):
            order = extent.prod(1).argsort(stable=True)
            at = (torch.arange(NUM_CROPS) + 0.5) / NUM_CROPS * len(order)
            chosen[source] = own, order[at.long().unique()], extent
    if not chosen:
        return {}
    largest = max(float(extent[rows].max()) for _, rows, extent in chosen.values())
    side = max(MIN_CROP, round(AROUND * largest))
    return {
        source: Crops(list(_cropped(own, rows, side)), tuple(extent.median(0).values.tolist()), len(extent))
        for source, (own, rows, extent) in chosen.items()
    }


def _cropped(own: _Found, rows: Tensor, side: int) -> Iterator[Pixels]:
    for row in rows.tolist():
        image, (x0, y0, x1, y1) = own.images[int(own.image[row])], own.box[row].tolist()
        left, top = round((x0 + x1 - side) / 2) + side, round((y0 + y1 - side) / 2) + side
        yield np.pad(image, ((side, side), (side, side), (0, 0)), "edge")[top : top + side, left : left + side]
