"""Mode collapse, and the effective sample size of generated scenes as a sample of the real distribution.

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

from .energy import Features

MAX_CLUSTERS = 20
IMAGES_PER_CLUSTER = 50  # that its share is measured by: of fewer none could be significantly under-represented
COLLAPSE_RATIO = 0.25  # of the generated share to the real one


class Modes(NamedTuple):
    """Clusters of the real features, and their shares in each sample.

    Attributes:
        centre: ``(K, D)``.
        real, generated, prior: ``(K,)`` shares; the prior's are NaN where there is none.
        low, high: ``(K,)`` limits of generated / real, that hold for all clusters at once with 95 %.
        collapsed: ``(K,)`` bool: the generated share is significantly less than ``COLLAPSE_RATIO`` of the real one, and
            less than the prior's.
        missing: ``(K,)`` bool: the same where the prior's is no larger: the scenes never had it.
    """

    centre: Features
    real: Features
    generated: Features
    prior: Features
    low: Features
    high: Features
    collapsed: NDArray[np.bool_]
    missing: NDArray[np.bool_]


def binomial_interval(count: NDArray[np.int64], number: int, level: float) -> tuple[Features, Features]:
    """Clopper-Pearson limits [2] of shares ``count / number``."""
    tail = (1 - level) / 2
    low = np.where(count > 0, beta.ppf(tail, np.maximum(count, 1), number - count + 1), 0.0)
    high = np.where(count < number, beta.ppf(1 - tail, count + 1, np.maximum(number - count, 1)), 1.0)
    return low, high


def modes(generated: Features, real: Features, prior: Features | None = None, seed: int = 0) -> Modes:
    """k-means [1] on one half of the real images; the other half says how common its clusters are, so that clusters
    fitted to accidents of the first half show as rare and not as lost."""
    order = np.random.default_rng(seed).permutation(len(real))
    first, second = real[order[: len(real) // 2]], real[order[len(real) // 2 :]]
    K = max(1, min(MAX_CLUSTERS, len(second) // IMAGES_PER_CLUSTER))
    centre = first.mean(0, keepdims=True) if K == 1 else _centres(first, K, seed)
    counts = [np.bincount(vq(rows, centre)[0], minlength=len(centre)) for rows in (second, generated)]
    level = 1 - 0.05 / (2 * len(centre))
    real_low, real_high = binomial_interval(counts[0], len(second), level)
    low, high = binomial_interval(counts[1], len(generated), level)
    shares = [count / count.sum() for count in counts]
    rare = high < COLLAPSE_RATIO * real_low
    prior_share, in_prior = np.full(len(centre), np.nan), np.ones(len(centre), bool)
    if prior is not None:
        count = np.bincount(vq(prior, centre)[0], minlength=len(centre))
        prior_share, in_prior = count / len(prior), binomial_interval(count, len(prior), level)[0] > high
    with np.errstate(divide="ignore"):
        ratio = low / real_high, np.where(real_low > 0, high / np.where(real_low > 0, real_low, 1.0), np.inf)
    return Modes(centre, shares[0], shares[1], prior_share, *ratio, rare & in_prior, rare & ~in_prior)


def _centres(points: Features, K: int, seed: int) -> Features:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "One of the clusters is empty")  # its share is then near 0, and no harm
        return kmeans2(points, _kmeans_plus_plus(points, K, seed), minit="matrix")[0]


def _kmeans_plus_plus(points: Features, K: int, seed: int) -> Features:
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


def ess_fraction(generated: Features, real: Features, folds: int = 5, seed: int = 0) -> float:
    """ESS / N of the generated scenes, 0 to 1, with the density ratio p / q of real and generated as weights [3].

    The density ratio is that of a logistic classifier [4] on the features and on Gaussian kernels at 30 of the pooled
    points; its penalty is chosen by cross-validation, and every weight comes from a classifier that was trained without
    that scene. Sets of one distribution come to about 1.
    """
    rng = np.random.default_rng(seed)
    pooled = np.concatenate([generated, real])
    is_real = np.repeat([0.0, 1.0], [len(generated), len(real)])
    x = _kernel_features(pooled, rng)
    fold = np.empty(len(pooled), np.int64)
    for side in (0.0, 1.0):
        rows = np.flatnonzero(is_real == side)
        fold[rng.permutation(rows)] = np.arange(len(rows)) % folds
    best, score = np.zeros(len(pooled)), np.inf
    for penalty in (1e-2, 1.0, 1e2, 1e4):
        logit = np.empty(len(pooled))
        for f in range(folds):
            held_out = fold == f
            logit[held_out] = x[held_out] @ _logistic(x[~held_out], is_real[~held_out], penalty)
        loss = float((np.logaddexp(0, logit) - is_real * logit).mean())
        if loss < score:
            best, score = logit, loss
    log_weight = best[is_real == 0]
    weight = np.exp(log_weight - log_weight.max())
    return float(weight.sum() ** 2 / (weight**2).sum() / len(weight))


def _kernel_features(points: Features, rng: np.random.Generator) -> Features:
    spread = points.std(0)
    scaled = (points - points.mean(0)) / np.where(spread > 0, spread, 1.0)
    centres = scaled[rng.permutation(len(scaled))[:30]]
    squared = ((scaled[:, None] - centres) ** 2).sum(-1)
    kernels = np.exp(-squared / (2 * max(np.median(squared), 1e-12) / 4))
    return np.concatenate([np.ones((len(points), 1)), scaled, kernels - kernels.mean(0)], 1)


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
