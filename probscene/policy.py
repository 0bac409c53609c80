"""Policies: who decides which rule comes next. The prior's table, a PCFG and the LSTM guide are all policies.

Axis letters: N scenes, T steps, K rules, V nonterminals.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from .derivation import Derivation, Frontier
from .grammar import Grammar
from .support import MASKED_LOGIT, Support


class Policy:
    """A distribution over derivations: logits over all K rules at every step; ``derive`` masks the illegal ones.

    Subclasses give ``start`` and ``step``, and may give a faster ``logits``.

    Attributes:
        support: the rules that it may take, masked like illegal ones; all legal ones where None.
        with_parameters: gives the model that draws its structures, of a model, such as one with learnt parameters; the
            same where None.
    """

    grammar: Grammar
    support: Support | None = None
    with_parameters: Callable[[Any], Any] | None = None

    def start(self, num_scenes: int) -> Any:
        """The memory before the first step."""
        return None

    def step(self, memory: Any, frontier: Frontier, previous_rule: Tensor) -> tuple[Tensor, Any]:
        """Logits ``(N, K)`` and the next memory; ``previous_rule (N,)`` is -1 before the first step."""
        raise TypeError(f"expected a policy with a 'step' method, got {type(self).__name__}.")

    def logits(self, derivation: Derivation) -> Tensor:
        """Logits ``(N, T, K)`` at every step of given derivations, unmasked."""
        memory = self.start(len(derivation))
        out = []
        for t in range(derivation.rules.shape[1]):
            frontier = Frontier(*(x[:, t] for x in derivation.frontier))
            step, memory = self.step(memory, frontier, derivation.previous_rules[:, t])
            out.append(step)
        return torch.stack(out, 1)

    def log_prob(self, derivation: Derivation) -> Tensor:
        """``log q(T)``, ``(N,)``: the sum over steps of the masked log-probability of each rule (section 3.2; a product
        of probabilities, where the paper prints a sum)."""
        return rule_log_probs(self.grammar, self.logits(derivation), derivation, self.support).sum(1)


def masked(grammar: Grammar, logits: Tensor, frontier: Frontier, support: Support | None = None) -> Tensor:
    """Logits ``(..., K)`` with the rules masked that do not expand the symbol of ``frontier (...)`` (section 3.2), or
    that are outside a support, and the prior's logits where a support keeps them."""
    logits = logits if support is None else support.with_prior_logits(frontier, logits)
    return torch.where(_allowed(grammar, frontier, support), logits, MASKED_LOGIT)


def cumulative(logits: Tensor) -> Tensor:
    """``(..., K)`` the cumulative distribution of logits."""
    return (logits - logits.logsumexp(-1, keepdim=True)).softmax(-1).cumsum(-1)


def rule_log_probs(grammar: Grammar, logits: Tensor, derivation: Derivation, support: Support | None = None) -> Tensor:
    """Log-probability ``(N, T)`` of each chosen rule; 0 on padding, -inf outside the support."""
    rules, chosen = derivation.rules, derivation.rules.clamp(min=0).unsqueeze(-1)
    logp = torch.log_softmax(masked(grammar, logits, derivation.frontier, support), -1).gather(-1, chosen).squeeze(-1)
    if support is not None:
        logp = logp.masked_fill(~support.allowed(derivation.frontier).gather(-1, chosen).squeeze(-1), -torch.inf)
    return logp.masked_fill(rules < 0, 0.0)


def _allowed(grammar: Grammar, frontier: Frontier, support: Support | None) -> Tensor:
    return grammar.legal[frontier.symbol] if support is None else support.allowed(frontier)
