"""Histograms of counts, their total variation and Wasserstein-1, and bootstrap intervals of all of them.

A ``Tally`` is a histogram over units of which an image has several, such as roads by their number of cars. The
bootstrap resamples images and not units: the roads of one image belong together [3]. Axis letters: N images, C
classes, P units, K bins, R resamples.

References:
    [1] Efron, *Bootstrap methods: another look at the jackknife*, 1979: percentile intervals.
    [2] Vallender, *Calculation of the Wasserstein distance between probability distributions on the line*, 1974.
    [3] Field, Welsh, *Bootstrapping clustered data*, 2007: whole clusters are drawn.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from probscene.errors import ProbsceneError

Shares = NDArray[np.float64]
LEVEL = 0.95


class Histogram(NamedTuple):
    """Shares ``(K,)`` that sum to 1, or to 0 where there was nothing to share, with their bootstrap interval."""

    share: Shares
    low: Shares
    high: Shares


def histogram(values: ArrayLike, bins: int | None = None) -> Shares:
    """The share of images that show 0, 1, 2, ... objects, ``(K,)``.

    Args:
        values: ``(N,)`` counts, integers of 0 or more.
        bins: K; one more than the largest count where None.

    Raises:
        ProbsceneError: no values, values that are no counts, or a count that has no bin.
    """
    counts = _counts(values, 1)
    found = np.bincount(counts, minlength=bins or 0)
    if bins is not None and len(found) > bins:
        raise ProbsceneError(f"expected counts below {bins}, got {len(found) - 1}; give more bins.")
    return found / len(counts)


def bin_ranges(samples: Iterable[ArrayLike], most: int = 15, tail: float = 0.01) -> list[tuple[int, int]]:
    """The first and the last count of each bin of a common histogram of several samples, from 0 on.

    Every count is a bin of its own where that makes no more bins than ``most``. Else each tail that holds at most the
    share ``tail`` of every sample is one bin, and the counts between them are in bins of equal width.

    Args:
        samples: one or more of ``(N,)`` counts.
        most: bins, 3 or more.

    Raises:
        ProbsceneError: a sample without values, or values that are no counts.
    """
    found = [_counts(values, 1) for values in samples]
    largest = max(int(counts.max()) for counts in found)
    if largest < most:
        return [(k, k) for k in range(largest + 1)]
    low = min(int(np.quantile(counts, tail, method="lower")) for counts in found)
    high = max(int(np.quantile(counts, 1 - tail, method="higher")) for counts in found)
    below, above = [(0, low - 1)] if low else [], [(high + 1, largest)] if high < largest else []
    width = -(-(high + 1 - low) // (most - len(below) - len(above)))
    return [*below, *((k, min(k + width - 1, high)) for k in range(low, high + 1, width)), *above]


def pooled_shares(counts: ArrayLike) -> Shares:
    """The share of each class among all objects of all images, ``(C,)``; zeros if there is no object.

    Args:
        counts: ``(N, C)`` objects of each class in each image.
    """
    total = _counts(counts, 2).sum(0)
    return total / max(1, total.sum())


def total_variation(p: ArrayLike, q: ArrayLike) -> float:
    """``sum |p - q| / 2``, in 0..1: the largest difference in probability that any event has.

    Args:
        p, q: shares from bin 0 on; the shorter one goes on with zeros.

    Raises:
        ProbsceneError: shares that are negative, or do not sum to 1.
    """
    p, q = _aligned(p, q)
    return float(np.abs(p - q).sum() / 2)


def wasserstein(p: ArrayLike, q: ArrayLike) -> float:
    """Wasserstein-1 between two distributions over 0, 1, 2, ...: how many objects an image has to gain or lose, on
    average, to turn one into the other [2]. Arguments and errors as in ``total_variation``."""
    p, q = _aligned(p, q)
    return float(np.abs(np.cumsum(p - q)).sum())


def histogram_interval(
    values: ArrayLike, bins: int | None = None, level: float = LEVEL, size: int = 1000, seed: int = 0
) -> Histogram:
    """``histogram`` with the percentile bootstrap of every bin [1].

    Args:
        level: probability that an interval covers.
        size: R.
    """
    share = histogram(values, bins)
    number = len(np.asarray(values))
    # N draws from the N values are N draws from the histogram's bins.
    drawn = np.random.default_rng(seed).multinomial(number, share, size) / number
    return Histogram(share, *_percentiles(drawn, level))


def pooled_shares_interval(counts: ArrayLike, level: float = LEVEL, size: int = 300, seed: int = 0) -> Histogram:
    """``pooled_shares`` with the percentile bootstrap over images, not objects: those of one image belong together."""
    counts = _counts(counts, 2)
    rng = np.random.default_rng(seed)
    drawn = np.empty((size, counts.shape[1]))
    for shares in drawn:
        weight = np.bincount(rng.integers(len(counts), size=len(counts)), minlength=len(counts))
        total = weight @ counts
        shares[:] = total / max(1, total.sum())
    return Histogram(pooled_shares(counts), *_percentiles(drawn, level))


class Interval(NamedTuple):
    """A statistic and its bootstrap interval, centred on the statistic.

    A distance between samples is biased upward, the more so the fewer the images are; that bias is in the value and not
    in the interval.
    """

    value: float
    low: float
    high: float


class Distance(NamedTuple):
    """Of two distributions of counts: total variation, 0 to 1, and Wasserstein-1 in objects."""

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
        return bootstrap_interval(self.total @ bins / self.total.sum(), _normalised(self.resampled) @ bins)

    def histogram(self) -> Histogram:
        """Shares of the units by count, ``(K,)``, with the interval of each; zeros where there is no unit."""
        low, high = np.zeros((2, len(self.total))) if self.empty else _percentiles(_normalised(self.resampled), LEVEL)
        return Histogram(self.total / max(1.0, self.total.sum()), low, high)

    def distance(self, other: "Tally") -> Distance | None:
        """The distance of two tallies; None where one is empty."""
        if self.empty or other.empty:
            return None
        R = min(len(self.resampled), len(other.resampled))
        size = max(len(self.total), len(other.total))
        p, q = (np.pad(x.total / x.total.sum(), (0, size - len(x.total))) for x in (self, other))
        drawn = [np.pad(_normalised(x.resampled[:R]), ((0, 0), (0, size - len(x.total)))) for x in (self, other)]
        change = drawn[0] - drawn[1]
        return Distance(
            bootstrap_interval(total_variation(p, q), np.abs(change).sum(1) / 2, minimum=0.0),
            bootstrap_interval(wasserstein(p, q), np.abs(change.cumsum(1)).sum(1), minimum=0.0),
        )


def resamples(number: int, size: int = 200, seed: int = 0) -> NDArray[np.float32]:
    """Multiplicities ``(R, N)`` of each of ``number`` images in each of ``size`` resamples."""
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


def bootstrap_interval(value: float, drawn: ArrayLike, minimum: float = -np.inf, level: float = LEVEL) -> Interval:
    """The interval of a statistic from its values ``(R,)`` on resamples, NaN where there is none."""
    drawn = np.asarray(drawn, np.float64)
    drawn = drawn[np.isfinite(drawn)]
    if not len(drawn):
        return Interval(float(value), float(value), float(value))
    low, high = np.quantile(drawn - drawn.mean(), [(1 - level) / 2, (1 + level) / 2])
    return Interval(float(value), float(max(minimum, value + low)), float(max(minimum, value + high)))


def mean_interval(values: ArrayLike, weight: NDArray[np.float32]) -> Interval:
    """The mean of one value an image, ``values (N,)``."""
    values = np.asarray(values, np.float64)
    return bootstrap_interval(values.mean(), weight @ values / weight.sum(1))


def _normalised(totals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rows that sum to 1; NaN where a resample has no unit."""
    whole = totals.sum(1, keepdims=True)
    return np.divide(totals, whole, out=np.full_like(totals, np.nan), where=whole > 0)


