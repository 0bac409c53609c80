"""How far apart two distributions of counts are, and how sure one can be of a histogram.

Everything here is a pure function of numpy arrays. Axis letters: N images, C classes, K bins.

References:
    [1] Efron, *Bootstrap methods: another look at the jackknife*, 1979: percentile intervals.
    [2] Vallender, *Calculation of the Wasserstein distance between probability distributions on the line*, 1974.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from probscene.errors import ProbsceneError

Shares = NDArray[np.float64]


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


def ranges(samples: Iterable[ArrayLike], most: int = 15, tail: float = 0.01) -> list[tuple[int, int]]:
    """The first and the last count of each row of a histogram of several samples that a person reads, from 0 on.

    Every count is a row of its own where that makes no more rows than ``most``. Else each tail that holds at most the
    share ``tail`` of every sample is one row, and the counts between them are in rows of one width.

    Args:
        samples: one or more of ``(N,)`` counts.
        most: rows, 3 or more.

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
    values: ArrayLike, bins: int | None = None, level: float = 0.95, resamples: int = 1000, seed: int = 0
) -> Histogram:
    """``histogram`` with the percentile bootstrap of every bin [1].

    Args:
        level: probability that an interval covers.
        resamples: how many bootstrap samples.
    """
    share = histogram(values, bins)
    number = len(np.asarray(values))
    # Drawing N of the N values anew is drawing the histogram's bins N times.
    drawn = np.random.default_rng(seed).multinomial(number, share, resamples) / number
    return Histogram(share, *_percentiles(drawn, level))


def pooled_shares_interval(counts: ArrayLike, level: float = 0.95, resamples: int = 300, seed: int = 0) -> Histogram:
    """``pooled_shares`` with the percentile bootstrap over images, not objects: those of one image belong together."""
    counts = _counts(counts, 2)
    rng = np.random.default_rng(seed)
    drawn = np.empty((resamples, counts.shape[1]))
    for each in drawn:
        weight = np.bincount(rng.integers(len(counts), size=len(counts)), minlength=len(counts))
        total = weight @ counts
        each[:] = total / max(1, total.sum())
    return Histogram(pooled_shares(counts), *_percentiles(drawn, level))


def _percentiles(drawn: Shares, level: float) -> tuple[Shares, Shares]:
    if not 0 < level < 1:
        raise ProbsceneError(f"expected a level between 0 and 1, got {level}.")
    low, high = np.quantile(drawn, [(1 - level) / 2, (1 + level) / 2], axis=0)
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
