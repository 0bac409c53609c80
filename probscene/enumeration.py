"""Every complete derivation of a small grammar, so that q(T) and expectations under it are exact sums.

Axis letters: N derivations, T steps.
"""

import torch

from .derivation import Derivation
from .errors import GrammarError
from .grammar import Grammar


def enumerate_derivations(grammar: Grammar, max_steps: int, limit: int = 100_000) -> Derivation:
    """Each complete derivation of at most ``max_steps`` rules once, in the order of their rules.

    ``policy.log_prob(enumerate_derivations(grammar, max_steps)).exp()`` are the exact q(T); what they lack to 1 is the
    probability of a longer derivation.

    Args:
        limit: the most derivations to hold.

    Raises:
        GrammarError: there are more than ``limit``, or none.
    """
    shortest = shortest_lengths(grammar)
    if shortest[0] > max_steps:
        raise GrammarError(
            f"expected max_steps of at least {shortest[0]}, the length of the shortest derivation, got {max_steps}."
        )
    children = [[int(v) for v in row if v >= 0] for row in grammar.children]
    of = [grammar.rules_of(name) for name in grammar.nonterminals]
    found: list[tuple[int, ...]] = []
    # An entry is (rules so far, nonterminals to expand with the next one last, the fewest rules these need).
    todo: list[tuple[tuple[int, ...], tuple[int, ...], int]] = [((), (0,), shortest[0])]
    while todo:
        rules, stack, needed = todo.pop()
        if not stack:
            found.append(rules)
            if len(found) > limit:
                raise GrammarError(
                    f"expected at most {limit} derivations of at most {max_steps} rules, got more; "
                    "lower max_steps or raise the limit."
                )
            continue
        for k in reversed(of[stack[-1]]):
            fewest = needed - shortest[stack[-1]] + sum(shortest[v] for v in children[k])
            if len(rules) + 1 + fewest <= max_steps:
                todo.append(((*rules, k), (*stack[:-1], *children[k]), fewest))
    longest = max(map(len, found))
    return Derivation.from_rules(grammar, torch.tensor([rules + (-1,) * (longest - len(rules)) for rules in found]))


def shortest_lengths(grammar: Grammar) -> list[int]:
    """The fewest rules that each of the V nonterminals takes to its end."""
    endless = 10**9
    shortest = [endless] * len(grammar.nonterminals)
    children = [[int(v) for v in row if v >= 0] for row in grammar.children]
    changed = True
    while changed:
        changed = False
        for lhs, below in zip(grammar.lhs.tolist(), children, strict=True):
            length = 1 + sum(shortest[v] for v in below)
            if length < shortest[lhs]:
                shortest[lhs], changed = length, True
    return shortest
