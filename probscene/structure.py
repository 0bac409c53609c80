"""Structure priors as tables: rule weights, and length distributions that no rule weight can express.

A list ``Plates -> Plate Plates | ε`` with weights on its two rules has geometric lengths. ``counts(p0, p1, ...)`` gives
P(n = c) instead: the frontier carries the list index, and the list stops after c elements with the
hazard h(c) = P(n = c) / P(n >= c).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .branching import Branching, expand_table
from .derivation import Frontier
from .errors import GrammarError
from .grammar import Grammar
from .policy import Policy
from .support import Support


@dataclass(frozen=True)
class Counts:
    """A distribution over the number of elements of a list; ``weights`` share out its recursive productions."""

    probs: tuple[float, ...]
    weights: tuple[float, ...] | None = None


@dataclass(frozen=True)
class Weights:
    """Probabilities of a nonterminal's productions, in the order they are written, up to a factor."""

    values: tuple[float, ...]


@dataclass(frozen=True)
class Ranked:
    """A distribution for each ``Frontier.parent_list_index``; the last also for all later ones."""

    each: tuple[Counts | Weights, ...]


def counts(*probs: float, weights: tuple[float, ...] | None = None) -> Counts:
    """``counts(.2, .4, .4)``: no element with probability .2, one with .4, two with .4; normalised.

    Raises:
        GrammarError: something that is no number.
    """
    shares = None if weights is None else _numbers("counts(..., weights=", weights)
    return Counts(_numbers("counts(", probs), shares)


def weights(*values: float) -> Weights:
    """``weights(1, 1, 2)``: the third production twice as likely as either other.

    Raises:
        GrammarError: something that is no number.
    """
    return Weights(_numbers("weights(", values))


def ranked(*each: Counts | Weights) -> Ranked:
    """``ranked(counts(...), counts(...))``: one for the first element of the enclosing list, one for all others."""
    return Ranked(each)


