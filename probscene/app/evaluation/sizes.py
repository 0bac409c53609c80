"""Sizes of objects: boxes that were given with labels, beside those of the prior's and of learnt scenes.

Features of whole images, by which looks are judged and sites of the scene are learnt, may come nearer while objects
get too large. Of each class the medians of width and height are compared, of boxes of what is visible as ``generate``
writes them. Intervals are of a bootstrap over images, in which the boxes of one image stay together. Axis letters: N
images, n boxes of all of them, R resamples.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from probscene.dataset import Images
from probscene.errors import DataError
from probscene.inference.statistics.residual import RESAMPLES, Grade, worst
from probscene.policy import Policy

from ..chunks import CHUNK, draw_chunk
from ..datasets.coco import labelled
from ..fitting.run import RunFolder
from ..labels.boxes import Boxes
from ..labels.partial_labels import read_partial_labels
from ..loading import renderer_for
from .components import UNSURE, VerdictComponent, VerdictComponents

SCENES = 200  # of the prior, and of the fit
ENOUGH = 10  # boxes of a class
TOLERATED = 0.1  # by which a median may be off and sizes are still good
SURE = 0.975  # of resamples

Array = NDArray[np.float64]


class Boxed(NamedTuple):
    """The boxes of one class.

    Attributes:
        size: ``(n, 2)`` widths and heights, pixels.
        image: ``(n,)`` the image of each.
        images: N.
    """

    size: Array
    image: NDArray[np.int64]
    images: int


class Sizes(NamedTuple):
    """How large the objects of one class are, medians of width and height in pixels.

    Attributes:
        given: of the boxes that were given; ``low`` and ``high`` their 95 % limits.
        prior, learnt: of boxes in scenes.
        off: how far the learnt medians are off, as the logarithm of their ratio to those given, the larger of both;
            ``off_low`` and ``off_high`` its 95 % limits.
        word: None where the boxes are too few to say.
        worse: whether learnt sizes are surely farther from those given than the prior's.
        boxes: that were given.
    """

    given: tuple[float, float]
    low: tuple[float, float]
    high: tuple[float, float]
    prior: tuple[float, float]
    learnt: tuple[float, float]
    off: float
    off_low: float
    off_high: float
    word: Grade | None
    worse: bool
    boxes: int

    def __str__(self) -> str:
        limits = " x ".join(f"{a:.1f} to {b:.1f}" for a, b in zip(self.low, self.high, strict=True))
        given, prior, learnt = map(_by, (self.given, self.prior, self.learnt))
        return f"{given} pixels in the images ({limits}), {prior} in the prior, {learnt} learnt"


def given_boxes(run: RunFolder, target: Images) -> Boxes | None:
    """The boxes that the run was given with its labels; None where these were none, or are gone by now.

    Args:
        target: the images that it was fitted to.
    """
    if "labels" not in run.record:
        return None
    try:
        few = read_partial_labels(run.record["labels"]["path"], run.model, target)
    except DataError:
        return None
    return None if few.boxes is None else Boxes(few.rows.tolist(), few.boxes, few.classes)


def sizes(run: RunFolder, boxes: Boxes, each: Callable[[int], None], seed: int = 0) -> dict[str, Sizes]:
    """Of each class of which enough boxes were given, and are in the scenes.

    Args:
        each: told how many more scenes are rendered.
    """
    prior, learnt = (_of_scenes(run, policy, each, seed) for policy in (run.model.prior, run.guide))
    return {
        name: compared(found, prior[name], learnt[name], seed)
        for name, found in _of_boxes(boxes).items()
        if min(len(each.size) for each in (found, prior[name], learnt[name])) >= ENOUGH
    }


def with_sizes(found: VerdictComponents, each: dict[str, Sizes]) -> VerdictComponents:
    """A verdict with a part for sizes. Looks are no better than the prior's where sizes are farther off than these."""
    if not each:
        return found
    words = [size.word for size in each.values()]
    word = worst(known) if (known := [word for word in words if word is not None]) else None
    word = None if word is Grade.GOOD and None in words else word
    because = "; ".join(f"{name}: {size}" for name, size in each.items()) + "."
    wrong = [name for name, size in each.items() if size.word is Grade.NO_BETTER]
    remedy = (
        f"Sizes of {', '.join(wrong)} are wrong: set the priors of the sites that they hang on by these figures, and "
        "leave those sites out of learning (infer={'learn': False})."
        if wrong
        else "More boxes would tell."
        if word is None
        else ""
    )
    parts = found.parts | {
        "sizes": VerdictComponent(word, because, remedy, None, UNSURE if word is None else str(word))
    }
    looks, worse = parts["looks"], ", ".join(name for name, size in each.items() if size.worse)
    if worse and looks.word in (Grade.GOOD, Grade.BETTER):
        because = f"{looks.because} But the sizes of {worse} are farther from those given than the prior's."
        lowered = {"word": Grade.NO_BETTER, "verdict": str(Grade.NO_BETTER), "because": because, "remedy": remedy}
        parts["looks"] = replace(looks, **lowered)
    return replace(found, parts=parts)


