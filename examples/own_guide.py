"""A guide of one's own: a table of rules by place in a list, the smallest that can say "the first plate has the mugs".

    probscene fit examples/tabletop.py --target photos/ --out runs/own --guide examples/own_guide.py:PlaceGuide

In Python, ``FitConfig(guide=PlaceGuide)``. A PCFG has one weight a rule and forgets where it is; an LSTM
remembers everything. This one knows two places, and what it has learnt can be read in its table.
"""

from typing import Any

import torch
from torch import Tensor, nn

import probscene as ps
from probscene.derivation import Frontier
from probscene.grammar import Grammar

PLACES = 8  # told apart in a list; later ones count as the last


class PlaceGuide(ps.Guide):
    """Logits of rules by the nonterminal's place in its list, and by that of the list that it is in.

    In a list, the rule that goes on at place 0, 1, 2, ... is chosen by its own probability, so its length can have any
    distribution up to ``PLACES``, another one for each place of its parent.

    Args:
        grammar: with K rules.
        max_steps: T_max.

    Attributes:
        table: ``(PLACES, PLACES, K)`` logits by the parent's place and its own; rules that are not legal are masked.
    """

    def __init__(self, grammar: Grammar, max_steps: int):
        super().__init__(grammar, max_steps)
        self.table = nn.Parameter(torch.zeros(PLACES, PLACES, len(grammar.rules)))

    def step(self, memory: Any, frontier: Frontier, previous_rule: Tensor) -> tuple[Tensor, Any]:
        """Logits ``(N, K)`` of one step; ``memory``, which is what ``start`` gave, is not needed."""
        return self._at(frontier), memory

    def logits(self, derivation: ps.Derivation) -> Tensor:
        """Logits ``(N, T, K)`` of all steps at once: the same as step by step, but faster."""
        return self._at(derivation.frontier)

    def _at(self, frontier: Frontier) -> Tensor:
        return self.table[frontier.parent_list_index.clamp(max=PLACES - 1), frontier.list_index.clamp(max=PLACES - 1)]