class StructurePrior(Policy):
    """A table of rule probabilities by nonterminal, parent list index and list index.

    Args:
        grammar: the grammar.
        distributions: by nonterminal; one that is not named takes its productions with equal probability.

    Attributes:
        table: ``(V + 1, P, C, K)`` float32 log-probabilities; -inf where impossible.

    Raises:
        GrammarError: no ``Grammar``, a distribution that is none of the three, a nonterminal that the grammar lacks, a
            wrong number of weights, a negative or zero total, or ``counts`` of a nonterminal that is not a list.
    """

    def __init__(self, grammar: Grammar, **distributions: Counts | Weights | Ranked):
        _check_types(grammar, distributions)
        self.grammar = grammar
        given = {name: d.each if isinstance(d, Ranked) else (d,) for name, d in distributions.items()}
        if any(not each for each in given.values()):
            raise GrammarError("expected at least one distribution in ranked(...), got none.")
        P = max([1, *(len(each) for each in given.values())])
        C = max([1, *(len(d.probs) for each in given.values() for d in each if isinstance(d, Counts))])
        V, K = len(grammar.nonterminals), len(grammar.rules)
        table = torch.zeros(V + 1, P, C, K, dtype=torch.float64)
        for v, name in enumerate(grammar.nonterminals):
            rules = grammar.rules_of(name)
            each = given.pop(name, (Weights((1.0,) * len(rules)),))
            for p in range(P):
                table[v, p][:, rules] = _rule_probs(grammar, name, each[min(p, len(each) - 1)], C)
        if given:
            raise GrammarError(
                f"expected distributions of nonterminals among {list(grammar.nonterminals)}, got {sorted(given)}."
            )
        table[V, :, :, 0] = 1.0
        self.table = table.log().float()

    def where(
        self, legal: Callable[[str, int, int], bool], list_indices: int = 1, parent_list_indices: int = 1
    ) -> "StructurePrior":
        """This prior without some productions, by what was derived so far.

        Those that are left share the probability: of a list first those that go on, or those that end it, so that its
        length stays as it was where one of them is left.

        ``prior.where(lambda production, index, _: index > 0 or production != "Plates -> ε", list_indices=2)``: the list
        does not end before its first plate. Guides keep to it, as to all that a prior says is impossible.

        Args:
            legal: whether a production, as the grammar prints it, may be taken at a list index and a parent list index
                (see ``Frontier``).
            list_indices, parent_list_indices: for how many of each, from 0 on, ``legal`` is called; all later ones are
                as the last.

        Raises:
            GrammarError: nothing is left in a state that can be reached, or no production is ever left out.
        """
        _, P, C, K = self.table.shape
        P, C = max(P, parent_list_indices), max(C, list_indices)
        table, rules = expand_table(self.table, P, C).clone(), self.grammar.rules
        asked = [[(c, p) for c in range(list_indices)] for p in range(parent_list_indices)]
        keep = torch.tensor([[[bool(legal(str(rule), *at)) for rule in rules] for at in row] for row in asked])
        keep = expand_table(keep.unsqueeze(0), P, C)[0].expand(len(table) - 1, P, C, K)
        if keep.all():
            raise GrammarError(
                f"expected a production that is not legal somewhere, got all legal up to list index {list_indices - 1} "
                f"and parent list index {parent_list_indices - 1}; write productions as '{rules[0]}', or raise "
                "list_indices or parent_list_indices."
            )
        before, left = table[:-1].double().exp(), torch.zeros(table[:-1].shape, dtype=torch.float64)
        again = (self.grammar.children == self.grammar.lhs[:, None]).any(1)
        for group in (again, ~again):
            share = before * (keep & group)
            left += share * ((before * group).sum(-1, keepdim=True) / share.sum(-1, keepdim=True)).nan_to_num(0.0, 0.0)
        empty = (left == 0).all(-1, keepdim=True)
        table[:-1] = (left / left.sum(-1, keepdim=True)).log().where(~empty, -torch.inf).float()
        made = StructurePrior.from_table(self.grammar, table)
        for symbol, index, parent_index in Branching(self.grammar, table).types:
            if empty[symbol, min(parent_index, P - 1), min(index, C - 1)]:
                raise GrammarError(
                    f"expected a production of {self.grammar.nonterminals[symbol]} that is legal at list "
                    f"index {index} and parent list index {parent_index}, got none that has a probability there."
                )
        table[:-1] = torch.where(empty, expand_table(self.table, P, C)[:-1], table[:-1])  # which nothing reaches
        return made

    @staticmethod
    def joined(
        grammar: Grammar,
        priors: Sequence["StructurePrior"],
        first_symbol: Sequence[int],
        first_rule: Sequence[int],
        weights: Sequence[float],
    ) -> "StructurePrior":
        """The prior of a grammar that begins with a choice of scenario: one by its weight, then its own table.

        Args:
            priors: of the scenarios.
            first_symbol, first_rule: where the nonterminals and the rules of each scenario begin in the grammar's.
            weights: of the scenarios, up to a factor.
        """
        V, K = len(grammar.nonterminals), len(grammar.rules)
        P, C = (max(prior.table.shape[i] for prior in priors) for i in (1, 2))
        table = torch.full((V + 1, P, C, K), -torch.inf)
        table[0, :, :, : len(priors)] = _normalised(tuple(weights), len(priors), "weights of scenarios").log().float()
        table[V, :, :, 0] = 0.0
        for prior, v, k in zip(priors, first_symbol, first_rule, strict=True):
            own = expand_table(prior.table[:-1], P, C)
            table[v : v + own.shape[0], :, :, k : k + own.shape[3]] = own
        return StructurePrior.from_table(grammar, table)

    @staticmethod
    def from_table(grammar: Grammar, table: Tensor) -> "StructurePrior":
        """The prior with a given ``table``, which is neither checked nor normalised."""
        prior = StructurePrior.__new__(StructurePrior)
        prior.grammar, prior.table = grammar, table
        return prior

    def step(self, memory: None, frontier: Frontier, previous_rule: Tensor) -> tuple[Tensor, None]:
        """Log-probabilities ``(N, K)``; there is no memory."""
        return self._look_up(frontier), None

    def logits(self, derivation) -> Tensor:
        """``(N, T, K)`` at once."""
        return self._look_up(derivation.frontier)

    def state(self, symbol: np.ndarray, list_index: np.ndarray, parent_list_index: np.ndarray) -> np.ndarray:
        """``(...)`` row of ``table.flatten(0, 2)``, of a frontier."""
        _, P, C, _ = self.table.shape
        row = symbol if P == 1 else symbol * P + np.minimum(parent_list_index, P - 1)
        return row if C == 1 else row * C + np.minimum(list_index, C - 1)

    def _look_up(self, frontier: Frontier) -> Tensor:
        row = self.state(frontier.symbol.numpy(), frontier.list_index.numpy(), frontier.parent_list_index.numpy())
        return self.table.flatten(0, 2)[torch.from_numpy(row)]


