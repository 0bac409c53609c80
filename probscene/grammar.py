"""Scene grammars: productions as text or Python, checked when built, and the tables that a vectorised derivation reads.

A symbol that begins with an upper-case letter is a nonterminal, any other a terminal: an object of the scene graph.
``plate(Mugs)`` makes the objects that ``Mugs`` derives children of the plate; without brackets they are its siblings.
Reference: Meta-Sim2 (Devaranjan, Kar, Fidler, ECCV 2020), section 3.1.
"""

import re
from collections import Counter
from collections.abc import Iterable
from typing import NamedTuple

import torch
from torch import Tensor

from .errors import GrammarError

_NAME = re.compile(r"[\w\-]+")
_TOKEN = re.compile(r"\s*([\w\-]+|[()|])")
_EMPTY = {"ε", "eps"}


class Node(NamedTuple):
    """A terminal with what hangs below it: ``Node("plate", ("Mugs",))`` is ``plate(Mugs)``."""

    name: str
    children: tuple["str | Node", ...] = ()

    def __str__(self) -> str:
        return f"{self.name}({' '.join(map(str, self.children))})" if self.children else self.name


class Rule:
    """A production: ``Rule("Plates", "Plate", "Plates")``; no symbols is the empty production.

    Args:
        lhs: the nonterminal.
        rhs: nonterminals and terminals by name, or ``Node``.

    Raises:
        GrammarError: a name that could not stand in text, or a ``Node`` that is no object with a tuple of children.
    """

    def __init__(self, lhs: str, *rhs: str | Node):
        self.lhs, self.rhs = _checked_name(lhs), tuple(map(_normal, rhs))

    def __eq__(self, other) -> bool:
        return isinstance(other, Rule) and (self.lhs, self.rhs) == (other.lhs, other.rhs)

    def __hash__(self) -> int:
        return hash((self.lhs, self.rhs))

    def __str__(self) -> str:
        return f"{self.lhs} -> {' '.join(map(str, self.rhs)) or 'ε'}"

    __repr__ = __str__

    def flatten(self) -> tuple[list[tuple[str, int]], list[tuple[str, int]]]:
        """Objects and nonterminals from left to right, each with the index of the object it hangs below, or -1."""
        objects: list[tuple[str, int]] = []
        nonterminals: list[tuple[str, int]] = []

        def walk(symbols, owner):
            for symbol in symbols:
                name = symbol if isinstance(symbol, str) else symbol.name
                (nonterminals if is_nonterminal(name) else objects).append((name, owner))
                if not isinstance(symbol, str):
                    walk(symbol.children, len(objects) - 1)

        walk(self.rhs, -1)
        return objects, nonterminals


def _normal(symbol: str | Node) -> str | Node:
    """One form for equal symbols: a node without children is its name."""
    if isinstance(symbol, str) or not symbol.children:
        return _checked_name(symbol if isinstance(symbol, str) else symbol.name)
    name, children = symbol
    if not isinstance(children, tuple):
        raise GrammarError(f"expected a tuple of children, got Node({name!r}, {children!r}).")
    if is_nonterminal(_checked_name(name)):
        raise GrammarError(f"expected children below an object (first letter lower-case), got '{symbol}'.")
    return Node(name, tuple(map(_normal, children)))


def _checked_name(name: str) -> str:
    if not _NAME.fullmatch(name) or name in _EMPTY:
        raise GrammarError(
            f"expected names of letters, digits, '_' and '-', got {name!r}; give each symbol as an argument of its "
            "own, what hangs below an object as Node(name, children), and no symbols for the empty production."
        )
    return name


def is_nonterminal(name: str) -> bool:
    """Whether a symbol is expanded, rather than an object."""
    return name[:1].isupper()


