"""Errors of the counts that a run reads in each labelled image, as papers on counting report them: the mean absolute
error, and Pearson's correlation; and what labels and readings say of the mean count of all images. Axis letters: L
labelled images, U others, C classes, R resamples.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from probscene.inference.statistics.count_metrics import Interval, bootstrap_interval, resamples
from probscene.inference.statistics.prediction_powered import prediction_powered_mean

from .structure_counts import Counts


class CountErrors(NamedTuple):
    """Of one class in L labelled images.

    Attributes:
        images: L.
        mean_absolute: error, objects an image.
        correlation: -1 to 1; None where the labels or the readings are the same in all images.
        mean: objects an image in labelled and other images together, with a 90 % interval that holds if the labelled
            ones were drawn at random, see ``prediction_powered_mean``; None where they are too few.
    """

    images: int
    mean_absolute: Interval
    correlation: Interval | None
    mean: Interval | None


def count_errors(
    read: NDArray[np.float64], labelled: Counts, others: NDArray[np.float64] | None = None, seed: int = 0
) -> CountErrors:
    """The errors of one class's counts, with 95 % bootstrap intervals over images.

    Args:
        read: ``(L,)``, not rounded.
        labelled: ``(L,)``.
        others: ``(U,)`` read in images without labels.
    """
    one, other = np.asarray(read, np.float64), labelled.astype(np.float64)
    weight = resamples(len(one), seed=seed).astype(np.float64) / len(one)
    every = np.full((1, len(one)), 1 / len(one))
    error = np.abs(one - other)
    whole, drawn = (_correlation(one, other, each) for each in (every, weight))
    correlation = None if np.isnan(whole[0]) else bootstrap_interval(float(whole[0]), drawn, minimum=-1.0)
    if correlation is not None:
        correlation = Interval(*(min(end, 1.0) for end in correlation))
    absolute = bootstrap_interval(float(error.mean()), weight @ error, minimum=0.0)
    mean = prediction_powered_mean(other, one, [] if others is None else others)
    return CountErrors(len(one), absolute, correlation, mean)


def _correlation(one: NDArray[np.float64], other: NDArray[np.float64], weight: NDArray[np.float64]):
    """``(R,)`` correlations of images that weigh ``(R, L)``, each row 1 in all; NaN where a side does not vary."""
    x, y = (side - (weight @ side)[:, None] for side in (one, other))
    cross, *squares = ((weight * a * b).sum(1) for a, b in ((x, y), (x, x), (y, y)))
    varies = (squares[0] > 1e-12) & (squares[1] > 1e-12)
    return np.where(varies, cross / np.sqrt(np.where(varies, squares[0] * squares[1], 1.0)), np.nan)
