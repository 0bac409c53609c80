"""Lists that have a longest: what the prior says of their lengths, and how long those of derivations are.

A list is a nonterminal that leads to itself, ``Plates -> Plate Plates | ε``; its length is its last list index. Where
``counts(...)`` end, or a weight is 0, there is a longest (``Support``). Lists in which nothing declares one are not
among them. Axis letters: N scenes, T steps, L lists.
"""

import math
from collections.abc import Collection
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .branching import Branching
from .derivation import Derivation
from .grammar import Grammar
from .structure import StructurePrior
from .support import Support


class ListBounds(NamedTuple):
    """A list that has a longest.

    Attributes:
        symbol: the nonterminal.
        parent_list_index: the one that the bounds are of; None where all have the same bounds.
        shortest: under the prior.
        prior: the longest under the prior.
        longest: the longest that is possible, as of pretraining; not less.
    """

    symbol: int
    parent_list_index: int | None
    shortest: int
    prior: int
    longest: int


class Lengths(NamedTuple):
    """Lists of derivations.

    Attributes:
        parent_list_index: ``(L,)`` int64, as of ``Frontier``.
        length: ``(L,)`` int64.
    """

    parent_list_index: NDArray[np.int64]
    length: NDArray[np.int64]

    def select(self, bounds: ListBounds, parent_list_indices: int) -> NDArray[np.int64]:
        """The lengths of the lists that bounds are of; the last parent list index also stands for all later ones."""
        if bounds.parent_list_index is None:
            return self.length
        return self.length[self.parent_list_index.clip(max=parent_list_indices - 1) == bounds.parent_list_index]


def is_list(grammar: Grammar, symbol: int) -> bool:
    """Whether each production of a nonterminal goes on once with the same, or ends, and both are there."""
    again = (grammar.children[grammar.legal[symbol]] == symbol).sum(1).tolist()
    return sorted(set(again)) == [0, 1]


def bounded_lists(grammar: Grammar, prior: StructurePrior, support: Support) -> list[ListBounds]:
    """The lists that have a longest, in the grammar's order, then by parent list index."""
    found = []
    every = [Branching(grammar, table) for table in (prior.table, support.uniform_table())]
    for symbol in (v for v in range(len(grammar.nonterminals)) if is_list(grammar, v)):
        own, possible = (_ends(process, symbol) for process in every)
        bounds = []
        for index, (_, longest) in sorted(possible.items()):
            shortest, most = own.get(min(index, prior.table.shape[1] - 1), (0, 0))
            if math.isfinite(longest) and math.isfinite(most):
                bounds.append(ListBounds(symbol, index, int(shortest), int(most), int(longest)))
        if len({each[2:] for each in bounds}) == 1 and len(bounds) == len(possible):
            bounds = [bounds[0]._replace(parent_list_index=None)]
        found += bounds
    return found


def lengths(grammar: Grammar, derivation: Derivation, symbol: int) -> Lengths:
    """All lists of a nonterminal that derivations have ended."""
    rules, frontier = derivation.rules, derivation.frontier
    again = (grammar.children[rules.clamp(min=0)] == symbol).any(-1)
    ended = (frontier.symbol == symbol) & (rules >= 0) & ~again
    return Lengths(frontier.parent_list_index[ended].numpy(), frontier.list_index[ended].numpy())


def element_kinds(grammar: Grammar, symbol: int, among: Collection[int]) -> tuple[tuple[int, ...], int]:
    """Kinds of which each element of a list has one object in all, as each ``Item`` of ``Items -> Item Items | ε`` with
    ``Item -> red | blue``, and how many its end has; those of lists inside an element are not its own. No kinds where
    lengths cannot be told from objects.

    Args:
        among: the kinds that count.
    """
    each = _rules(grammar, symbol)
    going_on = [k for k in each if (grammar.children[k] == symbol).any()]
    ends = [k for k in each if k not in going_on]
    inside, todo = set[int](), [v for k in going_on for v in _left(grammar, k) if v != symbol]
    while todo:
        v = todo.pop()
        if v not in inside and not is_list(grammar, v):
            inside.add(v)
            todo += [child for k in _rules(grammar, v) for child in _left(grammar, k)]
    rules = [*going_on, *(k for v in inside for k in _rules(grammar, v))]
    found = tuple(sorted({kind for k in rules for kind in _objects(grammar, k)} & set(among)))

    def number(k: int, kinds: tuple[int, ...], around: tuple[int, ...]) -> set[int]:
        """The numbers of objects that a rule can give."""
        total = {sum(kind in kinds for kind in _objects(grammar, k))}
        for v in _left(grammar, k):
            if v in around and v != symbol:
                return {0, 2}  # what leads to itself has no one number
            if v in inside:
                below = set().union(*(number(j, kinds, (*around, v)) for j in _rules(grammar, v)))
                total = {a + b for a in total for b in below}
        return total

    for kinds in (found, *((kind,) for kind in found)):
        more = {sum(kind in kinds for kind in _objects(grammar, k)) for k in ends if not _left(grammar, k)}
        if not kinds or len(more) != 1 or any(_left(grammar, k) for k in ends):
            continue
        if set().union(*(number(k, kinds, (symbol,)) for k in going_on)) == {1}:
            return kinds, more.pop()
    return (), 0