class Grammar:
    """A scene grammar. Axis letters: V nonterminals, K rules, R nonterminals and J objects of one right-hand side.

    Args:
        productions: text, one nonterminal a line with its alternatives apart by ``|``, ``ε`` for none, ``#`` for a
            comment; or ``Rule`` objects. The first left-hand side is the start symbol.

    Attributes:
        rules: the K rules, those of one nonterminal side by side, in the order they were written.
        nonterminals: the V names, the start symbol first.
        kinds: the names of the objects, in the order they appear.
        legal: ``(V + 1, K)`` bool, which rules expand which nonterminal. Row V, the finished scene, has only rule 0: a
            padding step has one legal value.
        children: ``(K, R)`` int64 nonterminals to push, the rightmost first; -1 pads.
        child_owner: ``(K, R)`` the rule's object that they hang below; -1 is the owner of what is expanded.
        objects: ``(K, J)`` kinds from left to right; -1 pads.
        object_owner: ``(K, J)`` as ``child_owner``.
        lhs: ``(K,)`` the nonterminal that a rule expands.
        recursive: ``(V + 1,)`` bool, whether a nonterminal has a production with itself on the right: a list.

    Raises:
        GrammarError: text that does not parse, undefined nonterminals, unreachable or unproductive symbols, missing or
            duplicate productions.
    """

    def __init__(self, productions: str | Iterable[Rule]):
        rules = parse(productions) if isinstance(productions, str) else list(productions)
        if not rules:
            raise GrammarError("expected at least one production, got none; write one as 'Scene -> Things'.")
        self.nonterminals = tuple(dict.fromkeys(rule.lhs for rule in rules))
        self.rules = tuple(rule for name in self.nonterminals for rule in rules if rule.lhs == name)
        self._flat = [rule.flatten() for rule in self.rules]
        self.kinds = tuple(dict.fromkeys(name for objects, _ in self._flat for name, _ in objects))
        self._check()
        self._tabulate()

    def __str__(self) -> str:
        lines = []
        for name in self.nonterminals:
            alternatives = [str(rule).split(" -> ", 1)[1] for rule in self.rules if rule.lhs == name]
            lines.append(f"{name} -> {' | '.join(alternatives)}")
        return "\n".join(lines)

    def rules_of(self, nonterminal: str) -> list[int]:
        """Indices of a nonterminal's rules.

        Raises:
            GrammarError: there is no such nonterminal.
        """
        if nonterminal not in self.nonterminals:
            raise GrammarError(f"expected a nonterminal among {list(self.nonterminals)}, got {nonterminal!r}.")
        return [k for k, rule in enumerate(self.rules) if rule.lhs == nonterminal]

    def kind(self, name: str) -> int:
        """Index of an object's name in ``kinds``.

        Raises:
            GrammarError: the grammar has no such object.
        """
        if name not in self.kinds:
            raise GrammarError(f"expected an object among {list(self.kinds)}, got {name!r}.")
        return self.kinds.index(name)

    def _check(self) -> None:
        for rule in self.rules:
            if not is_nonterminal(rule.lhs):
                raise GrammarError(
                    f"expected a nonterminal (first letter upper-case) left of '->', got {rule.lhs!r} in '{rule}'; "
                    "objects have no productions."
                )
        for rule, count in Counter(self.rules).items():
            if count > 1:
                raise GrammarError(f"Duplicate production: '{rule}' stands {count} times; keep one and weight it.")
        used = {name for _, nonterminals in self._flat for name, _ in nonterminals}
        undefined = sorted(used - set(self.nonterminals))
        if undefined:
            raise GrammarError(
                f"Undefined nonterminal: {', '.join(undefined)}; missing productions. Add a line "
                f"'{undefined[0]} -> ...', or begin the name with a lower-case letter if it is an object."
            )
        reached, todo = set(), [self.nonterminals[0]]
        while todo:
            name = todo.pop()
            if name not in reached:
                reached.add(name)
                todo += [n for k in self.rules_of(name) for n, _ in self._flat[k][1]]
        unreachable = [n for n in self.nonterminals if n not in reached]
        if unreachable:
            raise GrammarError(
                f"Unreachable nonterminal: {', '.join(unreachable)}; nothing derives it from the start symbol "
                f"{self.nonterminals[0]!r}. Use it on a right-hand side or delete its productions."
            )
        productive: set[str] = set()
        while grown := {
            rule.lhs
            for rule, (_, nonterminals) in zip(self.rules, self._flat, strict=True)
            if rule.lhs not in productive and all(n in productive for n, _ in nonterminals)
        }:
            productive |= grown
        endless = [n for n in self.nonterminals if n not in productive]
        if endless:
            raise GrammarError(
                f"Nonterminal that can never end: {', '.join(endless)}; every production leads back to itself. "
                f"Add an alternative that stops, such as '{endless[0]} -> ε'."
            )

    def _tabulate(self) -> None:
        V, K = len(self.nonterminals), len(self.rules)
        index = {name: v for v, name in enumerate(self.nonterminals)}
        kind = {name: j for j, name in enumerate(self.kinds)}
        R = max(1, max(len(nonterminals) for _, nonterminals in self._flat))
        J = max(1, max(len(objects) for objects, _ in self._flat))
        self.lhs = torch.tensor([index[rule.lhs] for rule in self.rules])
        self.legal = torch.zeros(V + 1, K, dtype=torch.bool)
        self.legal[self.lhs, torch.arange(K)] = True
        self.legal[V, 0] = True
        self.recursive = torch.zeros(V + 1, dtype=torch.bool)
        self.children, self.child_owner = torch.full((K, R), -1), torch.full((K, R), -1)
        self.objects, self.object_owner = torch.full((K, J), -1), torch.full((K, J), -1)
        for k, (objects, nonterminals) in enumerate(self._flat):
            _fill(self.children[k], self.child_owner[k], [(index[n], owner) for n, owner in reversed(nonterminals)])
            _fill(self.objects[k], self.object_owner[k], [(kind[n], owner) for n, owner in objects])
            self.recursive[self.lhs[k]] |= any(index[n] == self.lhs[k] for n, _ in nonterminals)
        self.num_children = (self.children >= 0).sum(1)
        self.num_objects = (self.objects >= 0).sum(1)


