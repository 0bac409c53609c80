"""The maximum mean discrepancy as a cost that can be differentiated by features.

Axis letters: N generated, L real, D features.

References:
    [1] Gretton et al., *A Kernel Two-Sample Test*, JMLR 2012.
    [2] Li, Swersky, Zemel, *Generative Moment Matching Networks*, ICML 2015: a sum of kernels of several widths.
"""

import torch
from torch import Tensor

SCALES = (0.125, 0.25, 0.5, 1.0, 2.0)  # of the kernels' variances, in the mean squared distance of generated from real
REAL = 500  # whose own term is computed


class Discrepancy:
    """The unbiased squared MMD [1] of a sample from a real one, with a mean of Gaussian kernels of several widths [2].

    Their unit is the mean squared distance of the sample from the real one, which has no derivative.

    Args:
        real: ``(L, D)``, L at least 2.
    """

    def __init__(self, real: Tensor):
        self.real = real
        self.within = torch.cdist(real[:REAL], real[:REAL]).square()

    def __call__(self, generated: Tensor) -> Tensor:
        """Of ``(N, D)``, N at least 2; a number that has a gradient by them."""
        across = _squared(generated, self.real)
        unit = across.detach().mean().clamp(min=1e-12)
        own = _off_diagonal(_kernel(_squared(generated, generated), unit))
        return own - 2 * _kernel(across, unit).mean() + _off_diagonal(_kernel(self.within, unit))


def _squared(a: Tensor, b: Tensor) -> Tensor:
    return (a.square().sum(1, keepdim=True) + b.square().sum(1) - 2 * a @ b.T).clamp(min=0.0)


def _kernel(squared: Tensor, unit: Tensor) -> Tensor:
    return torch.stack([torch.exp(-0.5 / scale * squared / unit) for scale in SCALES]).mean(0)


def _off_diagonal(kernel: Tensor) -> Tensor:
    n = len(kernel)
    return (kernel.sum() - kernel.diagonal().sum()) / (n * (n - 1))