def is_alone(grammar: Grammar, symbol: int, kinds: Collection[int]) -> bool:
    """Whether a scene has at most one such list, and no objects of ``kinds`` beside it."""
    return _most(grammar, 0, symbol, ()) <= 1 and not any(
        kind in kinds for v in _without(grammar, symbol) for k in _rules(grammar, v) for kind in _objects(grammar, k)
    )


def hangs_below(grammar: Grammar, symbol: int, kind: int) -> bool:
    """Whether every such list hangs right below an object of a kind, one below each."""
    found = False
    for k in range(len(grammar.rules)):
        if int(grammar.lhs[k]) == symbol:
            continue
        owners = grammar.child_owner[k][grammar.children[k] == symbol].tolist()
        if len(set(owners)) < len(owners) or any(owner < 0 or grammar.objects[k, owner] != kind for owner in owners):
            return False
        found |= bool(owners)
    return found


def share_from(process: Branching, bounds: ListBounds, length: int) -> float:
    """The share of a prior's lists that have at least so many elements, T_max apart; 0 where it has none."""
    symbol, index, parent_index = np.array(process.types)[process.owner].T
    ends = ~(process.grammar.children.numpy()[process.rule] == bounds.symbol).any(1)
    own = (
        ends
        & (symbol == bounds.symbol)
        & ((parent_index == bounds.parent_list_index) | (bounds.parent_list_index is None))
    )
    total, reached = process.visits[own].sum(), process.visits[own & (index >= length)].sum()
    return float(reached / total) if total and math.isfinite(total) else 0.0


def _ends(process: Branching, symbol: int) -> dict[int, tuple[float, float]]:
    """Shortest and longest by parent list index; an infinite longest where there is none."""
    found: dict[int, tuple[float, float]] = {}
    for i, kind in enumerate(process.types):
        if kind.symbol != symbol:
            continue
        own = process.owner == i
        again = (process.grammar.children[process.rule[own]] == symbol).any(1).numpy()
        shortest, longest = found.get(kind.parent_list_index, (math.inf, 0.0))
        if not again.all():
            shortest = min(shortest, kind.list_index)
        if (process.children[own] == i).any():  # the last state of the table, which leads back to itself
            longest = math.inf
        found[kind.parent_list_index] = shortest, max(longest, kind.list_index)
    return found


def _rules(grammar: Grammar, symbol: int) -> list[int]:
    return grammar.legal[symbol].nonzero().flatten().tolist()


def _left(grammar: Grammar, rule: int) -> list[int]:
    return [v for v in grammar.children[rule].tolist() if v >= 0]


def _objects(grammar: Grammar, rule: int) -> list[int]:
    return [kind for kind in grammar.objects[rule].tolist() if kind >= 0]


def _most(grammar: Grammar, start: int, symbol: int, around: tuple[int, ...]) -> float:
    """How often a list can begin below a nonterminal; infinite where that can repeat itself, or seems to."""
    if start in around:
        return 0.0
    most = 0.0
    for k in _rules(grammar, start):
        left = _left(grammar, k)
        below = sum((v == symbol) + _most(grammar, v, symbol, (*around, start)) for v in left if v != start)
        most = max(most, math.inf if below and any(v in (*around, start) for v in left) else below)
    return most


def _without(grammar: Grammar, symbol: int) -> set[int]:
    """The nonterminals that are reached from the start without a list being expanded."""
    reached, todo = set[int](), [0]
    while todo:
        v = todo.pop()
        if v not in reached and v != symbol:
            reached.add(v)
            todo += [child for k in _rules(grammar, v) for child in _left(grammar, k)]
    return reached