def _fill(symbols: Tensor, owners: Tensor, entries: list[tuple[int, int]]) -> None:
    for i, (symbol, owner) in enumerate(entries):
        symbols[i], owners[i] = symbol, owner


def parse(text: str) -> list[Rule]:
    """Productions from text; the syntax is ``Grammar``'s.

    Raises:
        GrammarError: a line that does not parse, named with its number.
    """
    rules: list[Rule] = []
    lhs = None
    for number, line in enumerate(text.splitlines(), 1):
        line = line.split("#", 1)[0].strip()
        if not line:
            continue
        if line.startswith("|") and lhs is not None:
            right = line[1:]
        else:
            left, arrow, right = (line if "->" in line else line.replace("→", "->")).partition("->")
            lhs = left.strip()
            if not arrow or not _NAME.fullmatch(lhs):
                raise GrammarError(f"Line {number}: expected 'Name -> symbols | symbols', got '{line}'.")
        rules += _alternatives(lhs, right, number)
    return rules


def _alternatives(lhs: str, right: str, number: int) -> list[Rule]:
    tokens, at = [], 0
    right = right.rstrip()
    while at < len(right):
        match = _TOKEN.match(right, at)
        if match is None:
            raise GrammarError(f"Line {number}: expected names, brackets and '|', got '{right[at:].strip()}'.")
        tokens.append(match[1])
        at = match.end()
    rules: list[Rule] = []
    levels: list[list[str | Node]] = [[]]
    empty = False

    def fault(what):
        return GrammarError(f"Line {number}: {what} in '{lhs} -> {right.strip()}'.")

    for token in [*tokens, "|"]:
        if token == "(":
            if not levels[-1] or not isinstance(levels[-1][-1], str) or is_nonterminal(levels[-1][-1]):
                raise fault("expected an object (first letter lower-case) before '('")
            levels.append([])
        elif token == ")":
            if len(levels) == 1:
                raise fault("a ')' without its '('")
            inner = tuple(levels.pop())
            if inner and isinstance(levels[-1][-1], str):
                levels[-1][-1] = Node(levels[-1][-1], inner)
        elif token == "|":
            if len(levels) > 1:
                raise fault("a '(' without its ')'; alternatives cannot stand inside brackets")
            if not levels[0] and not empty:
                raise fault("missing production: an alternative is blank; write ε for the empty one")
            if levels[0] and empty:
                raise fault("ε beside other symbols; it stands alone")
            rules.append(Rule(lhs, *levels[0]))
            levels, empty = [[]], False
        elif token in _EMPTY:
            empty = True
        else:
            levels[-1].append(token)
    return rules
