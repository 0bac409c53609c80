"""How likely a policy would have derived given structures: the one figure that knows all of a structure at once."""

from typing import NamedTuple

import torch

from probscene.derivation import Derivation
from probscene.inference.statistics.count_metrics import Interval, mean_interval, resamples
from probscene.policy import Policy
from probscene.support import MASKED_LOGIT
from probscene.threads import threads


class Likelihood(NamedTuple):
    """Held-out structures under a policy.

    Attributes:
        nats: mean log q(T) of the structures that the policy can derive, nats a scene; None if there is none.
        impossible: share of the structures that it never derives; the mean over all is -inf where this is not 0.
    """

    nats: Interval | None
    impossible: float


@torch.no_grad()
def likelihood(policy: Policy, derivation: Derivation) -> Likelihood:
    """The likelihood of structures (L of them)."""
    with threads(1):  # the guide's tensors are tiny
        logp = policy.log_prob(derivation).double()
    possible = logp > MASKED_LOGIT / 2
    known = logp[possible].numpy()
    nats = mean_interval(known, resamples(len(known))) if len(known) else None
    return Likelihood(nats, 1 - float(possible.double().mean()))
