"""Divergences between generated and real features, as one cost a scene so that credit can be assigned.

A divergence is called with generated ``(N, D)`` and real ``(L, D)`` features and returns ``(N,)``: descending the mean
of ``cost.detach() * log q(scene)`` brings the two distributions together. Costs carry no gradient: with one kernel on
both sides, differentiating through the estimate of log q has a minimiser other than p.

References:
    [1] Devaranjan, Kar, Fidler, *Meta-Sim2*, ECCV 2020, section 3.3: the kernel density log ratio.
    [2] Gretton et al., *A Kernel Two-Sample Test*, JMLR 2012: MMD and its witness function.
    [3] Nowozin, Cseke, Tomioka, *f-GAN*, NeurIPS 2016, table 1: divergences as functions of the density ratio.
    [4] Anscombe, *The transformation of Poisson, binomial and negative-binomial data*, Biometrika 1948.
"""

import math
from dataclasses import dataclass
from functools import partial
from typing import Protocol

import torch
from torch import Tensor

from probscene.errors import ProbsceneError

BLOCK_SIZE = 2**18  # kernels in memory at once
SELF_SHARE = 0.1  # of the density at a scene that is its own kernel's


class Divergence(Protocol):
    """``(generated (N, D), real (L, D)) -> cost (N,)``, lower where a scene should become more likely."""

    def __call__(self, generated: Tensor, real: Tensor) -> Tensor: ...


def anscombe_transform(features: Tensor) -> Tensor:
    """``2 sqrt(x + 3/8)`` less its value at 0, of the same shape: Poisson counts come out with a variance of about 1,
    whatever their mean [4]. Below 0, where networks may read, it is odd."""
    return 2 * features.sign() * ((features.abs() + 0.375).sqrt() - math.sqrt(0.375))


def gaussian_kde(points: Tensor, data: Tensor, variance: float, leave_one_out: bool = False) -> Tensor:
    """Log density of a Gaussian kernel density estimate, ``(N,)``.

    Args:
        points: ``(N, D)`` where to evaluate.
        data: ``(L, D)`` the sample.
        variance: of the isotropic kernel, H = variance * I.
        leave_one_out: ``points`` are the first N of ``data``, and each is left out of its own estimate.
    """
    points, data = _centred(points.unsqueeze(0), data.unsqueeze(0))
    normal = 0.5 * data.shape[-1] * math.log(2 * math.pi * variance)
    own = -0.5 / variance * points.square().sum(-1)
    return (_log_sums(points, data, variance, leave_one_out) + own - normal)[0]


