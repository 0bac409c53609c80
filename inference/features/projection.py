"""A pretrained network's features, projected to the few numbers that structure moves and parameters do not.

A density estimate in 1,280 dimensions is useless: under the paper's H = d I all log ratios are nearly equal, and under
Silverman's rule every scene is alone. Therefore some structures of the prior are drawn twice, with new parameters, and
the features of the two renders are compared: where they differ, parameters are the cause (positions, colours, ground),
and what they share is due to the structure. The projection is Fisher's linear discriminant [1] with a structure for
each class: the generalised eigenvectors of the total and the within-structure covariance, largest ratio first. No label
is needed, and no real image: a direction in which photographs differ and scenes do not cannot be learnt from.

The unit of the projected features is the bandwidth of their density: the least at which a scene's own kernel has on
average no more than ``SHARE`` of the estimated density at its place, which is to say that about ten others have the
rest. Axis letters: N structures, D features, d directions.

References:
    [1] Fisher, *The use of multiple measurements in taxonomic problems*, Annals of Eugenics 1936.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from probscene.errors import ProbsceneError, RunError

from ..divergence import bandwidth
from .base import FeatureNet

LEADING = 100  # principal components that the discriminant is sought in, and no more than a quarter of the pairs
SHRINK = 1e-6  # of the mean within-structure variance, added to each direction's


class Projection(NamedTuple):
    """A linear map of features.

    Attributes:
        mean: ``(D,)`` of the prior's renders; it falls on 0.
        weight: ``(D, d)``.
        ratio: ``(d,)`` total variance over that within structures, 1 where structure moves nothing.
    """

    mean: Tensor
    weight: Tensor
    ratio: Tensor

    def __call__(self, features: Tensor) -> Tensor:
        """``(N, d)`` of features ``(N, D)``."""
        return (features - self.mean) @ self.weight


def discriminant(one: Tensor, other: Tensor, directions: int, scenes: int) -> Projection:
    """The projection by pairs of renders.

    Args:
        one, other: ``(N, D)`` features of two renders of each structure.
        directions: d.
        scenes: in a batch of the fit, for which the bandwidth is chosen.

    Raises:
        ProbsceneError: features that are not finite, or fewer that vary than directions.
    """
    both = torch.cat([one, other]).double()
    if not torch.isfinite(both).all():
        raise ProbsceneError(
            "expected finite features of the prior's renders, got NaN or infinity; name another network."
        )
    mean = both.mean(0)
    _, size, axes = torch.linalg.svd(both - mean, full_matrices=False)
    varying = int((size > 1e-6 * size[0]).sum())
    if varying < directions or len(one) <= directions:
        raise ProbsceneError(
            f"expected features of the prior's renders that vary in at least {directions} directions, got "
            f"{min(varying, len(one) - 1)}; take fewer directions, more pairs, or a prior that varies."
        )
    axes = axes[: min(LEADING, varying, max(directions, len(one) // 4))].T
    apart, spread = (one - other).double() @ axes, (both - mean) @ axes
    within, total = apart.T @ apart / (2 * len(one)), spread.T @ spread / len(both)
    within += SHRINK * within.diagonal().mean() * torch.eye(len(within), dtype=within.dtype)
    whiten = torch.linalg.inv(torch.linalg.cholesky(within))
    ratio, turn = torch.linalg.eigh(whiten @ total @ whiten.T)
    weight = axes @ (whiten.T @ turn.flip(1)[:, :directions])
    weight = weight / bandwidth((other[:scenes] - mean) @ weight)
    return Projection(mean.float(), weight.float(), ratio.flip(0)[:directions].float())


class Projected(nn.Module):
    """A ``FeatureNet``: a frozen network and a projection, which alone is in the state.

    Args:
        net: the frozen network.
        directions: d; 0 for none, its features stay as they are.
        origin: of the net's weights, 32 bytes; another's state is not loaded.
    """

    mean: Tensor
    weight: Tensor
    ratio: Tensor
    origin: Tensor

    def __init__(self, net: FeatureNet, directions: int, origin: bytes = bytes(32)):
        super().__init__()
        self.net = (net,)  # not a submodule: its weights are in no state
        self.names = tuple(f"direction_{i}" for i in range(1, directions + 1)) or tuple(net.names)
        self.register_buffer("mean", torch.zeros(len(net.names)))
        self.register_buffer("weight", torch.zeros(len(net.names), directions))
        self.register_buffer("ratio", torch.ones(directions))
        self.register_buffer("origin", torch.tensor(list(origin), dtype=torch.uint8))

    @property
    def pretrained(self) -> FeatureNet:
        """The frozen network."""
        return self.net[0]

    @property
    def projection(self) -> Projection:
        return Projection(self.mean, self.weight, self.ratio)

    @projection.setter
    def projection(self, found: Projection) -> None:
        self.mean, self.weight, self.ratio = found

    def load_state_dict(self, state, strict=True, assign=False):
        """As every module's.

        Raises:
            RunError: the projection is of another network's features.
        """
        if not torch.equal(state.get("origin", self.origin), self.origin):
            raise RunError(
                "expected the weights of the feature network as they were when the run was begun, got others; put "
                "that file back, or fit again."
            )
        return super().load_state_dict(state, strict, assign)

    @torch.no_grad()
    def embed(self, images: Tensor) -> Tensor:
        """``(N, d)`` features of ``(N, 1 or 3, H, W)`` uint8 images."""
        found = self.pretrained.embed(images)
        return self.projection(found) if self.weight.shape[1] else found
