"""What a trial found: average precision of every row, with intervals, differences, and worth.

Axis letters: B resamples, S seeds.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .bootstrap import Draws, Estimate, draw, estimate, over_seeds, worth, worth_in_words
from .jobs import Job
from .plan import Row
from .scoring import MAIN, average_precision, coco_figures, match, measures
from .sets import LabelledSet
from .training import Detections

MEAN = "mean"
Column = tuple[str, str]
"""A class, or ``MEAN`` of them, and the name of a measure."""


class Worth(NamedTuple):
    """How many labelled photographs give the same: in words, and the words of its 95 % interval's ends."""

    number: str
    low: str
    high: str


class Results(NamedTuple):
    """What a trial found.

    Attributes:
        rows: names, in their order.
        columns: what is measured.
        samples: by row and column, ``(1 + B,)``: the mean over the seeds, then its resamples.
        by_seed: by row and column, ``(S,)``.
        photographs: of a row that is shown labelled photographs alone, how many.
        baselines: rows that others are compared with.
        coco: by row, COCO's own figures, the mean over the seeds.
        counts: of test images, seeds, resamples.
        budget: iterations, batch size and image size, and the detector.
    """

    rows: tuple[str, ...]
    columns: tuple[Column, ...]
    samples: dict[tuple[str, Column], NDArray[np.float64]]
    by_seed: dict[tuple[str, Column], NDArray[np.float64]]
    photographs: dict[str, int]
    baselines: tuple[str, ...]
    coco: dict[str, dict[str, float]]
    counts: dict[str, int]
    budget: str

    @property
    def main(self) -> Column:
        """The column that rows are compared by."""
        return next((name, measure) for name, measure in self.columns if name == MEAN and measure in MAIN)

    def precision(self, row: str, column: Column | None = None) -> Estimate:
        """Average precision, 0 to 1."""
        return estimate(self.samples[row, column or self.main])

    def difference(self, row: str, other: str, column: Column | None = None) -> Estimate:
        """A row's average precision less another's, on the same resamples."""
        column = column or self.main
        return estimate(self.samples[row, column] - self.samples[other, column])

    def worth(self, row: str, column: Column | None = None) -> Worth | None:
        """What a row is worth in labelled photographs; None where fewer than two numbers of them were tried."""
        column = column or self.main
        ladder = sorted(self.photographs, key=lambda name: self.photographs[name])
        if len(ladder) < 2:
            return None
        numbers = [self.photographs[name] for name in ladder]
        reached = np.stack([self.samples[name, column] for name in ladder], 1)
        own = self.samples[row, column]
        middles = [_middle(worth(v, numbers, r)) for v, r in zip(own[1:], reached[1:], strict=True)]
        ends = [float(np.quantile(middles, q, method="nearest")) for q in (0.025, 0.975)] if middles else [0, np.inf]
        low, high = (f"<{numbers[0]}" if e == 0 else f">{numbers[-1]}" if np.isinf(e) else f"{e:.0f}" for e in ends)
        return Worth(worth_in_words(own[0], numbers, list(reached[0])), low, high)

    def record(self) -> dict[str, Any]:
        """All figures, for JSON."""
        rows = {}
        for name in self.rows:
            figures = {}
            for column in self.columns:
                known = self.worth(name, column)
                figures.setdefault(column[1], {})[column[0]] = {
                    **self.precision(name, column).record(),
                    "seeds": [None if np.isnan(v) else round(float(v), 6) for v in self.by_seed[name, column]],
                    "worth": None if known is None else known._asdict(),
                }
            others = {other: self._differences(name, other) for other in self.rows if other != name}
            rows[name] = {
                "precision": figures,
                "difference": others,
                "photographs": self.photographs.get(name),
                "coco": {key: round(value, 6) for key, value in self.coco[name].items()},
            }
        return {
            "rows": rows,
            "order": list(self.rows),
            "baselines": list(self.baselines),
            **self.counts,
            "budget": self.budget,
        }

    def _differences(self, name: str, other: str) -> dict[str, dict[str, Any]]:
        figures: dict[str, dict[str, Any]] = {}
        for column in self.columns:
            figures.setdefault(column[1], {})[column[0]] = self.difference(name, other, column).record()
        return figures


def score(
    job: Job,
    tested: LabelledSet,
    rows: Sequence[Row],
    photographs: int,
    baselines: tuple[str, ...],
    resamples: int,
    progress: Callable[[int, int], None],
) -> Results:
    """Of finished trainings.

    Args:
        photographs: how many there are of labelled ones to train on.
    """
    draws = draw(len(job.test), job.seeds, resamples, job.seed)
    samples: dict[tuple[str, Column], NDArray[np.float64]] = {}
    by_seed: dict[tuple[str, Column], NDArray[np.float64]] = {}
    coco: dict[str, dict[str, float]] = {}
    columns: list[Column] = []
    for number, row in enumerate(rows):
        progress(number, len(rows))
        found = [job.detections(row.name, s) for s in range(job.seeds)]
        figures = [coco_figures(tested, each) for each in found]
        coco[row.name] = {key: float(np.mean([f[key] for f in figures])) for key in figures[0]}
        each = precisions(tested, found, draws)
        columns = list(each)
        for column, values in each.items():
            samples[row.name, column] = over_seeds(values, draws)
            by_seed[row.name, column] = values[:, 0]
    progress(len(rows), len(rows))
    ladder = {row.name: n if n > 0 else photographs for row in rows if (n := row.photographs) is not None}
    counts = {"test_images": len(job.test), "seeds": job.seeds, "resamples": resamples}
    recipe, (height, width) = job.recipe, job.size
    training = f"{recipe.iterations:,} iterations of {recipe.batch_size} images at {width}x{height}"
    words = f"{job.choice.partition('=')[0]}, {training}"
    names = tuple(row.name for row in rows)
    return Results(names, tuple(columns), samples, by_seed, ladder, baselines, coco, counts, words)


def precisions(
    tested: LabelledSet, found: Sequence[Sequence[Detections]], draws: Draws
) -> Mapping[Column, NDArray[np.float64]]:
    """By column, ``(S, 1 + B)``: of every class, then of their mean. NaN where there is nothing to find.

    Args:
        found: for each seed, what was found in each test image.
    """
    each: dict[Column, NDArray[np.float64]] = {}
    for c, name in enumerate(tested.classes):
        for measure in measures(tested.kitti, name):
            of_seeds = [match(tested.examples, seen, c, measure) for seen in found]
            values = [average_precision(matched, draws.images, measure.recalls) for matched in of_seeds]
            each[name, measure.name] = np.stack(values)
    names = list(dict.fromkeys(measure for _, measure in each))
    for measure in names:
        stacked = np.stack([values for (_, word), values in each.items() if word == measure])
        known = ~np.isnan(stacked)
        total = np.where(known, stacked, 0.0).sum(0)
        each[MEAN, measure] = np.where(known.any(0), total / np.maximum(known.sum(0), 1), np.nan)
    return each


def _middle(ends: tuple[float, float]) -> float:
    """A number, 0 for fewer than the fewest, infinite for more than the most."""
    return ends[0] if ends[0] == ends[1] else (np.inf if np.isinf(ends[1]) else 0.0)
