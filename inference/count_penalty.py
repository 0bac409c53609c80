"""A penalty that keeps the counts of some kinds as in the prior.

A class that cannot be read in the target's images is left out of what is compared. Its number changes all the same: it
stands in lists with others, whose lengths are learnt. So its counts in generated structures are compared with those in
the prior's, which takes no image.

Axis letters: N generated scenes, P scenes of the prior, K kinds, D features.
"""

from collections.abc import Callable, Collection

import torch
from torch import Tensor

from probscene.derive import derive_complete
from probscene.model import SceneModel
from probscene.sampling import Scenes

from .divergence import Divergence, KDELogRatio, bandwidth

PRIOR_SCENES = 2000  # P
MIN_BANDWIDTH = 0.3  # objects
KIND_DIVERGENCE = KDELogRatio(variance=1.0, marginal_variance=None)  # of one kind's counts, in bandwidths


class PriorCountPenalty:
    """The divergence of the counts of some kinds from those in a model's prior, whose structures the constructor draws.

    Args:
        model: the scene model.
        kinds: names of the kinds.
        scenes: in a batch of the fit, for which the bandwidth is chosen.
        divergence: of one kind's counts, in bandwidths.
    """

    def __init__(
        self, model: SceneModel, kinds: Collection[str], scenes: int, divergence: Divergence = KIND_DIVERGENCE
    ):
        grammar = model.grammar
        self.total, self.divergence = len(grammar.kinds), divergence
        self.kinds = [k for k, name in enumerate(grammar.kinds) if name in kinds]
        counts = torch.zeros(1, self.total)
        if self.kinds:
            counts = derive_complete(grammar, model.prior, PRIOR_SCENES, model.max_steps)[0].counts(self.total).float()
        self.bandwidth = torch.tensor([_bandwidth(counts[:scenes, k]) for k in self.kinds])
        self.prior = counts[:, self.kinds] / self.bandwidth

    def append_counts(self, embed: Callable[[Scenes], Tensor]) -> Callable[[Scenes], Tensor]:
        """``embed`` with the counts as further features, ``(N, D + K)``."""

        def features(scenes: Scenes) -> Tensor:
            counts = scenes.derivation.counts(self.total)[:, self.kinds] / self.bandwidth
            return torch.cat([embed(scenes), counts], 1)

        return features

    def add_to(self, divergence: Divergence) -> Divergence:
        """A divergence of features ``(N, D + K)`` and ``(L, D)``: the given one plus that of each kind's counts."""

        def total(generated: Tensor, real: Tensor) -> Tensor:
            compared, counts = generated.tensor_split([real.shape[1]], 1)
            pairs = zip(counts.T, self.prior.T, strict=True)
            penalties = (self.divergence(count[:, None], prior[:, None]) for count, prior in pairs)
            return sum(penalties, divergence(compared, real))

        return total


def _bandwidth(counts: Tensor) -> float:
    """The bandwidth of one kind's counts, in objects."""
    spread = float(counts.std())
    return max(MIN_BANDWIDTH, spread * bandwidth((counts / spread)[:, None])) if spread else MIN_BANDWIDTH
