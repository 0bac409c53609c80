"""The mean count of all images, where counts are known of a few images and read, with errors, in all.

Prediction-powered inference [1] takes the mean of the readings and mends it by the mean error in the labelled images.
The interval holds however wrong the readings are; good readings make it narrower. It presumes that the labelled images
were drawn at random from all. Where these show hardly any object, Student's t says nothing, and the interval is that of
a Poisson distribution by the labels alone [2]. Axis letters: K labelled images, U others.

References:
    [1] Angelopoulos, Duchi, Zrnic, *PPI++: efficient prediction-powered inference*, 2023; with the best lambda.
    [2] Garwood, *Fiducial limits for the Poisson distribution*, Biometrika 1936.
"""

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import chi2
from scipy.stats import t as student

from .count_metrics import Interval

LEVEL = 0.9
MIN_LABELLED = 4
MIN_OBJECTS = 5  # in the labelled images, for Student's t


def prediction_powered_mean(labelled: ArrayLike, read: ArrayLike, others: ArrayLike) -> Interval | None:
    """With a 90 % interval; None where fewer than ``MIN_LABELLED`` images are labelled.

    Args:
        labelled: ``(K,)`` the true counts.
        read: ``(K,)`` what is read in the same images.
        others: ``(U,)`` what is read in the images without labels.
    """
    y, f, g = (np.asarray(x, np.float64) for x in (labelled, read, others))
    K, U = len(y), len(g)
    if K < MIN_LABELLED:
        return None
    if y.sum() < MIN_OBJECTS:
        low, high = ((1 - LEVEL) / 2, 2 * y.sum()), ((1 + LEVEL) / 2, 2 * y.sum() + 2)
        return Interval(float(y.mean()), *(float(chi2.ppf(*end)) / 2 / K if end[1] else 0.0 for end in (low, high)))
    share, variance, freedom = 0.0, 0.0, K - 1
    if U > 1 and (spread := float(f.var(ddof=1))) > 0:
        share = float(np.clip(np.cov(y, f)[0, 1] / spread / (1 + K / U), 0, 1))
        variance, freedom = share**2 * float(g.var(ddof=1)) / U, K - 2
    mean = float(y.mean() + (share * (g.mean() - f.mean()) if share else 0.0))
    half = student.ppf((1 + LEVEL) / 2, freedom) * (float((y - share * f).var(ddof=1)) / K + variance) ** 0.5
    return Interval(mean, max(mean - half, 0.0), mean + half)
