"""Holding the numbers of kinds that the target's images say nothing of.

A class that cannot be read is left out of what is compared. Its number changes all the same: it stands in lists with
others, whose lengths are learnt. So its counts in generated structures are compared with those in the prior's. No image
is needed for that.

Axis letters: N generated scenes, P scenes of the prior, K held kinds, D features.
"""

from collections.abc import Callable, Collection

import torch
from torch import Tensor

from probscene.derive import derive_complete
from probscene.model import SceneModel
from probscene.sampling import Scenes

from .divergence import Divergence, KDELogRatio, bandwidth

DRAWN = 2000  # P
LEAST_UNIT = 0.3  # objects
ONE = KDELogRatio(variance=1.0, marginal_variance=None)  # of each kind, in bandwidths


class PriorCountPenalty:
    """Counts of some kinds that are to stay as in a model's prior. Its structures are drawn when this is made.

    Args:
        model: the scene model.
        kinds: names of the kinds.
        scenes: in a batch of the fit, for which the bandwidth is chosen.
        one: the divergence of one kind's counts, in bandwidths.
    """

    def __init__(self, model: SceneModel, kinds: Collection[str], scenes: int, one: Divergence = ONE):
        grammar = model.grammar
        self.total, self.one = len(grammar.kinds), one
        self.kinds = [k for k, name in enumerate(grammar.kinds) if name in kinds]
        counts = torch.zeros(1, self.total)
        if self.kinds:
            counts = derive_complete(grammar, model.prior, DRAWN, model.max_steps)[0].counts(self.total).float()
        self.unit = torch.tensor([_unit(counts[:scenes, k]) for k in self.kinds])
        self.prior = counts[:, self.kinds] / self.unit

    def beside(self, observe: Callable[[Scenes], Tensor]) -> Callable[[Scenes], Tensor]:
        """``observe`` with the held counts as further features, ``(N, D + K)``."""

        def features(scenes: Scenes) -> Tensor:
            counts = scenes.derivation.counts(self.total)[:, self.kinds] / self.unit
            return torch.cat([observe(scenes), counts], 1)

        return features

    def added_to(self, divergence: Divergence) -> Divergence:
        """A divergence of features ``(N, D + K)`` and ``(L, D)``: the given one, and one of each held kind."""

        def both(generated: Tensor, real: Tensor) -> Tensor:
            compared, counts = generated.tensor_split([real.shape[1]], 1)
            each = zip(counts.T, self.prior.T, strict=True)
            return sum((self.one(mine[:, None], prior[:, None]) for mine, prior in each), divergence(compared, real))

        return both


def _unit(counts: Tensor) -> float:
    """The bandwidth of one kind's counts, in objects."""
    spread = float(counts.std())
    return max(LEAST_UNIT, spread * bandwidth((counts / spread)[:, None])) if spread else LEAST_UNIT
