"""FID and KID of features that are computed already, through torchmetrics, with bootstrap intervals.

A distance carries the name of the network whose features it was taken in, and the number of images, on which FID
depends. Axis letters: L real images, N generated ones, D features, R resamples.

References:
    [1] Heusel et al., *GANs Trained by a Two Time-Scale Update Rule*, 2017: FID.
    [2] Binkowski et al., *Demystifying MMD GANs*, 2018: KID, the unbiased MMD^2 under the kernel (x.y / D + 1)^3.
    [3] Chong, Forsyth, *Effectively Unbiased FID and Inception Score*, 2020: how far FID is off for few images.
"""

import warnings
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torchmetrics.image.fid import FrechetInceptionDistance
from torchmetrics.image.kid import KernelInceptionDistance

from probscene.errors import ProbsceneError

from .count_metrics import bootstrap_interval, resamples

KID_SUBSET = 1000  # images, in its authors' code


class ImageDistance(NamedTuple):
    """A distance between real and generated images.

    Attributes:
        name: ``"FID"`` or ``"KID"``.
        features: whose features it was taken in.
        value: KID may fall below 0, as an unbiased estimate of 0 does.
        low, high: the 95 % bootstrap interval.
        images: number of real ones.
        generated: number of generated ones, or of what is on the other side.
        min_images: on each side, that the distance needs: for FID covariances of full rank, D + 1; for KID one subset.
        extrapolated_from: images a side that it was measured with, where those were fewer than ``images``.
    """

    name: str
    features: str
    value: float
    low: float
    high: float
    images: int
    generated: int
    min_images: int
    extrapolated_from: int | None = None


def fid(real: Tensor, generated: Tensor, features: str, size: int = 50, seed: int = 0) -> ImageDistance:
    """Fréchet distance between Gaussians with the features' means and covariances [1].

    It is biased upward, the more so the fewer images there are: only figures of as many images may be compared [3].

    Args:
        real: ``(L, D)``.
        generated: ``(N, D)``.
        features: the network's name.
        size: R. A resample costs about the cube of min(L, D) or min(N, D).

    Raises:
        ProbsceneError: fewer than two images on a side, features of different length, or not finite.
    """
    real, generated = _checked(real, generated)
    (L, D), N = real.shape, len(generated)
    metric = FrechetInceptionDistance(feature=_Identity(D))
    metric.update(real, real=True)
    metric.update(generated, real=False)
    weight = [torch.from_numpy(resamples(len(x), size, seed + i)).double() for i, x in enumerate((real, generated))]
    drawn = [frechet(real[a > 0], generated[b > 0], a[a > 0], b[b > 0]).item() for a, b in zip(*weight, strict=True)]
    return ImageDistance("FID", features, *bootstrap_interval(metric.compute().item(), drawn, 0.0), L, N, D + 1)


def kid(
    real: Tensor, generated: Tensor, features: str, subset: int = KID_SUBSET, size: int = 200, seed: int = 0
) -> ImageDistance:
    """Unbiased squared MMD under the cubic kernel [2], the mean over ten subsets where there are more images.

    Args:
        subset: images of each side in a subset; all where there are fewer on a side.
        size: R.

    The other arguments and the errors are those of ``fid``.
    """
    real, generated = _checked(real, generated)
    taken = min(subset, len(real), len(generated))
    with warnings.catch_warnings(), torch.random.fork_rng(devices=[]):
        warnings.filterwarnings("ignore", "Metric `Kernel Inception Distance` will save", UserWarning)
        torch.manual_seed(seed)
        subsets = 1 if taken == len(real) == len(generated) else 10
        metric = KernelInceptionDistance(feature=_Identity(real.shape[1]), subsets=subsets, subset_size=taken)
        metric.update(real, real=True)
        metric.update(generated, real=False)
        value = metric.compute()[0].item()
    interval = bootstrap_interval(value, _kid_resampled(real, generated, size, seed))
    return ImageDistance("KID", features, *interval, len(real), len(generated), subset)


def frechet(x: Tensor, y: Tensor, x_weight: Tensor, y_weight: Tensor) -> Tensor:
    """Fréchet distance between Gaussians fitted to weighted points.

    The trace of the root of the covariances' product is the nuclear norm of ``A B^T``, where ``A^T A``, ``B^T B`` are
    the covariances: a matrix of min(points, D) on a side, without the rounding of a square root of nearly 0.

    Args:
        x, y: ``(L, D)`` and ``(N, D)``.
        x_weight, y_weight: ``(L,)`` and ``(N,)`` multiplicities of the points.
    """
    means, roots = [], []
    for points, weight in ((x, x_weight), (y, y_weight)):
        means.append(weight @ points / weight.sum())
        root = (points - means[-1]) * (weight / (weight.sum() - 1)).sqrt().unsqueeze(1)
        roots.append(root if len(root) <= root.shape[1] else torch.linalg.qr(root, mode="r").R)
    a, b = roots
    return (
        (means[0] - means[1]).square().sum()
        + a.square().sum()
        + b.square().sum()
        - 2 * torch.linalg.svdvals(a @ b.T).sum()
    )


def _kid_resampled(real: Tensor, generated: Tensor, size: int, seed: int) -> np.ndarray:
    """``(R,)`` KID of resampled images; the copies of an image are no pair."""
    a, b = (torch.from_numpy(resamples(len(x), size, seed + i)).double() for i, x in enumerate((real, generated)))
    cross = ((a @ _kernel(real, generated)) * b).sum(1) / (a.sum(1) * b.sum(1))
    return (_within(real, a) + _within(generated, b) - 2 * cross).numpy()


def _within(x: Tensor, weight: Tensor) -> Tensor:
    kernel = _kernel(x, x).fill_diagonal_(0)
    total = weight.sum(1)
    return ((weight @ kernel) * weight).sum(1) / (total.square() - weight.square().sum(1)).clamp(min=1)


def _kernel(x: Tensor, y: Tensor) -> Tensor:
    return (x @ y.T / x.shape[1] + 1) ** 3


class _Identity(nn.Module):
    """Torchmetrics expects a network; these features come from one already."""

    def __init__(self, num_features: int):
        super().__init__()
        self.num_features = num_features

    def forward(self, features: Tensor) -> Tensor:
        return features


def _checked(real: Tensor, generated: Tensor) -> tuple[Tensor, Tensor]:
    ok = real.ndim == generated.ndim == 2 and real.shape[1] == generated.shape[1] >= 1
    if not ok or min(len(real), len(generated)) < 2:
        raise ProbsceneError(
            f"expected features of at least 2 real and 2 generated images, as many of each, got "
            f"{tuple(real.shape)} and {tuple(generated.shape)}."
        )
    if not (torch.isfinite(real).all() and torch.isfinite(generated).all()):
        raise ProbsceneError("expected finite features, got NaN or infinity; check the feature network.")
    return real.double(), generated.double()
