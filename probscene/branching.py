"""A structure prior as a multi-type branching process: does it end, how long is it, what does it hold; all exact.

Under a ``StructurePrior`` what a nonterminal turns into depends on its type alone: its symbol, its list index and its
parent list index. With ``A[i, j]`` the mean number of j that one i leaves behind, a derivation surely ends if the
spectral radius of A is below 1, and ``(I - A)^-1`` counts the expected visits. The lengths follow from the generating
function ``L_i(s) = s sum_k p_ik prod_j L_j(s)``, coefficient by coefficient. Reference: Harris, The Theory of Branching
Processes, 1963, chapter II.

Axis letters: I types, E productions of types, R children, T steps, K rules.
"""

from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from .grammar import Grammar

CRITICAL = 1 - 1e-6  # the table is float32: a spectral radius from here on counts as 1


class Type(NamedTuple):
    """What decides over an expansion; the indices are clamped where the table no longer tells them apart."""

    symbol: int
    list_index: int
    parent_list_index: int


class Branching:
    """The types that can occur under a structure prior and what they turn into.

    Args:
        grammar: the grammar.
        log_probs: ``(V + 1, P, C, K)`` the table of a ``StructurePrior``.

    Attributes:
        types: the I types, the start first.
        owner: ``(E,)`` which type a production expands.
        rule: ``(E,)`` its rule.
        prob: ``(E,)`` its probability, above 0.
        children: ``(E, R)`` the types it leaves behind; I pads.
    """

    def __init__(self, grammar: Grammar, log_probs: Tensor):
        self.grammar = grammar
        _, P, C, _ = log_probs.shape
        table = log_probs.double().exp().numpy()
        # The index of a list is the parent list index of its elements, so both axes are kept as far as either goes.
        last = max(C, P) - 1
        below = [[v for v in row if v >= 0] for row in grammar.children.tolist()]
        recursive = grammar.recursive.tolist()
        index = {Type(0, 0, 0): 0}
        todo, productions = list(index), []
        for v, list_index, parent in todo:  # grows while it is read
            row = table[v, parent, min(list_index, C - 1)]
            own = min(list_index, P - 1) if recursive[v] else parent
            for k in np.flatnonzero(row):
                left = []
                for child in below[k]:
                    kind = Type(v, min(list_index + 1, last), parent) if child == v else Type(child, 0, own)
                    if kind not in index:
                        index[kind] = len(index)
                        todo.append(kind)
                    left.append(index[kind])
                productions.append((index[Type(v, list_index, parent)], k, row[k] / row.sum(), left))
        self.types = todo
        self.owner = np.array([p[0] for p in productions])
        self.rule = np.array([p[1] for p in productions])
        self.prob = np.array([p[2] for p in productions])
        self.children = np.full((len(productions), grammar.children.shape[1]), len(todo))
        for e, (*_, left) in enumerate(productions):
            self.children[e, : len(left)] = left

    @cached_property
    def mean_offspring(self) -> np.ndarray:
        """``A``, ``(I, I)``."""
        size = len(self.types)
        mean = np.zeros((size, size + 1))
        for child in self.children.T:
            np.add.at(mean, (self.owner, child), self.prob)
        return mean[:, :size]

    @cached_property
    def cycles(self) -> list[tuple[float, list[int]]]:
        """Sets of types that lead back to themselves, each with the spectral radius of ``A`` within it."""
        _, label = connected_components(csr_matrix(self.mean_offspring), connection="strong")
        members: dict[int, list[int]] = {}
        for i, component in enumerate(label):
            members.setdefault(component, []).append(i)
        blocks = [(self.mean_offspring[np.ix_(group, group)], group) for group in members.values()]
        return [(float(abs(np.linalg.eigvals(block)).max()), group) for block, group in blocks if block.any()]

    @property
    def spectral_radius(self) -> float:
        """Of ``A``: a derivation surely ends if it is below 1; 0 where nothing leads back to itself."""
        return max([0.0, *(radius for radius, _ in self.cycles)])

    @cached_property
    def visits(self) -> np.ndarray:
        """``(E,)`` how often each production is expected to be used; infinite if a derivation need not end."""
        if self.spectral_radius >= CRITICAL:
            return np.full(len(self.prob), np.inf)
        start = np.eye(len(self.types))[0]
        return np.linalg.solve(np.eye(len(self.types)) - self.mean_offspring.T, start)[self.owner] * self.prob

    def expected_rules(self) -> np.ndarray:
        """``(K,)`` how often each rule is expected to be used."""
        total = np.zeros(len(self.grammar.rules))
        np.add.at(total, self.rule, self.visits)
        return total

    def lengths(self, upto: int, quantile: float = 1.0, limit: int = 0) -> np.ndarray:
        """``P(length = n)`` for n = 0, 1, ..., ``upto``, and on to where they sum to ``quantile``, or to ``limit``."""
        (E, R), size, most = self.children.shape, len(self.types), max(upto, limit)
        length = np.zeros((size + 1, most + 1))  # the coefficients of L; padding has length 0
        length[size, 0] = 1.0
        product = np.zeros((R + 1, E, most + 1))  # those of the product over the first r children
        product[0, :, 0] = 1.0
        for n in range(1, most + 1):
            for r, child in enumerate(self.children.T):
                product[r + 1, :, n - 1] = np.einsum("en,en->e", product[r, :, :n], length[child, n - 1 :: -1])
            np.add.at(length[:, n], self.owner, self.prob * product[R, :, n - 1])
            if n >= upto and length[0].sum() >= quantile:
                break
        return length[0, : n + 1] if most else length[0]

    def longest(self) -> float:
        """The length of the longest derivation; infinite if there is none."""
        if self.cycles:
            return np.inf
        length = np.append(np.ones(len(self.types)), 0.0)
        while True:
            grown = length.copy()
            np.maximum.at(grown, self.owner, 1 + length[self.children].sum(1))
            if (grown == length).all():
                return float(length[0])
            length = grown

    def max_totals(self, gain: np.ndarray, max_steps: int) -> np.ndarray:
        """``(T + 1,)`` the largest total gain of a derivation of at most 0, 1, ..., T rules; -inf where there is none.

        Args:
            gain: ``(E,)`` of each production, such as the objects that it adds.
            max_steps: T.
        """
        (E, R), size = self.children.shape, len(self.types)
        total = np.full((size + 1, max_steps + 1), -np.inf)  # of derivations of exactly n rules
        total[size, 0] = 0.0
        partial = np.full((R + 1, E, max_steps + 1), -np.inf)  # over the first r children
        partial[0, :, 0] = gain
        for n in range(1, max_steps + 1):
            for r, child in enumerate(self.children.T):
                partial[r + 1, :, n - 1] = (partial[r, :, :n] + total[child, n - 1 :: -1]).max(1)
            np.maximum.at(total[:, n], self.owner, partial[R, :, n - 1])
        return np.maximum.accumulate(total[0])

    def max_total(self, gain: np.ndarray) -> float:
        """The largest total gain of a derivation of any length, of gains that are all of one sign; infinite if there is
        no largest."""
        size = len(self.types)
        total = np.append(np.full(size, -np.inf), 0.0)
        before = total
        with np.errstate(invalid="ignore"):  # of a child without an end beside one without a largest
            for n in range(3 * size):
                if n == size:  # deeper derivations repeat a type, and have a larger total only if there is no largest
                    before = total.copy()
                if n == 2 * size:
                    total[total > before] = np.inf
                np.fmax.at(total, self.owner, gain + total[self.children].sum(1))
        return float(total[0])


def expand_table(table: Tensor, P: int, C: int) -> Tensor:
    """A table ``(..., p, c, K)`` with P and C entries on its two index axes; all later ones are as the last."""
    parent_index, index = (torch.arange(n).clamp(max=table.shape[axis] - 1) for n, axis in ((P, -3), (C, -2)))
    return table[..., parent_index, :, :][..., index, :]
