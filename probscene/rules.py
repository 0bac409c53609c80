"""Rules drawn by their logits, in a Pyro program and outside one: of one seed both draw the same.

Axis letters: N scenes, K rules.
"""

from typing import Any

import numpy as np
import pyro.distributions as dist
import torch
from torch import Tensor

from .derivation import Frontier
from .errors import ModelError
from .grammar import Grammar
from .policy import Policy, cumulative, masked
from .structure import StructurePrior


class RuleCategorical(dist.Categorical):
    """A Categorical that draws by the inverse of its cumulative distribution, several times as fast for many scenes and
    few rules; one uniform number a draw."""

    def sample(self, sample_shape: Any = ()) -> Tensor:
        """``sample_shape + batch_shape`` int64."""
        shares = self.logits.softmax(-1).cumsum(-1)  # ``cumulative``, to the bit, of logits that are normalised
        return drawn(shares.expand(*sample_shape, *self.batch_shape, -1))


def drawn(cumulative: Tensor) -> Tensor:
    """``(...)`` int64, the first rule whose cumulative probability is no less than a uniform number above 0: never one
    of probability 0.

    Raises:
        ModelError: the logits were not finite.
    """
    if cumulative[..., -1].isnan().any():
        raise ModelError(
            "Expected finite logits of the rules from a policy, actual NaN or infinite ones; look at what its step "
            "returns, and begin again with a lower learning rate where it was learnt."
        )
    least = cumulative[..., -1:] * (1 - torch.rand(*cumulative.shape[:-1], 1))
    return torch.searchsorted(cumulative, least).squeeze(-1)


def looked_up(prior: StructurePrior, frontier: Frontier) -> Tensor:
    """``drawn`` of a table, ``(N,)``, in numpy, see ``expand``."""
    rows = prior.cumulative.take(prior.state(*(part.numpy() for part in frontier)), 1)  # (K, N)
    least = rows[-1] * (1 - torch.rand(rows.shape[1]).numpy())
    return torch.from_numpy((rows < least).sum(0, dtype=np.uint8 if len(rows) < 256 else None).astype(np.int64))


class Choice:
    """What ``expand`` asks for rules, where nothing hears of them.

    Args:
        grammar: the grammar.
        policy: who decides.
        num_scenes: N.
    """

    def __init__(self, grammar: Grammar, policy: Policy, num_scenes: int):
        self.grammar, self.policy, self.memory = grammar, policy, policy.start(num_scenes)
        self.prior = policy if type(policy) is StructurePrior and policy.support is None else None

    def __call__(self, t: int, frontier: Frontier, previous: Tensor) -> Tensor:
        """Rules ``(N,)``, whatever where a scene is finished."""
        if self.prior is not None:
            return looked_up(self.prior, frontier)
        logits, self.memory = self.policy.step(self.memory, frontier, previous)
        allowed = masked(self.grammar, logits, frontier, self.policy.support)
        return drawn(cumulative(allowed))
