"""Were modes lost, and how many generated scenes are worth anything as a sample of the real distribution?

Axis letters: N generated, L real, D features, K clusters.

References:
    [1] Arthur, Vassilvitskii, *k-means++*, 2007.
    [2] Clopper, Pearson, *The use of confidence or fiducial limits*, 1934.
    [3] Kish, *Survey sampling*, 1965: effective sample size of weights.
    [4] Sugiyama, Suzuki, Kanamori, *Density ratio estimation in machine learning*, 2012, chapter 4: by a classifier.
"""

import warnings
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2, vq
from scipy.special import expit
from scipy.stats import beta

from .two_sample import Features

MOST = 20  # clusters
IMAGES = 50  # a cluster, of those that its share is measured by: fewer could not be missed for sure
LOST = 0.25  # of the real share


class Modes(NamedTuple):
    """Clusters of the real features and who has them.

    Attributes:
        centre: ``(K, D)``.
        real, generated, prior: ``(K,)`` shares; the prior's are NaN where there is none.
        low, high: ``(K,)`` limits of generated / real, that hold for all clusters at once with 95 %.
        lost: ``(K,)`` bool: the generated share is surely under a quarter of the real one, and under the prior's.
        missing: ``(K,)`` bool: the same where the prior's is no larger: the scenes never had it.
    """

    centre: Features
    real: Features
    generated: Features
    prior: Features
    low: Features
    high: Features
    lost: NDArray[np.bool_]
    missing: NDArray[np.bool_]


def interval(found: NDArray[np.int64], number: int, level: float) -> tuple[Features, Features]:
    """Binomial limits [2] of shares ``found / number``."""
    tail = (1 - level) / 2
    low = np.where(found > 0, beta.ppf(tail, np.maximum(found, 1), number - found + 1), 0.0)
    high = np.where(found < number, beta.ppf(1 - tail, found + 1, np.maximum(number - found, 1)), 1.0)
    return low, high


def modes(generated: Features, real: Features, prior: Features | None = None, seed: int = 0) -> Modes:
    """k-means [1] on one half of the real images; the other half says how common its clusters are, so that clusters
    fitted to accidents of the first half show as rare and not as lost."""
    order = np.random.default_rng(seed).permutation(len(real))
    first, second = real[order[: len(real) // 2]], real[order[len(real) // 2 :]]
    K = max(1, min(MOST, len(second) // IMAGES))
    centre = first.mean(0, keepdims=True) if K == 1 else _centres(first, K, seed)
    counted = [np.bincount(vq(each, centre)[0], minlength=len(centre)) for each in (second, generated)]
    level = 1 - 0.05 / (2 * len(centre))
    real_low, real_high = interval(counted[0], len(second), level)
    low, high = interval(counted[1], len(generated), level)
    shares = [found / found.sum() for found in counted]
    little = high < LOST * real_low
    prior_share, had = np.full(len(centre), np.nan), np.ones(len(centre), bool)
    if prior is not None:
        found = np.bincount(vq(prior, centre)[0], minlength=len(centre))
        prior_share, had = found / len(prior), interval(found, len(prior), level)[0] > high
    with np.errstate(divide="ignore"):
        ratio = low / real_high, np.where(real_low > 0, high / np.where(real_low > 0, real_low, 1.0), np.inf)
    return Modes(centre, shares[0], shares[1], prior_share, *ratio, little & had, little & ~had)


def _centres(points: Features, K: int, seed: int) -> Features:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "One of the clusters is empty")  # its share is then near 0, and no harm
        return kmeans2(points, _spread(points, K, seed), minit="matrix")[0]


def _spread(points: Features, K: int, seed: int) -> Features:
    """Up to K different points, each drawn in proportion to its squared distance from those before it [1]."""
    rng = np.random.default_rng(seed)
    chosen = [points[rng.integers(len(points))]]
    nearest = np.full(len(points), np.inf)
    while len(chosen) < K:
        nearest = np.minimum(nearest, ((points - chosen[-1]) ** 2).sum(1))
        if nearest.sum() <= 0:
            break
        chosen.append(points[rng.choice(len(points), p=nearest / nearest.sum())])
    return np.stack(chosen)


def effective_share(generated: Features, real: Features, folds: int = 5, seed: int = 0) -> float:
    """ESS / N in 0..1: with weights p/q, how many of the generated scenes count as a sample of the real ones [3].

    The density ratio is a logistic classifier's [4] on the features and Gaussian bumps at 30 of the pooled points; its
    penalty is the one that predicts held-out images best, and every scene's weight comes from a classifier that has not
    seen it. Sets of one distribution come to about 1.
    """
    rng = np.random.default_rng(seed)
    pooled = np.concatenate([generated, real])
    is_real = np.repeat([0.0, 1.0], [len(generated), len(real)])
    x = _bumps(pooled, rng)
    fold = np.empty(len(pooled), np.int64)
    for side in (0.0, 1.0):
        rows = np.flatnonzero(is_real == side)
        fold[rng.permutation(rows)] = np.arange(len(rows)) % folds
    best, score = np.zeros(len(pooled)), np.inf
    for penalty in (1e-2, 1.0, 1e2, 1e4):
        logit = np.empty(len(pooled))
        for f in range(folds):
            out = fold == f
            logit[out] = x[out] @ _logistic(x[~out], is_real[~out], penalty)
        loss = float((np.logaddexp(0, logit) - is_real * logit).mean())
        if loss < score:
            best, score = logit, loss
    log_weight = best[is_real == 0]
    weight = np.exp(log_weight - log_weight.max())
    return float(weight.sum() ** 2 / (weight**2).sum() / len(weight))


def _bumps(points: Features, rng: np.random.Generator) -> Features:
    spread = points.std(0)
    scaled = (points - points.mean(0)) / np.where(spread > 0, spread, 1.0)
    middle = scaled[rng.permutation(len(scaled))[:30]]
    squared = ((scaled[:, None] - middle) ** 2).sum(-1)
    bumps = np.exp(-squared / (2 * max(np.median(squared), 1e-12) / 4))
    return np.concatenate([np.ones((len(points), 1)), scaled, bumps - bumps.mean(0)], 1)


def _logistic(x: Features, y: Features, penalty: float, steps: int = 30) -> Features:
    """Coefficients that minimise the log loss plus ``penalty / 2`` times their squares, the first one's excepted;
    Newton's steps, halved until they descend."""
    ridge = np.full(x.shape[1], penalty)
    ridge[0] = 1e-9

    def loss(w):
        z = x @ w
        return (np.logaddexp(0, z) - y * z).sum() + 0.5 * (ridge * w * w).sum()

    w = np.zeros(x.shape[1])
    for _ in range(steps):
        p = expit(x @ w)
        gradient = x.T @ (p - y) + ridge * w
        step = np.linalg.solve((x * (p * (1 - p))[:, None]).T @ x + np.diag(ridge + 1e-9), gradient)
        size = 1.0
        while loss(w - size * step) > loss(w) and size > 1e-6:
            size /= 2
        w = w - size * step
        if np.abs(size * step).max() < 1e-8:
            break
    return w
