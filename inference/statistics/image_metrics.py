"""FID and KID of features that are computed already, through torchmetrics, with the bootstrap's spread.

A figure is nothing without the network whose features it was taken in, and without the number of images, on which FID
depends: it carries both. Axis letters: L real images, N generated ones, D features, R resamples.

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

from .tally import around, resamples

SUBSET = 1000  # of KID, in its authors' code


class Figure(NamedTuple):
    """A distance between real and generated images.

    Attributes:
        name: ``"FID"`` or ``"KID"``.
        features: whose features it was taken in.
        value: the figure; KID may fall below 0, as an unbiased estimate of 0 does.
        low, high: the 95 % interval, the bootstrap's spread around the figure.
        images: how many real ones.
        generated: how many generated ones, or whatever is on the other side.
        note: what to bear in mind, or nothing.
    """

    name: str
    features: str
    value: float
    low: float
    high: float
    images: int
    generated: int
    note: str = ""

    @property
    def of_images(self) -> str:
        """How many images it is of, in words."""
        if self.images == self.generated:
            return f"{self.images} images a side"
        return f"{self.images} real, {self.generated} generated images"


def fid(real: Tensor, generated: Tensor, features: str, size: int = 50, seed: int = 0) -> Figure:
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
    metric = FrechetInceptionDistance(feature=_Given(D))
    metric.update(real, real=True)
    metric.update(generated, real=False)
    weight = [torch.from_numpy(resamples(len(x), size, seed + i)).double() for i, x in enumerate((real, generated))]
    drawn = [frechet(real[a > 0], generated[b > 0], a[a > 0], b[b > 0]).item() for a, b in zip(*weight, strict=True)]
    few = min(L, N) <= D
    note = f"FID of {min(L, N)} images in {D} dimensions: covariances of deficient rank, the figure is far too high"
    return Figure("FID", features, *around(metric.compute().item(), drawn, 0.0), L, N, note if few else "")


def kid(real: Tensor, generated: Tensor, features: str, subset: int = SUBSET, size: int = 200, seed: int = 0) -> Figure:
    """Unbiased squared MMD under the cubic kernel [2], the mean over ten subsets where there are more images.

    Args:
        subset: images of each side in a subset; all where there are fewer on a side, and the note says so.
        size: R.

    The other arguments and the errors are those of ``fid``.
    """
    real, generated = _checked(real, generated)
    fewest = min(len(real), len(generated))
    taken = min(subset, fewest)
    with warnings.catch_warnings(), torch.random.fork_rng(devices=[]):
        warnings.filterwarnings("ignore", "Metric `Kernel Inception Distance` will save", UserWarning)
        torch.manual_seed(seed)
        subsets = 1 if taken == len(real) == len(generated) else 10
        metric = KernelInceptionDistance(feature=_Given(real.shape[1]), subsets=subsets, subset_size=taken)
        metric.update(real, real=True)
        metric.update(generated, real=False)
        value = metric.compute()[0].item()
    note = f"KID of {fewest} images, fewer than the {subset} of KID's subsets" if fewest < subset else ""
    return Figure(
        "KID", features, *around(value, _kid_drawn(real, generated, size, seed)), len(real), len(generated), note
    )


def frechet(x: Tensor, y: Tensor, of_x: Tensor, of_y: Tensor) -> Tensor:
    """Fréchet distance between Gaussians fitted to weighted points.

    The trace of the root of the covariances' product is the nuclear norm of ``A B^T``, where ``A^T A``, ``B^T B`` are
    the covariances: a matrix of min(points, D) on a side, without the rounding of a square root of nearly 0.

    Args:
        x, y: ``(L, D)`` and ``(N, D)``.
        of_x, of_y: ``(L,)`` and ``(N,)`` how often each point counts.
    """
    means, roots = [], []
    for points, weight in ((x, of_x), (y, of_y)):
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


def _kid_drawn(real: Tensor, generated: Tensor, size: int, seed: int) -> np.ndarray:
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


class _Given(nn.Module):
    """Torchmetrics wants a network; these features have been through one."""

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
