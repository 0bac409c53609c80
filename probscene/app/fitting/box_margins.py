"""How much room labels leave around the objects of a target, and what their boxes are without it."""

import numpy as np
import torch

from probscene.dataset import Images, grey
from probscene.inference.features.base import class_table
from probscene.inference.statistics.box_margin import EdgeProfiles, MarginEstimate, edge_profiles, estimate_margin
from probscene.model import SceneModel

from ..arguments import margin_text
from ..chunks import CHUNK, draw_chunk
from ..labels.boxes import Boxes
from ..loading import renderer_for
from .given_boxes import stacked

NUM_SCENES = 256  # of the prior
MAX_IMAGES = 500  # of the target


def box_margins(model: SceneModel, boxes: Boxes, images: Images) -> dict[str, MarginEstimate]:
    """By class, where labels leave some, by the edges of objects in the prior's scenes.

    Args:
        boxes: of some of the images; those of ``MAX_IMAGES`` are looked at.
    """
    if not any(map(len, boxes.boxes)):
        return {}
    own, renders = edge_profiles(*stacked(boxes.some(MAX_IMAGES), model.classes, images)), _of_prior(model)
    each = {name: estimate_margin(own, renders, model.classes.index(name)) for name in boxes.classes}
    return {name: margin for name, margin in each.items() if margin is not None}


def without_margins(boxes: Boxes, margins: dict[str, MarginEstimate]) -> Boxes:
    """Boxes that touch their objects."""
    scale = torch.tensor([margins[name].scale if name in margins else 1.0 for name in boxes.classes])
    each = []
    for found in boxes.boxes:
        middle, half = (found[:, 1:3] + found[:, 3:]) / 2, (found[:, 3:] - found[:, 1:3]) / 2
        half = half / scale[found[:, 0].long(), None]
        each.append(torch.cat([found[:, :1], middle - half, middle + half], 1))
    return boxes._replace(boxes=tuple(each)) if margins else boxes


def margins_said(margins: dict[str, MarginEstimate]) -> str:
    """One sentence for a person, and what to do."""
    words = ", ".join(f"{name} {margin}" for name, margin in margins.items())
    pixels = margin_text({name: round(margin.pixels) for name, margin in margins.items()})
    return (
        f"Labels leave room around objects, in pixels on each side: {words}. Objects are taken to be as large as their "
        f"edges are apart; generate, train and trial widen boxes with --box-margin {pixels}."
    )


def _of_prior(model: SceneModel) -> EdgeProfiles:
    render, classes, parts = renderer_for(model), class_table(model.grammar.kinds, model.classes), []
    for chunk in range(NUM_SCENES // CHUNK):
        batch = render(draw_chunk(model, model.prior, 0, chunk).drawing)
        image = grey(batch.image) if model.channels == 1 else batch.image
        part = edge_profiles(image, batch.box.float(), classes[batch.kind].masked_fill(batch.pixels == 0, -1))
        parts.append(part._replace(image=part.image + chunk * CHUNK))
    return EdgeProfiles(*map(np.concatenate, zip(*parts, strict=True)))
