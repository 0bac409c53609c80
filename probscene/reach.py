"""Which numbers of objects a model can have: exactly, as an integer programme over how often each rule is used.

By Parikh's theorem the counts of a grammar's derivations are those that some numbers of uses of its productions give,
if as many nonterminals are produced as are expanded, the start once, and all that is used hangs together with the start
[1]. States of a ``Support`` stand in for nonterminals. The last condition is added as a cut where a solution breaks it.

References:
    [1] Verma, Seidl, Schwentick, *On the complexity of equational Horn clauses*, CADE 2005, section 4.

Axis letters: I states, E productions of states, S sets of kinds.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import Bounds, LinearConstraint, milp
from scipy.sparse import coo_matrix, csr_matrix, vstack
from scipy.sparse.csgraph import breadth_first_order

from .branching import Branching
from .grammar import Grammar
from .support import Support

INFEASIBLE = 2  # milp's status


class Reach:
    """The counts that derivations can have.

    Args:
        grammar: the grammar.
        support: the rules that may be taken.
        max_steps: T_max; None for no limit.
        kinds: the S sets of kinds, by number, whose objects are counted together.
    """

    def __init__(self, grammar: Grammar, support: Support, max_steps: int | None, kinds: Sequence[Sequence[int]]):
        self.process = process = Branching(grammar, support.uniform_table())
        size, uses = len(process.types), len(process.owner)
        self.uses = uses
        owner, each = process.owner, np.arange(uses)
        made, child = (process.children < size).nonzero(), process.children[process.children < size]
        expanded = coo_matrix((np.ones(uses), (owner, each)), (size, uses))
        produced = coo_matrix((np.ones(len(child)), (child, made[0])), (size, uses))
        self.flow = csr_matrix(expanded - produced)
        self.start = np.eye(size)[0]
        objects = grammar.objects.numpy()[process.rule]  # (E, J)
        self.counts = csr_matrix(np.array([np.isin(objects, some).sum(1) for some in kinds], float).reshape(-1, uses))
        self.max_steps = np.inf if max_steps is None else max_steps
        self.cuts: list[csr_matrix] = []

    def most(self, kinds: int) -> float:
        """The most objects of set number ``kinds``; infinite if there is no most."""
        return self._extreme(-self.counts[[kinds]].toarray()[0], -1)

    def least(self, kinds: int) -> float:
        """The fewest."""
        return self._extreme(self.counts[[kinds]].toarray()[0], 1)

    def fewest_rules(self, counts: NDArray[np.int64], at_least: bool = False) -> float:
        """How many rules the shortest derivation has with so many objects ``(S,)`` of each set; infinite if there is
        none. A count of -1 is left open.

        Args:
            at_least: whether there may be more objects.
        """
        low: Any = np.where(counts < 0, 0, counts)
        high: Any = np.where((counts < 0) | at_least, np.inf, counts)
        return self._extreme(np.ones(self.uses), 1, LinearConstraint(self.counts, low, high))

    def _extreme(self, cost: NDArray[np.float64], sign: int, more: LinearConstraint | None = None) -> float:
        uses = self.uses
        while True:
            constraints = [
                LinearConstraint(self.flow, self.start, self.start),
                LinearConstraint(csr_matrix(np.ones((1, uses))), 0, self.max_steps),
                *([LinearConstraint(csr_matrix(vstack(self.cuts)), 0, np.inf)] if self.cuts else []),
                *([] if more is None else [more]),
            ]
            found = milp(cost, integrality=np.ones(uses), bounds=Bounds(0, np.inf), constraints=constraints)
            if found.x is None:
                return np.inf  # infeasible, or without a bound
            used = found.x.round()
            apart = self._apart(used)
            if not len(apart):
                return float(sign * round(found.fun))
            self.cuts.append(self._cut(apart, used))

    def _apart(self, used: NDArray[np.float64]) -> NDArray[np.int64]:
        """The states that are expanded although nothing that hangs together with the start makes them."""
        owner, children, size = self.process.owner, self.process.children, len(self.process.types)
        rows, columns = (used[:, None] * (children < size) > 0).nonzero()
        edges = csr_matrix((np.ones(len(rows)), (owner[rows], children[rows, columns])), (size, size))
        reached = breadth_first_order(edges, 0, return_predecessors=False)
        return np.setdiff1d(owner[used > 0], reached)

    def _cut(self, apart: NDArray[np.int64], used: NDArray[np.float64]) -> csr_matrix:
        """Some production outside leads in if one inside is used: their use is at most so many times that of those."""
        owner, children = self.process.owner, self.process.children
        inside = np.isin(owner, apart)
        into = ~inside & np.isin(children, apart).any(1)
        limit = self.max_steps if np.isfinite(self.max_steps) else 1e4
        return csr_matrix((limit * into - inside).astype(float)[None])