def support_of_policies(grammar: Grammar, policies: Sequence[Policy]) -> Support | None:
    """What at least one of several policies does in a state that it can reach; None where one of them is no
    ``StructurePrior``, since nothing says what it cannot do."""
    priors = [policy for policy in policies if isinstance(policy, StructurePrior)]
    if not priors or len(priors) < len(policies):
        return None
    return Support.from_tables(grammar, [prior.table for prior in priors])


def hazards(probs: Tensor) -> Tensor:
    """Stop probabilities ``h(c) = P(n = c) / P(n >= c)``, ``(C,)``; 1 where ``P(n >= c)`` is 0."""
    tail = probs.flip(0).cumsum(0).flip(0)
    return torch.where(tail > 0, probs / tail.clamp(min=1e-300), torch.ones_like(probs)).clamp(max=1.0)


def _rule_probs(grammar: Grammar, name: str, distribution: Counts | Weights, C: int) -> Tensor:
    """Probabilities ``(C, rules of name)`` of a nonterminal's rules after c elements."""
    rules = grammar.rules_of(name)
    if isinstance(distribution, Weights):
        return _normalised(distribution.values, len(rules), f"weights of {name}").expand(C, -1)
    v = grammar.nonterminals.index(name)
    again = [(grammar.children[k] == v).sum().item() for k in rules]
    if sorted(set(again)) != [0, 1]:
        raise GrammarError(
            f"expected a list such as '{name} -> item {name} | ε' for counts of {name}, got "
            f"'{'; '.join(str(grammar.rules[k]) for k in rules)}'; use weights(...) here."
        )
    recursive = torch.tensor(again, dtype=torch.float64)
    probs = _normalised(distribution.probs, None, f"counts of {name}")
    stop = torch.ones(C, 1, dtype=torch.float64)
    stop[: len(probs), 0] = hazards(probs)
    shares = (1.0,) * int(recursive.sum()) if distribution.weights is None else distribution.weights
    split = torch.zeros(len(rules), dtype=torch.float64)
    split[recursive > 0] = _normalised(shares, int(recursive.sum()), f"weights of {name}'s recursive productions")
    return stop * (1 - recursive) / (1 - recursive).sum() + (1 - stop) * split


def _numbers(call: str, values: Any) -> tuple[float, ...]:
    """What ``counts`` or ``weights`` was given, as numbers."""
    actual = ", ".join(map(repr, values)) if isinstance(values, list | tuple) else repr(values)
    try:
        if isinstance(values, list | tuple) and not any(isinstance(value, str) for value in values):
            return tuple(map(float, values))
    except (TypeError, ValueError):
        pass
    alone = "weights=" in call
    right = "(1, 2)), a tuple of them" if alone else "1, 2), one argument each; unpack a list with a star"
    raise GrammarError(f"expected numbers in {call}...), got {call}{actual}); write {call}{right}.")


def _check_types(grammar: Any, distributions: dict[str, Any]) -> None:
    """See that a ``StructurePrior`` is given a grammar, and distributions of it.

    Raises:
        GrammarError: it is not.
    """
    if not isinstance(grammar, Grammar):
        raise GrammarError(
            f"expected a Grammar in StructurePrior(grammar, ...), got {type(grammar).__name__}; "
            "make one of the text first: StructurePrior(Grammar(text), ...)."
        )
    for name, given in distributions.items():
        for each in given.each if isinstance(given, Ranked) else (given,):
            if not isinstance(each, Counts | Weights):
                raise GrammarError(
                    f"expected counts(...), weights(...) or ranked(...) of them for {name}, got {each!r}; write "
                    f"{name}=counts(1, 2) for how long a list is, or weights(1, 2) for how likely each production is."
                )


def _normalised(values: tuple[float, ...], number: int | None, what: str) -> Tensor:
    probs = torch.tensor(values, dtype=torch.float64)
    if number is not None and len(values) != number:
        raise GrammarError(f"expected {number} {what}, one a production, got {len(values)}.")
    if not len(values) or not torch.isfinite(probs).all() or (probs < 0).any() or probs.sum() <= 0:
        raise GrammarError(f"expected non-negative {what} with a positive sum, got {values}.")
    return probs / probs.sum()
