"""What labels would count in rendered scenes: objects that can be seen, instead of all that a structure has.

A street's structure holds cars behind other cars, beside the image and too far away to be labelled: of the driving
model's cars in a city, about one in eight has no visible pixel, and one in four more is lower than 25 of KITTI's. Where
labels are of what can be seen, so is what they are compared with.
"""

from collections.abc import Callable

import torch

from probscene.batch import RenderBatch
from probscene.model import SceneModel
from probscene.policy import Policy

from ..chunks import CHUNK, draw_chunk
from ..datasets.coco import labelled
from ..loading import renderer_for
from .labels import Labels
from .structure_counts import Counts, StructureCounts, sampled

SHOWN = 2000  # scenes at most that are rendered to be counted

Each = Callable[[int], None]
"""Told how many more are counted."""


def number_of(truth: Labels | None, num: int) -> int:
    """How many scenes ``counted`` counts of ``num``."""
    return num if truth is None or truth.min_height is None else min(num, SHOWN)


def counted(
    model: SceneModel, policy: Policy, num: int, seed: int, truth: Labels | None, each: Each | None = None
) -> StructureCounts:
    """The counts of scenes with structures from ``policy``, to compare with ``truth``: rendered where its labels are of
    what can be seen, else as ``sampled`` gives them."""
    if truth is None or truth.min_height is None:
        return sampled(model, policy, num, seed, each)
    return StructureCounts(shown(model, policy, number_of(truth, num), seed, truth.min_height, each), {})


def shown(
    model: SceneModel, policy: Policy, num: int, seed: int, min_height: float, each: Each | None = None
) -> Counts:
    """The labels ``(num, C)`` by class of what ``generate`` would write in KITTI's format, the same for the same seed.

    Args:
        min_height: of a box that is counted, pixels of the canvas.
    """
    render, parts = renderer_for(model), []
    numbers = torch.arange(1, len(model.classes) + 1).view(-1, 1, 1)
    for chunk, first in enumerate(range(0, num, CHUNK)):
        batch = render(draw_chunk(model, policy, seed, chunk).drawing[: num - first])
        counts = (labelled(model, batch) == numbers) & (_height(model, batch) >= min_height)
        parts.append(counts.sum(2).T)
        if each is not None:
            each(len(parts[-1]))
    return torch.cat(parts).numpy()


def _height(model: SceneModel, batch: RenderBatch) -> torch.Tensor:
    """The height ``(N, M)`` of the boxes that ``kitti.label`` writes."""
    if batch.space is None:
        return batch.box[..., 3] - batch.box[..., 1]
    top, bottom = ((batch.amodal_box[..., i] - 0.5).clamp(0, model.canvas[0] - 1) for i in (1, 3))
    return bottom - top
