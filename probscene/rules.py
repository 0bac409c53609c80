"""Rules drawn by their logits, in a Pyro program and outside one: of one seed both draw the same.

Axis letters: N scenes, K rules.
"""

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import pyro.distributions as dist
import torch
from torch import Tensor

from .derivation import Arrays, Frontier, tensor_chooser
from .errors import ModelError
from .grammar import Grammar
from .policy import Policy, cumulative, masked
from .structure import StructurePrior

BINS = 64  # of a probability, for each of which it is known where to begin to look


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
            "expected finite logits of the rules from a policy, got NaN or infinite ones; look at what its step "
            "returns, and begin again with a lower learning rate where it was learnt."
        )
    least = cumulative[..., -1:] * (1 - torch.rand(*cumulative.shape[:-1], 1))
    return torch.searchsorted(cumulative, least).squeeze(-1)


class InverseCDF(NamedTuple):
    """The inverse of the cumulative distributions of a table's rules, E that have a probability in all its rows.

    Attributes:
        total: ``(rows,)`` float32 the last of each distribution, about 1.
        ascending: ``(E,)`` float64 the cumulative probabilities of all rows, each row 2 above the one before.
        rule: ``(E,)`` int64 of each.
        first: ``(2 * BINS * rows,)`` how many of them are below each 1 / BINS.
    """

    total: np.ndarray
    ascending: np.ndarray
    rule: np.ndarray
    first: np.ndarray

    @staticmethod
    @lru_cache(64)
    def from_prior(prior: StructurePrior) -> "InverseCDF":
        """Of a prior, whose table does not change any more."""
        shares = cumulative(prior.table.flatten(0, 2)).nan_to_num(1.0)  # a row of no rule: no scene comes to it
        rows, rules = (shares.diff(dim=1, prepend=torch.zeros(len(shares), 1)) > 0).nonzero(as_tuple=True)
        ascending = (shares[rows, rules].double() + 2 * rows).numpy()
        first = ascending.searchsorted(np.arange(2 * BINS * len(shares)) / BINS)
        return InverseCDF(shares[:, -1].numpy(), ascending, rules.numpy(), first)

    def drawn(self, row: np.ndarray) -> np.ndarray:
        """A rule for each of some rows; of one seed those that ``drawn`` gives."""
        sought = self.total.take(row) * (1 - torch.rand(len(row)).numpy()) + 2.0 * row
        found = self.first.take((BINS * sought).astype(np.int64))
        while np.count_nonzero(short := self.ascending.take(found) < sought):
            found += short
        return self.rule.take(found)


class Choice:
    """Chooses rules for ``expand``, where no handler sees them.

    Args:
        grammar: the grammar.
        policy: who decides.
        num_scenes: N.
    """

    def __init__(self, grammar: Grammar, policy: Policy, num_scenes: int):
        self.grammar, self.policy, self.memory = grammar, policy, policy.start(num_scenes)
        self.prior = policy if type(policy) is StructurePrior and policy.support is None else None
        self.ask = tensor_chooser(self._decided)

    def __call__(self, t: int, frontier: Arrays, previous: np.ndarray) -> np.ndarray:
        """Rules ``(N,)``, whatever where a scene is finished."""
        if self.prior is not None:
            return InverseCDF.from_prior(self.prior).drawn(self.prior.state(*frontier))
        return self.ask(t, frontier, previous)

    def _decided(self, t: int, frontier: Frontier, previous: Tensor) -> Tensor:
        logits, self.memory = self.policy.step(self.memory, frontier, previous)
        return drawn(cumulative(masked(self.grammar, logits, frontier, self.policy.support)))
