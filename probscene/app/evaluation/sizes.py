"""Sizes of objects: boxes that were given with labels, compared with those of the prior's and of learnt scenes.

Features of whole images, by which looks are judged and sites of the scene are learnt, may come nearer while objects
get too large. The medians of width and height of each class are compared, of visible boxes as ``generate`` writes them.
Intervals are of a bootstrap over images, in which the boxes of one image stay together. Axis letters: N images, n boxes
of all of them, R resamples.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from probscene.dataset import Images
from probscene.inference.statistics.residual import RESAMPLES, Grade, worst_grade
from probscene.policy import Policy

from ..chunks import CHUNK, draw_chunk
from ..datasets.coco import labelled
from ..fitting.box_margins import box_margins, without_margins
from ..fitting.run import RunFolder
from ..labels.boxes import Boxes
from ..loading import renderer_for
from .components import UNSURE, VerdictComponent, VerdictComponents

NUM_SCENES = 200  # of the prior, and of the fit
MIN_BOXES = 10  # of a class
TOLERATED_LOG_RATIO = 0.1  # of a learnt median to the given one
CONFIDENCE = 0.975  # share of resamples

Array = NDArray[np.float64]


class BoxSizes(NamedTuple):
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
        grade: None where the boxes are too few to say.
        worse: whether learnt sizes are significantly farther from those given than the prior's.
        boxes: that were given.
        margin: pixels of room on each side of them, which are taken off.
    """

    given: tuple[float, float]
    low: tuple[float, float]
    high: tuple[float, float]
    prior: tuple[float, float]
    learnt: tuple[float, float]
    off: float
    off_low: float
    off_high: float
    grade: Grade | None
    worse: bool
    boxes: int
    margin: float = 0.0

    def __str__(self) -> str:
        limits = " x ".join(f"{a:.1f} to {b:.1f}" for a, b in zip(self.low, self.high, strict=True))
        given, prior, learnt = map(_text, (self.given, self.prior, self.learnt))
        room = f", without the labels' margin of {self.margin:.1f}" if self.margin else ""
        return f"{given} pixels in the images ({limits}{room}), {prior} in the prior, {learnt} learnt"


def sizes(
    run: RunFolder, boxes: Boxes, target: Images, callback: Callable[[int], None], seed: int = 0
) -> dict[str, Sizes]:
    """Of each class with ``MIN_BOXES`` boxes that were given, and in the scenes.

    Args:
        boxes: of the target's images; the room that they leave around objects is taken off.
        callback: called with the number of scenes of each batch.
    """
    margins = box_margins(run.model, boxes, target)
    prior, learnt = (_scene_boxes(run, policy, callback, seed) for policy in (run.model.prior, run.guide))
    return {
        name: compare_sizes(given, prior[name], learnt[name], seed)._replace(
            margin=margins[name].pixels if name in margins else 0.0
        )
        for name, given in _given_boxes(without_margins(boxes, margins)).items()
        if min(len(boxes.size) for boxes in (given, prior[name], learnt[name])) >= MIN_BOXES
    }


def with_sizes(found: VerdictComponents, by_class: dict[str, Sizes]) -> VerdictComponents:
    """A verdict with a component for sizes. Looks are no better than the prior's where sizes are farther off than
    those."""
    if not by_class:
        return found
    grades = [size.grade for size in by_class.values()]
    grade = worst_grade(known) if (known := [grade for grade in grades if grade is not None]) else None
    grade = None if grade is Grade.GOOD and None in grades else grade
    reason = "; ".join(f"{name}: {size}" for name, size in by_class.items()) + "."
    wrong = [name for name, size in by_class.items() if size.grade is Grade.NO_BETTER]
    remedy = (
        f"Sizes of {', '.join(wrong)} are wrong: set the priors of the sites that determine them by these figures, "
        "and exclude those sites from learning (infer={'learn': False})."
        if wrong
        else "More boxes would decide it."
        if grade is None
        else ""
    )
    component = VerdictComponent(grade, reason, remedy, None, UNSURE if grade is None else str(grade))
    parts = found.parts | {"sizes": component}
    looks, worse = parts["looks"], ", ".join(name for name, size in by_class.items() if size.worse)
    if worse and looks.grade in (Grade.GOOD, Grade.BETTER):
        reason = f"{looks.reason} But the sizes of {worse} are farther from the labelled ones than the prior's."
        lowered = {"grade": Grade.NO_BETTER, "verdict": str(Grade.NO_BETTER), "reason": reason, "remedy": remedy}
        parts["looks"] = replace(looks, **lowered)
    return replace(found, parts=parts)


