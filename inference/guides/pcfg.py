"""A learnt probabilistic context-free grammar: one weight a rule, the baseline without context.

How likely a rule is depends on the nonterminal that it expands and on nothing else, so lists have geometric lengths and
what stands in one element of a list cannot depend on which element it is (Manning and Schuetze, *Foundations of
Statistical Natural Language Processing*, 1999, chapter 11). Its best likelihood has a closed form: each rule's share
among all expansions of its nonterminal.
"""

import torch
from torch import Tensor, nn

from probscene.derivation import Derivation, Frontier
from probscene.grammar import Grammar

from .base import Guide


class PCFG(Guide):
    """Weights ``(K,)`` as logits, equal at first.

    Args:
        grammar: the grammar.
        max_steps: T_max.
    """

    def __init__(self, grammar: Grammar, max_steps: int):
        super().__init__(grammar, max_steps)
        self.weights = nn.Parameter(torch.zeros(len(grammar.rules)))

    def step(self, memory: None, frontier: Frontier, previous_rule: Tensor) -> tuple[Tensor, None]:
        """The weights, ``(N, K)``; there is no memory."""
        return self.weights.expand(len(previous_rule), -1), None

    def logits(self, derivation: Derivation) -> Tensor:
        """The weights, ``(N, T, K)``."""
        return self.weights.expand(*derivation.rules.shape, -1)
