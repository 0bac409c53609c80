"""What a model declares possible: which rules may be taken in which state of a derivation.

A structure prior gives some rules probability 0: a list of ``counts(1, 1, 1)`` never goes on after two elements. A rule
is possible where the prior or the pretraining policy can take it in a state that it can reach. A guide that is bound to
a ``Support`` takes no other rule (``Policy.support``). The states are those of the table of a ``StructurePrior``; every
state that can be reached has a rule. A list of ``weights(...)`` above 0 may always go on, so that nothing is masked.

T_max needs no mask: a longer derivation is redrawn, under the prior as under the guide.

Axis letters: N scenes, T steps, V nonterminals, K rules, P parent list indices, C list indices, U different masks.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from .branching import Branching, expand_table
from .derivation import Frontier
from .grammar import Grammar

MASKED_LOGIT = -1e9  # finite: the gradient of an infinite logit is NaN


def nonterminals_of(grammar: Grammar, kinds: Sequence[str]) -> list[int]:
    """The nonterminals that derive objects of these kinds, and of no other."""
    below = [
        {int(k) for k in grammar.objects[grammar.legal[v]].unique() if k >= 0} for v in range(len(grammar.nonterminals))
    ]
    while True:
        grown = [
            own.union(*(below[int(c)] for c in grammar.children[grammar.legal[v]].unique() if c >= 0))
            for v, own in enumerate(below)
        ]
        if grown == below:
            break
        below = grown
    wanted = {grammar.kind(name) for name in kinds}
    return [v for v, own in enumerate(below) if own and own <= wanted]


class Support:
    """The rules that may be taken, by state.

    Args:
        grammar: the grammar.
        possible: ``(V + 1, P, C, K)`` bool by nonterminal, parent list index and list index; the last index of either
            axis stands for all later ones. Row V, the finished scene, has rule 0.

    Attributes:
        rows: ``(U, K)`` bool, the different masks.
        row: ``(V + 1, P, C)`` int64, the mask of each state.
        prior_table: ``(V + 1, P, C, K)`` the log-probabilities of a prior that some nonterminals keep; None where none
            does.
        keeps_prior: ``(V + 1,)`` bool, which nonterminals do.
    """

    def __init__(self, grammar: Grammar, possible: Tensor):
        self.grammar, self.possible = grammar, possible
        self.prior_table: Tensor | None = None
        self.keeps_prior = torch.zeros(len(possible), dtype=torch.bool)
        self.rows, row = possible.flatten(0, 2).unique(dim=0, return_inverse=True)
        self.row = row.view(possible.shape[:3])

    @staticmethod
    def from_tables(grammar: Grammar, tables: Sequence[Tensor]) -> "Support":
        """What at least one of several priors does in a state that it can reach.

        Args:
            tables: ``(V + 1, P, C, K)`` log-probabilities of each, as of ``StructurePrior.table``.
        """
        P, C = (max(table.shape[axis] for table in tables) for axis in (1, 2))
        C = max(C, P)  # the index of a list is the parent list index of its elements
        possible = torch.zeros(len(grammar.nonterminals) + 1, P, C, len(grammar.rules), dtype=torch.bool)
        for table in tables:
            process = Branching(grammar, expand_table(table, P, C))
            state = torch.tensor([(t.symbol, t.parent_list_index, t.list_index) for t in process.types])[process.owner]
            possible[state[:, 0], state[:, 1], state[:, 2], torch.from_numpy(process.rule)] = True
        unreached = ~possible.any(-1, keepdim=True)  # takes the rules of the tables: all masked would be NaN
        written = torch.stack([expand_table(table, P, C) > -torch.inf for table in tables]).any(0)
        return Support(grammar, possible | (unreached & written))

    def with_prior(self, table: Tensor, kinds: Sequence[str]) -> "Support":
        """A copy in which all nonterminals that derive objects of some kinds alone keep a prior's probabilities,
        whatever a guide's logits are.

        Args:
            table: ``(V + 1, P, C, K)`` the prior's log-probabilities.
        """
        symbols = nonterminals_of(self.grammar, kinds)
        if not symbols:
            return self
        support = Support(self.grammar, self.possible)
        support.prior_table = table
        support.keeps_prior[symbols] = True
        return support

    def with_prior_logits(self, frontier: Frontier, logits: Tensor) -> Tensor:
        """Logits ``(..., K)``, of which those of the nonterminals that keep the prior are its own."""
        if self.prior_table is None:
            return logits
        _, P, C, _ = self.prior_table.shape
        index = frontier.parent_list_index.clamp(max=P - 1), frontier.list_index.clamp(max=C - 1)
        prior = self.prior_table[frontier.symbol, *index].clamp(min=MASKED_LOGIT)
        return torch.where(self.keeps_prior[frontier.symbol].unsqueeze(-1), prior.to(logits.dtype), logits)

    def allowed(self, frontier: Frontier) -> Tensor:
        """``(..., K)`` bool, the rules that may be taken from ``frontier (...)``."""
        return self.rows[self.rows_of(frontier)]

    def rows_of(self, frontier: Frontier) -> Tensor:
        """``(...)`` int64, which of ``rows`` holds."""
        _, P, C = self.row.shape
        return self.row[
            frontier.symbol, frontier.parent_list_index.clamp(max=P - 1), frontier.list_index.clamp(max=C - 1)
        ]

    def uniform_table(self) -> Tensor:
        """``(V + 1, P, C, K)`` log-probabilities under which all rules that may be taken are equally probable."""
        share = self.possible.double() / self.possible.sum(-1, keepdim=True)
        return share.log().float()

    def part(self, grammar: Grammar, symbol: int, rule: int) -> "Support":
        """The support of a grammar whose nonterminals and rules are this one's from ``symbol`` and ``rule`` on."""
        V, K = len(grammar.nonterminals), len(grammar.rules)
        end = self.possible.new_zeros(1, *self.possible.shape[1:3], K)
        end[..., 0] = True
        return Support(grammar, torch.cat([self.possible[symbol : symbol + V, :, :, rule : rule + K], end]))

    def widened(self, symbol: int, longest: int | None = None, parent_list_index: int | None = None) -> "Support":
        """A copy in which one nonterminal may take all its rules in every state.

        Args:
            longest: for a list, up to how many elements it may go on; below its former end it stays as it was.
            parent_list_index: at which alone the list may be longer; all where None.
        """
        legal = self.grammar.legal[symbol]
        if longest is None:
            possible = self.possible.clone()
            possible[symbol] = legal
            return Support(self.grammar, possible)
        C = max(self.possible.shape[2], longest + 1)
        possible = expand_table(self.possible, self.possible.shape[1], C).clone()
        again = (self.grammar.children == symbol).any(1) & legal
        for p in range(possible.shape[1]) if parent_list_index is None else [parent_list_index]:
            here = possible[symbol, p]  # (C, K)
            ends = (~(here & again).any(1)).nonzero().flatten()
            if not len(ends):
                continue  # it has no end
            own = int(ends[0])
            here[own:longest] |= (here[:own] & again).any(0) if own else again
            here[own:] |= legal & ~again
            here[longest:] &= ~again
        return Support(self.grammar, possible)
