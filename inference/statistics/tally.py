"""Distributions over 0, 1, 2, ... of what images show several of: cars on each road, of which an image has many.

Everything comes from one matrix, how many units of each image fall in each bin, so that the bootstrap can draw images
anew and not units: the roads of one image belong together. Axis letters: N images, P units, K bins, R resamples.

References:
    [1] Efron, *Bootstrap methods: another look at the jackknife*, 1979.
    [2] Field, Welsh, *Bootstrapping clustered data*, 2007: whole clusters are drawn.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from probscene.errors import ProbsceneError

from .metrics import Histogram, total_variation, wasserstein

LEVEL = 0.95


class Interval(NamedTuple):
    """A figure and where it would move with other images of the same kind.

    The bootstrap's spread is laid around the figure itself. A distance between samples is too large by nature, the more
    so the fewer the images; that bias is in the figure and not in the interval.
    """

    value: float
    low: float
    high: float


class Distance(NamedTuple):
    """How far two distributions of counts are apart: total variation in 0..1, Wasserstein-1 in objects."""

    total_variation: Interval
    wasserstein: Interval


class Tally(NamedTuple):
    """Units of each image by their count.

    Attributes:
        total: ``(K,)`` float64, how many units of all images have the count k.
        resampled: ``(R, K)`` float64, the same for each resample of the images.
    """

    total: NDArray[np.float64]
    resampled: NDArray[np.float64]

    @property
    def empty(self) -> bool:
        """Whether there is no unit in any image."""
        return not self.total.any()

    def mean(self) -> Interval | None:
        """The mean count of a unit; None where there is none."""
        if self.empty:
            return None
        bins = np.arange(len(self.total))
        return around(self.total @ bins / self.total.sum(), _shares(self.resampled) @ bins)

    def histogram(self) -> Histogram:
        """Shares of the units by count, ``(K,)``, with the interval of each; zeros where there is no unit."""
        low, high = np.zeros((2, len(self.total))) if self.empty else _quantiles(_shares(self.resampled))
        return Histogram(self.total / max(1.0, self.total.sum()), low, high)

    def distance(self, other: "Tally") -> Distance | None:
        """How far two tallies are apart; None where one is empty."""
        if self.empty or other.empty:
            return None
        R = min(len(self.resampled), len(other.resampled))
        size = max(len(self.total), len(other.total))
        p, q = (np.pad(x.total / x.total.sum(), (0, size - len(x.total))) for x in (self, other))
        drawn = [np.pad(_shares(x.resampled[:R]), ((0, 0), (0, size - len(x.total)))) for x in (self, other)]
        change = drawn[0] - drawn[1]
        return Distance(
            around(total_variation(p, q), np.abs(change).sum(1) / 2, least=0.0),
            around(wasserstein(p, q), np.abs(change.cumsum(1)).sum(1), least=0.0),
        )


def resamples(number: int, size: int = 200, seed: int = 0) -> NDArray[np.float32]:
    """How often each of ``number`` images is drawn in each of ``size`` resamples, ``(R, N)``."""
    return np.random.default_rng(seed).multinomial(number, np.full(number, 1 / number), size).astype(np.float32)


def tally(count: ArrayLike, image: ArrayLike, weight: NDArray[np.float32]) -> Tally:
    """A tally of units.

    Args:
        count: ``(P,)`` each unit's count.
        image: ``(P,)`` the image that it is in, 0..N-1.
        weight: ``(R, N)`` from ``resamples``; share one between tallies of the same images.

    Raises:
        ProbsceneError: a count below 0, or an image that is not there.
    """
    count, image = np.asarray(count, np.int64), np.asarray(image, np.int64)
    N = weight.shape[1]
    if count.min(initial=0) < 0 or image.min(initial=0) < 0 or image.max(initial=0) >= N or count.shape != image.shape:
        raise ProbsceneError(
            f"expected counts of 0 or more in images 0..{N - 1}, got {count.shape} counts from "
            f"{count.min(initial=0)} in {image.shape} images {image.min(initial=0)}..{image.max(initial=0)}."
        )
    units = np.zeros((N, 1 + int(count.max(initial=0))), np.float32)  # whole numbers, exact in either width
    np.add.at(units, (image, count), 1)
    return Tally(units.sum(0, dtype=np.float64), (weight @ units).astype(np.float64))


def tally_images(count: ArrayLike, weight: NDArray[np.float32]) -> Tally:
    """``tally`` of one unit an image, ``count (N,)``."""
    return tally(count, np.arange(len(np.asarray(count))), weight)


def around(value: float, drawn: ArrayLike, least: float = -np.inf, level: float = LEVEL) -> Interval:
    """The interval of a figure from its values ``(R,)`` on resamples, NaN where there is none."""
    drawn = np.asarray(drawn, np.float64)
    drawn = drawn[np.isfinite(drawn)]
    if not len(drawn):
        return Interval(float(value), float(value), float(value))
    low, high = np.quantile(drawn - drawn.mean(), [(1 - level) / 2, (1 + level) / 2])
    return Interval(float(value), float(max(least, value + low)), float(max(least, value + high)))


def mean_interval(values: ArrayLike, weight: NDArray[np.float32]) -> Interval:
    """The mean of one value an image, ``values (N,)``."""
    values = np.asarray(values, np.float64)
    return around(values.mean(), weight @ values / weight.sum(1))


def _shares(totals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rows that sum to 1; NaN where a resample has no unit."""
    whole = totals.sum(1, keepdims=True)
    return np.divide(totals, whole, out=np.full_like(totals, np.nan), where=whole > 0)


def _quantiles(drawn: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    known = drawn[~np.isnan(drawn).any(1)]
    low, high = np.quantile(known, [(1 - LEVEL) / 2, (1 + LEVEL) / 2], axis=0)
    return low, high