def record(each: dict[str, Sizes]) -> dict[str, Any]:
    """For JSON."""
    return {
        name: size._asdict() | {"word": None if size.word is None else str(size.word)} for name, size in each.items()
    }


def compared(given: Boxed, prior: Boxed, learnt: Boxed, seed: int = 0) -> Sizes:
    """One class."""
    rng = np.random.default_rng(seed)
    real, before, after = (_medians(boxed, rng) for boxed in (given, prior, learnt))
    off_before, off = (np.abs(np.log(side / real)).max(1) for side in (before, after))
    low, high = np.quantile(real[1:], [1 - SURE, SURE], axis=0)
    off_low, off_high = np.quantile(off[1:], [1 - SURE, SURE])
    nearer, farther = ((sign * (off - off_before)[1:] > 0).mean() >= SURE for sign in (-1, 1))
    worse = bool(farther and off_high > TOLERATED)
    word = None
    if off_high <= TOLERATED:
        word = Grade.GOOD
    elif nearer:
        word = Grade.BETTER
    elif worse or off_low > TOLERATED:
        word = Grade.NO_BETTER
    return Sizes(
        given=_pair(real[0]),
        low=_pair(low),
        high=_pair(high),
        prior=_pair(before[0]),
        learnt=_pair(after[0]),
        off=float(off[0]),
        off_low=float(off_low),
        off_high=float(off_high),
        word=word,
        worse=worse,
        boxes=len(given.size),
    )


def _medians(boxed: Boxed, rng: np.random.Generator) -> Array:
    """``(1 + R, 2)`` medians of width and height: of all boxes, and of resamples of the images."""
    size, image, N = boxed
    weight = np.concatenate([np.ones((1, N)), rng.multinomial(N, np.full(N, 1 / N), RESAMPLES)])[:, image]
    weight[weight.sum(1) == 0] = 1  # no image of a resample has a box
    found = np.empty((len(weight), 2))
    for k in (0, 1):
        order = size[:, k].argsort()
        reached = weight[:, order].cumsum(1)
        half = (reached >= reached[:, -1:] / 2).argmax(1)
        found[:, k] = size[order[half], k]
    return found


def _of_boxes(boxes: Boxes) -> dict[str, Boxed]:
    of_class = torch.cat([found[:, 0] for found in boxes.boxes]).long().numpy()
    corners = torch.cat([found[:, 1:] for found in boxes.boxes]).double().numpy()
    image = np.repeat(np.arange(len(boxes.boxes)), [len(found) for found in boxes.boxes])
    return _by_class(boxes.classes, of_class, corners, image, len(boxes.boxes))


def _of_scenes(run: RunFolder, policy: Policy, each: Callable[[int], None], seed: int) -> dict[str, Boxed]:
    """Of the first scenes that ``generate`` would render, the boxes of what labels count."""
    model, shares = run.model, run.visible_shares()
    render, parts = renderer_for(model), []
    least = torch.tensor([0.0, *(shares.get(name, 0.0) for name in model.classes)])
    for chunk, first in enumerate(range(0, SCENES, CHUNK)):
        batch = render(draw_chunk(model, policy, seed, chunk).drawing[: SCENES - first])
        category = labelled(model, batch)
        scene, node = ((category > 0) & (batch.visible >= least[category])).nonzero().unbind(1)
        parts.append((category[scene, node] - 1, batch.box[scene, node].double(), scene + first))
        each(len(batch.kind))
    c, corners, image = (torch.cat(some).numpy() for some in zip(*parts, strict=True))
    return _by_class(model.classes, c, corners, image, SCENES)


def _by_class(names: tuple[str, ...], c: Any, corners: Array, image: Any, N: int) -> dict[str, Boxed]:
    size = corners[:, 2:] - corners[:, :2]
    kept = (size > 0).all(1)
    return {name: Boxed(size[kept & (c == i)], image[kept & (c == i)], N) for i, name in enumerate(names)}


def _pair(values: Any) -> tuple[float, float]:
    return float(values[0]), float(values[1])


def _by(pair: tuple[float, float]) -> str:
    return f"{pair[0]:.1f} x {pair[1]:.1f}"
