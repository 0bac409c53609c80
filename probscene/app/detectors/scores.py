"""How good a detector is on photographs that it was not trained on, and from which score on to believe it."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..trial.bootstrap import draw, estimate
from ..trial.results import precisions
from ..trial.scoring import MAIN, Matched, match, measures
from ..trial.sets import LabelledSet
from ..trial.training import Detections

RESAMPLES = 1000  # of the photographs, for intervals


def record_of(tested: LabelledSet, found: Sequence[Detections], seed: int) -> dict[str, Any]:
    """Figures for JSON: ``images``; by class the number of ``objects``; ``precision``, by measure and class and of the
    classes' mean, with the 95 % interval of a bootstrap over the photographs, null of a class without objects;
    ``min_score`` and ``errors``, see ``fewest_errors``.

    Args:
        found: in each photograph.
        seed: of the bootstrap.
    """
    each = precisions(tested, [found], draw(len(tested.examples), 1, RESAMPLES, seed))
    figures: dict[str, dict[str, Any]] = {}
    for (name, measure), samples in each.items():
        figure = estimate(samples[0]).record()
        figures.setdefault(measure, {})[name] = {key: figure[key] for key in ("value", "low", "high")}
    matched = []
    for number, name in enumerate(tested.classes):
        (main,) = (measure for measure in measures(tested.kitti, name) if measure.name in MAIN)
        matched.append(match(tested.examples, found, number, main))
    best = fewest_errors(matched)
    return {
        "images": len(tested.examples),
        "objects": {name: int(of.objects.sum()) for name, of in zip(tested.classes, matched, strict=True)},
        "precision": figures,
        "min_score": None if best is None else best[0],
        "errors": None if best is None else best[1],
    }


def fewest_errors(matched: Sequence[Matched]) -> tuple[float, int] | None:
    """The least score to keep so that false detections and missed objects are fewest together, of several the highest,
    and how many they are; None where nothing was found.

    Args:
        matched: of each class; one threshold is for all.
    """
    score = np.concatenate([each.score for each in matched])
    if not len(score):
        return None
    best = np.argsort(-score, kind="stable")
    score, correct = score[best], np.concatenate([each.correct for each in matched])[best]
    missed = sum(int(each.objects.sum()) for each in matched) - np.cumsum(correct)
    errors = np.cumsum(~correct) + missed
    last = np.append(score[1:] < score[:-1], True)  # of the detections with one score
    at = np.flatnonzero(last)[np.argmin(errors[last])]
    return float(score[at]), int(errors[at])
