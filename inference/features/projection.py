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

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from probscene.errors import ProbsceneError, RunError
from probscene.model import SceneModel
from probscene.sampling import seed_everything

from ..divergence import bandwidth, self_share
from ..training import Callback, batch_seed
from .base import FeatureNet, Features, Photographs, Placeable, Renders, slow_settings
from .names import network_name

MAX_COMPONENTS = 100  # principal ones that the discriminant is sought in, and no more than a quarter of the pairs
SHRINKAGE = 1e-6  # of the mean within-structure variance, added to each direction's
STRUCTURES_PER_CALL = 64


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
    axes = axes[: min(MAX_COMPONENTS, varying, max(directions, len(one) // 4))].T
    apart, spread = (one - other).double() @ axes, (both - mean) @ axes
    within, total = apart.T @ apart / (2 * len(one)), spread.T @ spread / len(both)
    within += SHRINKAGE * within.diagonal().mean() * torch.eye(len(within), dtype=within.dtype)
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

    def place(self, device: torch.device) -> None:
        """See ``Placeable``; the projection stays on the CPU."""
        if isinstance(self.pretrained, Placeable):
            self.pretrained.place(device)

    @torch.no_grad()
    def embed(self, images: Tensor) -> Tensor:
        """``(N, d)`` features of ``(N, 1 or 3, H, W)`` uint8 images."""
        found = self.pretrained.embed(images)
        return self.projection(found) if self.weight.shape[1] else found


@dataclass(frozen=True)
class ProjectedFeatures(Features):
    """A pretrained network's features in the few directions that structure moves and parameters do not.

    Args:
        network: one of ``names.CHOICES``.
        pairs: structures that are drawn twice.
        directions: features; 0 for the network's own, as they are.
        scenes: in a batch of the fit, for which their unit is chosen.
    """

    network: str = "efficientnet"
    pairs: int = 500
    directions: int = 8
    scenes: int = 150

    pretrained = True

    @property
    def name(self) -> str:
        """The network's word, with the whole path of its file."""
        name, file = network_name(self.network), self.network.partition("=")[2]
        return f"{name}={Path(file).resolve()}" if file else name

    @property
    def images(self) -> int:
        """See ``Features``."""
        return 2 * self.pairs if self.directions else 0

    def build(self, model: SceneModel) -> Projected:
        """The network with an empty projection, or none."""
        from .pretrained import pretrained, weights_file  # torchvision takes seconds to import

        net, file = pretrained(self.network), weights_file(self.network)
        digest = bytes(32) if file is None else hashlib.sha256(file.read_bytes()).digest()
        return Projected(net, self.directions, digest)

    def training(
        self, net: Projected, renders: Renders, photographs: Callable[[], Photographs], seed: int
    ) -> "ProjectionTraining | None":
        """On renders alone; a minute or so. None where nothing is projected."""
        if not self.directions:
            return None
        return ProjectionTraining(net, renders, self.pairs, self.directions, self.scenes, batch_seed(seed, 1))

    def settings(self, config: Any) -> dict[str, Any]:
        """Those of a slow network; none where its features are taken as they are, as the paper's preset does."""
        return slow_settings(config) if self.directions else {}


class ProjectionTraining:
    """A ``Training`` that finds the projection from two renders of each of some structures. There is nothing to resume:
    one that was interrupted begins again.

    Args:
        net: its projection is set.
        renders: drawn for it.
        pairs, directions, scenes: see ``ProjectedFeatures``.
        seed: of everything random.

    Attributes:
        unit, total, done: see ``Training``.
    """

    unit = "structures"

    def __init__(self, net: Projected, renders: Renders, pairs: int, directions: int, scenes: int, seed: int = 0):
        self.net, self.renders, self.total, self.seed = net, renders, pairs, seed
        self.directions, self.scenes, self.done = directions, scenes, 0
        self._line: dict[str, Any] = {}

    def run(self, callback: Callback | None = None) -> None:
        """See ``Training``; the callback is given the variance over noise at the end.

        Raises:
            ProbsceneError: see ``discriminant``.
        """
        if self.done == self.total:
            return
        seed_everything(self.seed)
        parts, self.done = [], 0
        for first in range(0, self.total, STRUCTURES_PER_CALL):
            self.done = first
            if callback is not None:
                callback(self, {})
            number = min(STRUCTURES_PER_CALL, self.total - first)
            parts.append(self.renders.embed_twice(number, self.net.pretrained))
        one, other = (torch.cat(part) for part in zip(*parts, strict=True))
        self.net.projection = discriminant(one, other, self.directions, self.scenes)
        share = self_share(self.net.projection(other[: self.scenes]))
        ratio = self.net.ratio.tolist()
        self.done, self._line = self.total, {"stage": "projection", "ratio": ratio, "self_share": share}
        if callback is not None:
            callback(self, {"largest variance over noise": ratio[0], "least": ratio[-1], "own kernel's share": share})

    def summary(self) -> dict[str, Any]:
        """For the log: the variance over noise of each direction, and the share of a scene's own kernel."""
        return self._line

    def state(self) -> dict[str, Tensor]:
        """Nothing: the renders are drawn again."""
        return {}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Nothing."""
