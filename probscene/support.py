"""What a model declares possible: which rules may be taken in which state of a derivation.

A structure prior gives some rules probability 0: a list of ``counts(1, 1, 1)`` never goes on after two repeats. What
the prior or the policy of pretraining can do in a state that it can reach is possible, and a guide that is bound to a
``Support`` takes no other rule (``Policy.support``). The states are those of the table of a ``StructurePrior``; no
state that can be reached is without a rule. A list of ``weights(...)`` above 0 may always go on: nothing declares a
longest, and nothing is masked.

T_max needs no mask: a derivation that is longer is drawn again, of the prior as of the guide.

Axis letters: N scenes, T steps, V nonterminals, K rules, P ranks of the list around, C repeats, U different masks.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from .branching import Branching
from .derivation import Frontier
from .grammar import Grammar
from .policy import Policy
from .structure import StructurePrior, expand_table

LEAST = -1e9  # as a logit of probability 0: infinity has no gradient


def only_of(grammar: Grammar, kinds: Sequence[str]) -> list[int]:
    """The nonterminals that derive objects, and none but those of some kinds."""
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
        possible: ``(V + 1, P, C, K)`` bool by nonterminal, rank of the list around and repeat, the last of each of the
            two also for all later ones; row V, the finished scene, has rule 0.

    Attributes:
        rows: ``(U, K)`` bool, the different masks.
        row: ``(V + 1, P, C)`` int64, which of them a state has.
        held: the prior that some nonterminals keep; None where none does.
        holds: ``(V + 1,)`` bool, which of them.
    """

    def __init__(self, grammar: Grammar, possible: Tensor):
        self.grammar, self.possible = grammar, possible
        self.held: StructurePrior | None = None
        self.holds = torch.zeros(len(possible), dtype=torch.bool)
        self.rows, row = possible.flatten(0, 2).unique(dim=0, return_inverse=True)
        self.row = row.view(possible.shape[:3])

    @staticmethod
    def of(grammar: Grammar, policies: Sequence[Policy]) -> "Support | None":
        """What at least one of several policies does in a state that it can reach; None where one of them is no table,
        which declares nothing."""
        tables = [policy.table for policy in policies if isinstance(policy, StructurePrior)]
        if not tables or len(tables) < len(policies):
            return None
        P, C = (max(table.shape[axis] for table in tables) for axis in (1, 2))
        C = max(C, P)  # a list's repeats are the rank that its elements read
        possible = torch.zeros(len(grammar.nonterminals) + 1, P, C, len(grammar.rules), dtype=torch.bool)
        for table in tables:
            process = Branching(grammar, expand_table(table, P, C))
            state = torch.tensor([(t.symbol, t.parent_repeat, t.repeat) for t in process.types])[process.owner]
            possible[state[:, 0], state[:, 1], state[:, 2], torch.from_numpy(process.rule)] = True
        never = ~possible.any(-1, keepdim=True)  # nothing reaches it; a mask of nothing would be NaN
        written = torch.stack([expand_table(table, P, C) > -torch.inf for table in tables]).any(0)
        return Support(grammar, possible | (never & written))

    def holding(self, prior: Policy, kinds: Sequence[str]) -> "Support":
        """This one with a prior's probabilities for all nonterminals that derive objects of some kinds alone, whatever
        a guide's logits are: nothing is learnt of them. As it is where the prior is no table."""
        symbols = only_of(self.grammar, kinds)
        if not symbols or not isinstance(prior, StructurePrior):
            return self
        made = Support(self.grammar, self.possible)
        made.held = prior
        made.holds[symbols] = True
        return made

    def settled(self, frontier: Frontier, logits: Tensor) -> Tensor:
        """Logits ``(..., K)`` with the prior's in the states of the nonterminals that keep it."""
        if self.held is None:
            return logits
        _, P, C, _ = self.held.table.shape
        place = frontier.parent_repeat.clamp(max=P - 1), frontier.repeat.clamp(max=C - 1)
        kept = self.held.table[frontier.symbol, *place].clamp(min=LEAST)
        return torch.where(self.holds[frontier.symbol].unsqueeze(-1), kept.to(logits.dtype), logits)

    def allowed(self, frontier: Frontier) -> Tensor:
        """``(..., K)`` bool, the rules that may be taken from ``frontier (...)``."""
        return self.rows[self.rows_of(frontier)]

    def rows_of(self, frontier: Frontier) -> Tensor:
        """``(...)`` int64, which of ``rows`` holds."""
        _, P, C = self.row.shape
        return self.row[frontier.symbol, frontier.parent_repeat.clamp(max=P - 1), frontier.repeat.clamp(max=C - 1)]

    def uniform(self) -> StructurePrior:
        """The prior under which all rules that may be taken are equally probable."""
        share = self.possible.double() / self.possible.sum(-1, keepdim=True)
        return StructurePrior.of_table(self.grammar, share.log().float())

    def part(self, grammar: Grammar, symbol: int, rule: int) -> "Support":
        """That of a grammar whose nonterminals and rules are some of this one's, from numbers ``symbol`` and ``rule``
        on."""
        V, K = len(grammar.nonterminals), len(grammar.rules)
        end = self.possible.new_zeros(1, *self.possible.shape[1:3], K)
        end[..., 0] = True
        return Support(grammar, torch.cat([self.possible[symbol : symbol + V, :, :, rule : rule + K], end]))

    def widened(self, symbol: int, longest: int | None = None, rank: int | None = None) -> "Support":
        """With more for one nonterminal: all its rules in every state; or, where a longest is given, a list that goes
        on for so many repeats, and below its end so far as before.

        Args:
            rank: of the list around, where the list is to be longer in that alone.
        """
        legal = self.grammar.legal[symbol]
        if longest is None:
            possible = self.possible.clone()
            possible[symbol] = legal
            return Support(self.grammar, possible)
        C = max(self.possible.shape[2], longest + 1)
        possible = expand_table(self.possible, self.possible.shape[1], C).clone()
        again = (self.grammar.children == symbol).any(1) & legal
        for p in range(possible.shape[1]) if rank is None else [rank]:
            here = possible[symbol, p]  # (C, K)
            ends = (~(here & again).any(1)).nonzero().flatten()
            if not len(ends):
                continue  # it has no end
            own = int(ends[0])
            here[own:longest] |= (here[:own] & again).any(0) if own else again
            here[own:] |= legal & ~again
            here[longest:] &= ~again
        return Support(self.grammar, possible)
