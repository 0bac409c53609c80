"""Muon in float32. Torch's own iterates in bfloat16, which processors without instructions for it only emulate."""

import math
from collections.abc import Iterable

import torch
from torch import Tensor

from probscene.errors import ProbsceneError

QUINTIC = (3.4445, -4.7750, 2.0315)  # steepest at 0 of those that bring singular values near 1 and keep them there [1]
ROUNDS = (3, 2)  # steps between products with the whole matrix; five at once lose half the digits of small values


class Muon(torch.optim.Optimizer):
    """Momentum whose step has singular values near 1, whatever the gradient's [1].

    With the gradient G of a matrix W (m, n), momentum mu and learning rate eta, a step is

        B <- mu B + (1 - mu) G
        W <- W - eta sqrt(max(1, m / n)) O(mu B + (1 - mu) G),

    where O(U S V^T) is about U V^T (``orthogonalise``). These are the steps of ``torch.optim.Muon`` by default, without
    weight decay, to bfloat16's accuracy; states go from one to the other.

    Args:
        params: matrices.
        lr: eta.
        momentum: mu.

    Raises:
        ProbsceneError: a parameter is no matrix.

    Reference:
        [1] Jordan et al., *Muon: an optimizer for hidden layers in neural networks*, 2024.
    """

    def __init__(self, params: Iterable[Tensor], lr: float = 1e-3, momentum: float = 0.95):
        super().__init__(params, {"lr": lr, "momentum": momentum})
        for parameter in (p for group in self.param_groups for p in group["params"]):
            if parameter.ndim != 2:
                raise ProbsceneError(
                    f"expected matrices as Muon's parameters, got shape {tuple(parameter.shape)}; give the others "
                    "to another optimiser."
                )

    @torch.no_grad()
    def step(self) -> None:
        """Move every matrix that has a gradient."""
        for group in self.param_groups:
            for matrix in group["params"]:
                if matrix.grad is None:
                    continue
                slots = self.state[matrix]
                if not slots:
                    slots["momentum_buffer"] = torch.zeros_like(matrix)
                mean = slots["momentum_buffer"].lerp_(matrix.grad, 1 - group["momentum"])
                update = orthogonalise(matrix.grad.lerp(mean, group["momentum"]))
                matrix.sub_(update, alpha=group["lr"] * math.sqrt(max(1.0, matrix.shape[0] / matrix.shape[1])))


def orthogonalise(matrix: Tensor) -> Tensor:
    """``U p(S) V^T`` of ``matrix = U S V^T``, where p takes singular values that are not tiny to 0.7..1.2.

    p is five Newton-Schulz steps ``X <- a X + b (X X^T) X + c (X X^T)^2 X`` of the matrix over its Frobenius norm. Each
    is ``X <- P X`` with a polynomial P of the Gram matrix ``A = X X^T``, and takes A to ``P A P``: several steps are
    taken on A, which is small, before the product of their P multiplies X.

    Args:
        matrix: ``(m, n)``.

    Returns:
        ``(m, n)``, of the same type; 0 where the matrix is 0.
    """
    if matrix.shape[0] > matrix.shape[1]:
        return orthogonalise(matrix.T).T
    x = matrix / matrix.norm().clamp(min=1e-7)
    for steps in ROUNDS:
        gram = x @ x.T
        product = factor = _factor(gram)
        for _ in range(steps - 1):
            gram = factor @ gram @ factor
            factor = _factor(gram)
            product = factor @ product
        x = product @ x
    return x


def _factor(gram: Tensor) -> Tensor:
    """P of a Gram matrix, ``a I + b A + c A^2``."""
    a, b, c = QUINTIC
    factor = torch.addmm(gram, gram, gram, beta=b, alpha=c)
    factor.diagonal().add_(a)
    return factor
