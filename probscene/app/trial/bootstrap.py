"""Intervals by a paired bootstrap [1] over test images and seeds, and what a set is worth in labelled photographs.

A resample draws as many test images, with replacement, as there are, and as many seeds as there are; all sets are
scored on the same draw, so that a difference between two has the interval of the difference. A seed is a start of the
detector and, where a set has n of its images, a choice of them; sets are paired by it.

Axis letters: B resamples, L test images, S seeds.

References:
    [1] Efron, Tibshirani, *An Introduction to the Bootstrap*, 1993.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

LEVEL = 0.95


class Estimate(NamedTuple):
    """A figure and its 95 % interval.

    Attributes:
        above: share of resamples in which it is more than 0.
    """

    value: float
    low: float
    high: float
    above: float

    def record(self) -> dict[str, float | None]:
        """For JSON; None where there is no figure."""
        return {name: None if np.isnan(v) else round(float(v), 6) for name, v in self._asdict().items()}


class Draws(NamedTuple):
    """What is drawn: weights of test images ``(1 + B, L)`` and of seeds ``(1 + B, S)``, the first of each all ones, for
    the figure itself."""

    images: NDArray[np.int64]
    seeds: NDArray[np.int64]


def draw(images: int, seeds: int, resamples: int, seed: int) -> Draws:
    """The same for the same seed."""
    random = np.random.default_rng([seed, 20])
    return Draws(_weights(images, resamples, random), _weights(seeds, resamples, random))


def over_seeds(each: NDArray[np.float64], draws: Draws) -> NDArray[np.float64]:
    """The mean ``(1 + B,)`` of figures ``(S, 1 + B)`` over the seeds that were drawn."""
    weights = draws.seeds.T / draws.seeds.sum(1)
    return (each * weights).sum(0)


def estimate(samples: NDArray[np.float64]) -> Estimate:
    """Of ``(1 + B,)``: the figure, then its resamples, which may be NaN."""
    drawn = samples[1:][~np.isnan(samples[1:])]
    if not len(drawn):
        return Estimate(float(samples[0]), np.nan, np.nan, np.nan)
    low, high = np.quantile(drawn, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return Estimate(float(samples[0]), float(low), float(high), float((drawn > 0).mean()))


def worth(value: float, numbers: Sequence[int], reached: Sequence[float]) -> tuple[float, float]:
    """How many labelled photographs reach ``value``: the least and the most.

    Between the ``numbers`` for which it is known what they reach, precision is a line in log n, and never falls: where
    fewer reached more than more did, both count as their mean.

    Args:
        numbers: of labelled photographs, rising.
        reached: with each.

    Returns:
        the same number twice where it is known; ``(0, first)`` where fewer than the first are enough, ``(last, inf)``
        where more than the last are needed. Where several numbers reach the same, the fewest.
    """
    level = monotone(reached)
    if np.isnan(value) or np.isnan(level).any():
        return (0.0, np.inf)
    if value < level[0]:
        return (0.0, float(numbers[0]))
    if value > level[-1]:
        return (float(numbers[-1]), np.inf)
    at = int(np.searchsorted(level, value, side="left"))
    if level[at] == value or at == 0:
        return (float(numbers[at]), float(numbers[at]))
    way = (value - level[at - 1]) / (level[at] - level[at - 1])
    low, high = np.log(numbers[at - 1]), np.log(numbers[at])
    number = float(np.exp(low + way * (high - low)))
    return (number, number)


def worth_in_words(value: float, numbers: Sequence[int], reached: Sequence[float]) -> str:
    """``"34"``, ``"<10"`` or ``">220"``."""
    least, most = worth(value, numbers, reached)
    if least == most:
        return f"{least:.0f}"
    if np.isinf(most):
        return f">{least:.0f}" if least else "?"
    return f"<{most:.0f}"


def monotone(values: Sequence[float]) -> NDArray[np.float64]:
    """The nearest values, in least squares, that never fall."""
    blocks: list[tuple[float, int]] = []
    for value in values:
        mean, size = float(value), 1
        while blocks and blocks[-1][0] > mean:
            before, number = blocks.pop()
            mean, size = (before * number + mean * size) / (number + size), size + number
        blocks.append((mean, size))
    return np.concatenate([np.full(size, mean) for mean, size in blocks]) if blocks else np.zeros(0)


def _weights(number: int, resamples: int, random: np.random.Generator) -> NDArray[np.int64]:
    drawn = random.multinomial(number, np.full(number, 1 / number), size=resamples)
    return np.concatenate([np.ones((1, number), np.int64), drawn])
