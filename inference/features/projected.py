"""The choice of a pretrained network's features, projected (``projection``)."""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from probscene.model import SceneModel
from probscene.sampling import seed_everything

from ..divergence import self_share
from ..training import Callback, batch_seed
from .base import Features, Photographs, Renders, slow_settings
from .names import network_name
from .projection import Projected, discriminant

STRUCTURES_PER_CALL = 64


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

    def settings(self, preset: Any) -> dict[str, Any]:
        """Those of a slow network; none where its features are taken as they are, as the paper's preset does."""
        return slow_settings(preset) if self.directions else {}


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