@dataclass(frozen=True)
class KDELogRatio:
    """``log q~(F) - log p~(F)``, whose mean is the reverse KL from generated to real features [1].

    With ``marginal_variance`` the log ratios of every single feature's own density are added (not in the paper). They
    are one-dimensional estimates that stay sharp where the joint one has to be smooth: a sum of reverse KLs, zero where
    the distributions agree.

    The density of the smaller sample comes out too low where it is thin. With many more real than generated scenes, a
    list with a long tail is therefore learnt longer than the target's, unless ``equal_sizes``.
    ``docs/experiments.md`` has measurements of both.

    Args:
        variance: of the joint kernel, in squared units of what is compared; None is the paper's ``H = d I``, the
            feature dimension.
        marginal_variance: of the kernels of the single features; None leaves them out, as in the paper.
        leave_one_out: leave a scene out of its own density estimate, without which rare scenes are punished for being
            rare: the paper keeps it in.
        equal_sizes: estimate both densities from as many scenes. The larger sample is split into parts about as large
            as the smaller one, and the log densities of the parts are averaged, which are all too low by as much.
        anscombe: compare counts after Anscombe's transformation (not in the paper). A network is farther off the more
            there is, so that one kernel in counts is too wide for what is rare or too narrow for what there is much of.
            Near a count x a variance v is then about one of ``v x`` in counts.

    Raises:
        ProbsceneError: too few scenes, or features that are not finite.
    """

    variance: float | None = 1.0
    marginal_variance: float | None = 0.1
    leave_one_out: bool = True
    equal_sizes: bool = False
    anscombe: bool = False

    def __call__(self, generated: Tensor, real: Tensor) -> Tensor:
        generated, real = _transformed(generated, real, self.anscombe)
        variance = float(generated.shape[1]) if self.variance is None else self.variance
        cost = self.cost_of_log_ratio(self._log_ratios(generated.unsqueeze(0), real.unsqueeze(0), variance))[0]
        if self.marginal_variance is not None and generated.shape[1] > 1:
            one, other = (features.T.contiguous().unsqueeze(-1) for features in (generated, real))  # (D, N or L, 1)
            cost = cost + self.cost_of_log_ratio(self._log_ratios(one, other, self.marginal_variance)).sum(0)
        return cost

    def cost_of_log_ratio(self, log_ratio: Tensor) -> Tensor:
        """The cost where the log ratio is ``log_ratio``; of the same shape."""
        return log_ratio

    def _log_ratios(self, generated: Tensor, real: Tensor, variance: float) -> Tensor:
        generated, real = _centred(generated, real)
        N, L = generated.shape[1], real.shape[1]
        parts = (max(1, min(N // 2, round(N / L))), max(1, round(L / N))) if self.equal_sizes else (1, 1)
        log_q = _own_log_sums(generated, variance, self.leave_one_out, parts[0])
        log_p = sum(_log_sums(generated, real[:, k :: parts[1]], variance) for k in range(parts[1])) / parts[1]
        return log_q - log_p


@dataclass(frozen=True)
class JensenShannon(KDELogRatio):
    """``log q~ / ((p~ + q~) / 2)`` from the densities of ``KDELogRatio``, joint and marginal.

    It is the derivative by q of twice the Jensen-Shannon divergence [3], where the log ratio is that of the reverse KL;
    it never exceeds log 2, so no scene is punished without bound for being where no real one is (not in [1]).
    """

    def cost_of_log_ratio(self, log_ratio: Tensor) -> Tensor:
        """``log 2 - log(1 + p~/q~)``."""
        return math.log(2) - torch.nn.functional.softplus(-log_ratio)


@dataclass(frozen=True)
class MMD:
    """Squared maximum mean discrepancy with a Gaussian kernel [2].

    Args:
        variance: of the kernel; None is the feature dimension.
        shared: every scene pays the one discrepancy of the batch (the baseline of [1], which cannot assign credit);
            otherwise each pays its own witness value ``2 (E k(x, G) - E k(x, R))``, the same gradient in expectation.
        anscombe: as of ``KDELogRatio``.
    """

    variance: float | None = 1.0
    shared: bool = True
    anscombe: bool = False

    def __call__(self, generated: Tensor, real: Tensor) -> Tensor:
        generated, real = _transformed(generated, real, self.anscombe)
        variance = float(generated.shape[1]) if self.variance is None else self.variance
        N, L = len(generated), len(real)
        within = torch.exp(-0.5 / variance * _squared_distances(generated, generated)).fill_diagonal_(0.0)
        across = torch.exp(-0.5 / variance * _squared_distances(generated, real))
        witness = 2 * (within.sum(1) / (N - 1) - across.mean(1))
        if not self.shared:
            return witness
        # A real sample may be far larger than the generated one; its own term is a constant that every scene shares.
        some = real[: min(L, 1000)]
        real_term = torch.exp(-0.5 / variance * _squared_distances(some, some)).fill_diagonal_(0.0)
        discrepancy = within.sum() / (N * (N - 1)) - 2 * across.mean()
        return (discrepancy + real_term.sum() / max(1, len(some) * (len(some) - 1))).expand(N)


@dataclass(frozen=True)
class Blockwise:
    """The sum of divergences, each of its own block of features.

    Where one block's real features lie far from all generated ones, a joint density at a scene is that of the one or
    two real images that are nearest in that block, and the others' features say nothing any more.

    Args:
        sizes: how many features each block has, in their order.
        divergences: of each block; None where it is not compared.
    """

    sizes: tuple[int, ...]
    divergences: tuple[Divergence | None, ...]

    def __call__(self, generated: Tensor, real: Tensor) -> Tensor:
        _check_features(generated, real)
        blocks = zip(self.divergences, generated.split(self.sizes, 1), real.split(self.sizes, 1), strict=True)
        costs = [divergence(*block) for divergence, *block in blocks if divergence is not None]
        return sum(costs, generated.new_zeros(len(generated)))


def _centred(points: Tensor, data: Tensor) -> tuple[Tensor, Tensor]:
    """Features ``(B, N, d)`` and ``(B, L, d)`` less the mean of ``data``: far from the origin they lose precision."""
    centre = data.mean(1, keepdim=True)
    return points - centre, data - centre


@torch.no_grad()
def _log_sums(points: Tensor, data: Tensor, variance: float, leave_one_out: bool = False) -> Tensor:
    """Logarithms of B mean kernels at once, ``(B, N)``, but for the factor that depends on the point alone:
    ``log mean_j exp((x y_j - y_j^2 / 2) / variance)`` for ``points`` x ``(B, N, d)`` and ``data`` y ``(B, L, d)``.

    Log-softmax is the fastest pass that sums exponentials, and the sum is what it took from any one of them: from that
    of the datum nearest the origin, the least rounded. Blocks are written over one another, as fresh memory is slow.
    """
    (B, N, d), L = points.shape, data.shape[1]
    bias, kernels = -0.5 / variance * torch.linalg.vector_norm(data, dim=-1).square(), data.mT
    nearest = bias.topk(min(2, L), 1).indices
    pivot = nearest[:, :1].expand(B, N)
    if leave_one_out:
        pivot = pivot.where(pivot != torch.arange(N, device=pivot.device), nearest[:, 1:])
    fill = partial(torch.addcmul, value=1 / variance) if d == 1 else partial(torch.baddbmm, alpha=1 / variance)
    rows, samples = min(N, max(1, BLOCK_SIZE // L)), min(B, max(1, BLOCK_SIZE // (N * L)))
    memory = points.new_empty(samples * rows * L)
    found = torch.empty_like(points[..., 0])
    for b in range(0, B, samples):
        for i in range(0, N, rows):
            block = slice(b, b + samples), slice(i, i + rows)
            some = points[block]
            x = memory[: some.shape[0] * some.shape[1] * L].view(*some.shape[:2], L)
            fill(bias[block[0]].unsqueeze(1), some, kernels[block[0]], out=x)
            if leave_one_out:
                x.diagonal(i, 1, 2).fill_(-math.inf)
            at = pivot[block].unsqueeze(-1)
            log_kernel = x.gather(-1, at)
            log_share = torch.log_softmax(x, -1, out=x).gather(-1, at)
            found[block] = (log_kernel - log_share).squeeze(-1)
    return found.sub_(math.log(L - 1 if leave_one_out else L))


def _own_log_sums(points: Tensor, variance: float, leave_one_out: bool, parts: int) -> Tensor:
    """``_log_sums`` of points ``(B, N, d)`` at themselves: the mean of those of ``parts`` that they are split into."""
    found = torch.zeros_like(points[..., 0])
    for k in range(parts):
        data = points[:, k::parts]
        for j in range(parts):
            found[:, j::parts] += _log_sums(points[:, j::parts], data, variance, leave_one_out and j == k)
    return found / parts


def _squared_distances(a: Tensor, b: Tensor) -> Tensor:
    """``(N, L)``; centred first, so that features far from the origin lose no precision."""
    centre = b.mean(0)
    a, b = a - centre, b - centre
    return (a.square().sum(1, keepdim=True) + b.square().sum(1) - 2 * a @ b.T).clamp_(min=0.0)


def _transformed(generated: Tensor, real: Tensor, anscombe: bool) -> tuple[Tensor, Tensor]:
    """Features, checked, and transformed where they are to be transformed."""
    _check_features(generated, real)
    return (anscombe_transform(generated), anscombe_transform(real)) if anscombe else (generated, real)


def _check_features(generated: Tensor, real: Tensor) -> None:
    if generated.ndim != 2 or real.ndim != 2 or generated.shape[1] != real.shape[1]:
        raise ProbsceneError(
            f"expected generated (N, D) and real (L, D) features, got {tuple(generated.shape)} and {tuple(real.shape)}."
        )
    if len(generated) < 2 or len(real) < 1:
        raise ProbsceneError(f"expected at least 2 generated and 1 real scene, got {len(generated)} and {len(real)}.")
    if not torch.isfinite(generated.sum() + real.sum()):  # NaN and infinity stay in a sum
        raise ProbsceneError("expected finite features, got NaN or infinity; lower the learning rate.")


def self_share(points: Tensor) -> float:
    """The mean share that a point's own kernel, Gaussian of variance 1, has in the density estimated at it from all.

    Args:
        points: ``(N, d)``.
    """
    return float((1 / torch.exp(-0.5 * torch.cdist(points, points).square()).sum(1)).mean())


def bandwidth(points: Tensor) -> float:
    """The least standard deviation of a Gaussian kernel at which ``points (N, d)`` have a self share of ``SELF_SHARE``,
    or of two points' worth where there are too few for that."""
    share, low, high = max(SELF_SHARE, 2 / len(points)), -20.0, 20.0  # powers of two
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if self_share(points / 2**middle) > share else (low, middle)
    return 2**high