def _percentiles(drawn: Shares, level: float) -> tuple[Shares, Shares]:
    if not 0 < level < 1:
        raise ProbsceneError(f"expected a level between 0 and 1, got {level}.")
    known = drawn[~np.isnan(drawn).any(1)]
    low, high = np.quantile(known, [(1 - level) / 2, (1 + level) / 2], axis=0)
    return low, high


def _counts(values: ArrayLike, axes: int) -> NDArray[np.int64]:
    counts = np.asarray(values)
    whole = np.issubdtype(counts.dtype, np.integer) and counts.min(initial=0) >= 0
    if counts.ndim != axes or not len(counts) or not whole:
        raise ProbsceneError(
            f"expected counts of 0 or more in {axes} axes with at least one image, got {counts.dtype} "
            f"{counts.shape}{f' from {counts.min()}' if counts.size else ''}."
        )
    return counts.astype(np.int64)


def _aligned(p: ArrayLike, q: ArrayLike) -> tuple[Shares, Shares]:
    size = max(np.size(p), np.size(q))
    whole = []
    for shares in (np.asarray(p, np.float64), np.asarray(q, np.float64)):
        if shares.ndim != 1 or (shares < 0).any() or not np.isclose(shares.sum(), 1.0, atol=1e-6):
            raise ProbsceneError(
                f"expected shares of 0 or more that sum to 1, got {shares.shape} with the sum {shares.sum():.6g}."
            )
        whole.append(np.pad(shares, (0, size - len(shares))))
    return whole[0], whole[1]