def record(by_class: dict[str, Sizes]) -> dict[str, Any]:
    """For JSON."""
    return {name: _record(size) for name, size in by_class.items()}


def _record(size: Sizes) -> dict[str, Any]:
    known = {"word" if field == "grade" else field: value for field, value in size._asdict().items()}
    return known | {"word": None if size.grade is None else str(size.grade)}


def compare_sizes(given: BoxSizes, prior: BoxSizes, learnt: BoxSizes, seed: int = 0) -> Sizes:
    """One class."""
    rng = np.random.default_rng(seed)
    real, before, after = (_medians(boxes, rng) for boxes in (given, prior, learnt))
    off_before, off = (np.abs(np.log(side / real)).max(1) for side in (before, after))
    low, high = np.quantile(real[1:], [1 - CONFIDENCE, CONFIDENCE], axis=0)
    off_low, off_high = np.quantile(off[1:], [1 - CONFIDENCE, CONFIDENCE])
    nearer, farther = ((sign * (off - off_before)[1:] > 0).mean() >= CONFIDENCE for sign in (-1, 1))
    worse = bool(farther and off_high > TOLERATED_LOG_RATIO)
    grade = None
    if off_high <= TOLERATED_LOG_RATIO:
        grade = Grade.GOOD
    elif nearer:
        grade = Grade.BETTER
    elif worse or off_low > TOLERATED_LOG_RATIO:
        grade = Grade.NO_BETTER
    return Sizes(
        given=_pair(real[0]),
        low=_pair(low),
        high=_pair(high),
        prior=_pair(before[0]),
        learnt=_pair(after[0]),
        off=float(off[0]),
        off_low=float(off_low),
        off_high=float(off_high),
        grade=grade,
        worse=worse,
        boxes=len(given.size),
    )


def _medians(boxes: BoxSizes, rng: np.random.Generator) -> Array:
    """``(1 + R, 2)`` medians of width and height: of all boxes, and of resamples of the images."""
    size, image, N = boxes
    weight = np.concatenate([np.ones((1, N)), rng.multinomial(N, np.full(N, 1 / N), RESAMPLES)])[:, image]
    weight[weight.sum(1) == 0] = 1  # no image of a resample has a box
    found = np.empty((len(weight), 2))
    for k in (0, 1):
        order = size[:, k].argsort()
        reached = weight[:, order].cumsum(1)
        half = (reached >= reached[:, -1:] / 2).argmax(1)
        found[:, k] = size[order[half], k]
    return found


def _given_boxes(boxes: Boxes) -> dict[str, BoxSizes]:
    of_class = torch.cat([found[:, 0] for found in boxes.boxes]).long().numpy()
    corners = torch.cat([found[:, 1:] for found in boxes.boxes]).double().numpy()
    image = np.repeat(np.arange(len(boxes.boxes)), [len(found) for found in boxes.boxes])
    return _by_class(boxes.classes, of_class, corners, image, len(boxes.boxes))


def _scene_boxes(run: RunFolder, policy: Policy, callback: Callable[[int], None], seed: int) -> dict[str, BoxSizes]:
    """Of the first scenes that ``generate`` would render, the boxes of what labels count."""
    model, shares = run.model, run.visible_shares()
    render, parts = renderer_for(model), []
    min_visible = torch.tensor([0.0, *(shares.get(name, 0.0) for name in model.classes)])
    for chunk, first in enumerate(range(0, NUM_SCENES, CHUNK)):
        batch = render(draw_chunk(model, policy, seed, chunk).drawing[: NUM_SCENES - first])
        category = labelled(model, batch)
        scene, node = ((category > 0) & (batch.visible >= min_visible[category])).nonzero().unbind(1)
        parts.append((category[scene, node] - 1, batch.box[scene, node].double(), scene + first))
        callback(len(batch.kind))
    c, corners, image = (torch.cat(some).numpy() for some in zip(*parts, strict=True))
    return _by_class(model.classes, c, corners, image, NUM_SCENES)


def _by_class(names: tuple[str, ...], c: Any, corners: Array, image: Any, N: int) -> dict[str, BoxSizes]:
    size = corners[:, 2:] - corners[:, :2]
    kept = (size > 0).all(1)
    return {name: BoxSizes(size[kept & (c == i)], image[kept & (c == i)], N) for i, name in enumerate(names)}


def _pair(values: Any) -> tuple[float, float]:
    return float(values[0]), float(values[1])


def _text(pair: tuple[float, float]) -> str:
    return f"{pair[0]:.1f} x {pair[1]:.1f}"
