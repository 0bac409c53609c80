"""Leftmost derivations of many scenes at once, and the scene graphs that they spell.

A tensor holds a last-in-first-out stack of nonterminals for every scene (Meta-Sim2, section 3.2); each step pops one,
takes a rule for it and pushes what the rule produces. There is no Python loop over scenes. Axis letters: N scenes, T
steps, M nodes, K rules, R nonterminals and J objects of one rule.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from .errors import GrammarError
from .grammar import Grammar


class Frontier(NamedTuple):
    """What is about to be expanded, one nonterminal a scene.

    Attributes:
        symbol: ``(N,)`` int64 nonterminal; V where the scene is finished.
        list_index: ``(N,)`` how many elements of this list come before: a child with its parent's nonterminal has one
            more, any other child 0.
        parent_list_index: ``(N,)`` the ``list_index`` of the nearest enclosing list.
    """

    symbol: Tensor
    list_index: Tensor
    parent_list_index: Tensor


@dataclass(frozen=True, eq=False)
class Derivation:
    """A batch of derivations.

    Attributes:
        rules: ``(N, T)`` int64, -1 pads.
        complete: ``(N,)`` bool, whether no nonterminal is left.
        kind: ``(N, M)`` int64 the scene graph's objects in the order they were derived, -1 pads; M >= 1.
        parent: ``(N, M)`` int64 index of the parent node, -1 for none; a parent comes before its children.
        frontier: three ``(N, T)`` tensors, what each step expanded.
    """

    rules: Tensor
    complete: Tensor
    kind: Tensor
    parent: Tensor
    frontier: Frontier

    @staticmethod
    def from_rules(grammar: Grammar, rules: Tensor) -> "Derivation":
        """The derivations that given rules ``(N, T)`` spell; -1 pads.

        Raises:
            GrammarError: a rule that does not expand the nonterminal on top of the stack, rules after the end or after
                padding, or numbers that are no rule's.
        """
        given, K = rules.long(), len(grammar.rules)
        if ((given < -1) | (given >= K)).any():
            raise GrammarError(
                f"expected rules among 0..{K - 1}, or -1 for padding, got {int(given.min())}..{int(given.max())}."
            )
        if ((given[:, 1:] >= 0) & (given[:, :-1] < 0)).any():
            raise GrammarError("expected padding (-1) only after a scene's last rule, got rules after padding.")

        def choose(t, frontier, previous):
            rule = given[:, t]
            wrong = ~grammar.legal[frontier.symbol, rule.clamp(min=0)] & (rule >= 0)
            wrong |= (frontier.symbol == len(grammar.nonterminals)) & (rule >= 0)
            if wrong.any():
                i = int(wrong.nonzero()[0])
                names = (*grammar.nonterminals, "the end of the derivation")
                raise GrammarError(
                    f"expected a rule of {names[int(frontier.symbol[i])]} at step {t} of scene {i}, "
                    f"got {int(rule[i])} ({grammar.rules[int(rule[i])]})."
                )
            return rule

        return expand(grammar, tensor_chooser(choose), len(given), given.shape[1])

    @staticmethod
    def merged(grammar: Grammar, parts: "list[tuple[Tensor, Derivation]]") -> "Derivation":
        """One batch out of several, each with the places ``(n,)`` of its scenes in it: all of 0..N-1 once, N >= 1."""
        steps = max(part.rules.shape[1] for _, part in parts)
        nodes = max(part.kind.shape[1] for _, part in parts)
        order = torch.cat([places for places, _ in parts]).argsort()
        wide = [part.padded(grammar, steps, nodes) for _, part in parts]
        rules, complete, kind, parent = (
            torch.cat([getattr(part, key) for part in wide])[order] for key in ("rules", "complete", "kind", "parent")
        )
        return Derivation(
            rules,
            complete,
            kind,
            parent,
            Frontier(*(torch.cat(each)[order] for each in zip(*(part.frontier for part in wide), strict=True))),
        )

    def padded(self, grammar: Grammar, steps: int, nodes: int) -> "Derivation":
        """The same derivations with at least so many columns of steps and of nodes."""
        steps, nodes = max(0, steps - self.rules.shape[1]), max(0, nodes - self.kind.shape[1])
        finished = (len(grammar.nonterminals), 0, 0)
        return Derivation(
            pad(self.rules, (0, steps), value=-1),
            self.complete,
            pad(self.kind, (0, nodes), value=-1),
            pad(self.parent, (0, nodes), value=-1),
            Frontier(*(pad(x, (0, steps), value=end) for x, end in zip(self.frontier, finished, strict=True))),
        )

    def trimmed(self) -> "Derivation":
        """The same derivations without the columns that pad every scene, as ``from_rules`` gives them."""
        steps = max(1, int(self.lengths.max())) if len(self) else 1
        nodes = max(1, int((self.kind >= 0).sum(1).max())) if len(self) else 1
        if (steps, nodes) == (self.rules.shape[1], self.kind.shape[1]):
            return self
        frontier = Frontier(*(x[:, :steps] for x in self.frontier))
        return Derivation(self.rules[:, :steps], self.complete, self.kind[:, :nodes], self.parent[:, :nodes], frontier)

    def __len__(self) -> int:
        return self.rules.shape[0]

    def __getitem__(self, scenes: Tensor | slice) -> "Derivation":
        """The derivations of some of the scenes."""
        frontier = Frontier(*(x[scenes] for x in self.frontier))
        return Derivation(self.rules[scenes], self.complete[scenes], self.kind[scenes], self.parent[scenes], frontier)

    @property
    def previous_rules(self) -> Tensor:
        """``(N, T)`` the rule before each step, -1 before the first and after the end."""
        return torch.cat([torch.full_like(self.rules[:, :1], -1), self.rules[:, :-1]], 1)

    @property
    def lengths(self) -> Tensor:
        """``(N,)`` number of rules."""
        return (self.rules >= 0).sum(1)

    def sites(self) -> dict[str, Tensor]:
        """The values of the sites ``rule_t``, each ``(N, 1)``, for ``poutine.condition``."""
        return {f"rule_{t}": self.rules[:, t : t + 1].clamp(min=0) for t in range(self.rules.shape[1])}

    def counts(self, num_kinds: int) -> Tensor:
        """``(N, num_kinds)`` int64, how many nodes of each kind."""
        padded = torch.zeros(len(self), num_kinds + 1, dtype=torch.int64)
        padded.scatter_add_(1, self.kind.where(self.kind >= 0, num_kinds), torch.ones_like(self.kind))
        return padded[:, :num_kinds]


Arrays = tuple[np.ndarray, ...]  # of a frontier, in its order
Chooser = Callable[[int, Arrays, np.ndarray], np.ndarray]  # rules ``(N,)`` of the step, frontier and rules before it


def tensor_chooser(choose: Callable[[int, Frontier, Tensor], Tensor]) -> Chooser:
    """A chooser that is given tensors and gives one."""

    def choose_arrays(t: int, frontier: Arrays, previous: np.ndarray) -> np.ndarray:
        return choose(t, Frontier(*map(torch.from_numpy, frontier)), torch.from_numpy(previous)).numpy()

    return choose_arrays


def expand(grammar: Grammar, choose: Chooser, N: int, max_steps: int) -> Derivation:
    """Run the stack machine; what is chosen for a finished scene is ignored.

    It counts in numpy, whose calls cost a fraction of torch's where scenes are a few hundred.

    Raises:
        GrammarError: so many steps that a stack's entry does not fit into 63 bits.
    """
    fields, R = Fields.from_grammar(grammar, max_steps), grammar.children.shape[1]
    deepest = 2 + (max_steps + 1) * max(1, R - 1)
    # Entry 0 is the finished scene and is never popped. Scenes lie side by side: the next entry is N further.
    stack = np.zeros((deepest + R) * N, np.int64)
    stack[:N] = end = len(grammar.nonterminals)
    table, above = _productions(grammar, N, fields), N * np.arange(R)[:, None]
    top, nodes = np.arange(N) + N, np.zeros(N, np.int64)
    rule, history = np.full(N, -1), []
    for t in range(max_steps):
        entry = stack.take(top)
        frontier = fields.frontier(entry)
        going_on = frontier[0] < end
        number = np.count_nonzero(going_on)
        if not number:
            break
        rule = np.where(going_on, choose(t, frontier, rule), -1)
        history.append((rule, nodes, entry))
        each = table.take(rule, 1)  # of -1 the last
        pushed, kept, taken = each[:-2].reshape(3, R, N)
        # Writing the padding too is harmless: what lies above the new top is overwritten before it is popped.
        stack[top + above] = pushed + (entry & kept) + (fields.below(frontier[1], nodes) & taken)
        if np.count_nonzero(rule >= 0) < number:  # given rules that end too early
            left = going_on & (rule < 0)
            stack[top[left]] = entry[left]
        top = top + each[-2]
        nodes = nodes + each[-1]
    if not history:
        history.append((np.full(N, -1), nodes, np.full(N, end)))
    rules, base, entries = np.ascontiguousarray(np.array(history).transpose(1, 2, 0))  # (N, T)
    expanded = Frontier(*map(torch.from_numpy, fields.frontier(entries)))
    rules, base, owner = map(torch.from_numpy, (rules, base, fields.owner(entries)))
    kind, parent = _scene_graph(grammar, rules, base, owner, torch.from_numpy(nodes))
    return Derivation(rules, torch.from_numpy(top < N), kind, parent, expanded)


class Fields(NamedTuple):
    """Where the bits of a stack's entry are: a frontier, and 1 + the node that hangs above, 0 for none. The finished
    scene is its symbol alone.

    Attributes:
        list_index, parent_list_index, node: the first bit of each; that of ``symbol`` is 0.
    """

    list_index: int
    parent_list_index: int
    node: int

    @staticmethod
    def from_grammar(grammar: Grammar, max_steps: int) -> "Fields":
        """As few bits as numbers need that so many steps can come to."""
        list_index = len(grammar.nonterminals).bit_length()
        parent_list_index = list_index + max_steps.bit_length()
        node = parent_list_index + max_steps.bit_length()
        if node + (1 + max_steps * grammar.objects.shape[1]).bit_length() > 63:
            raise GrammarError(f"expected a max_steps of some thousands at most, got {max_steps}; lower it.")
        return Fields(list_index, parent_list_index, node)

    def frontier(self, entry: np.ndarray) -> tuple[np.ndarray, ...]:
        """Symbol, list_index and parent_list_index of entries."""
        return tuple(entry >> low & (1 << high - low) - 1 for low, high in pairwise((0, *self)))

    def owner(self, entry: np.ndarray) -> np.ndarray:
        """The node that hangs above, -1 for none."""
        return (entry >> self.node) - 1

    def below(self, list_index: np.ndarray, nodes: np.ndarray) -> np.ndarray:
        """The bits of what is inside an element of a list, and hangs below the first of a rule's objects where there
        were so many nodes."""
        return (list_index << self.parent_list_index) + (1 + nodes << self.node)


@lru_cache(64)
def _productions(grammar: Grammar, N: int, fields: Fields) -> np.ndarray:
    """``(3 R + 2, K + 1)`` of each rule, and last of none, which pushes the finished scene: what is added to each of R
    entries to push, which bits it has of the entry that is popped, and which of ``Fields.below``; how far the top of
    the stack moves; how many objects there are."""
    children, owner = grammar.children.T, grammar.child_owner.T
    same = children == grammar.lhs
    inside, hangs = ~same & grammar.recursive[grammar.lhs], owner >= 0
    of_list_index, of_parent_list_index, of_node = ((1 << high) - (1 << low) for low, high in pairwise((*fields, 63)))
    pushed = children + (same.long() << fields.list_index) + (owner.clamp(min=0) << fields.node)
    kept = same * of_list_index + ~inside * of_parent_list_index + ~hangs * of_node
    taken = inside * of_parent_list_index + hangs * of_node
    numbers = torch.stack([N * (grammar.num_children - 1), grammar.num_objects])
    table = pad(torch.cat([pushed, kept, taken, numbers]), (0, 1))
    table[: len(children), -1] = len(grammar.nonterminals)
    return table.numpy()


def _scene_graph(grammar: Grammar, rules: Tensor, base: Tensor, owner: Tensor, nodes: Tensor) -> tuple[Tensor, Tensor]:
    """``kind`` and ``parent``, ``(N, M)``, from the rules, the node count before each step and what each step hangs
    below."""
    N, T = rules.shape
    M = max(1, int(nodes.max())) if N else 1
    k = rules.clamp(min=0)
    objects, below = grammar.objects[k], grammar.object_owner[k]  # (N, T, J)
    exists = (objects >= 0) & (rules >= 0).unsqueeze(-1)
    parents = (base.unsqueeze(-1) + below).where(below >= 0, owner.unsqueeze(-1))
    at = (base.unsqueeze(-1) + torch.arange(objects.shape[-1])).where(exists, M).flatten(1)
    kind = torch.full((N, M + 1), -1).scatter(1, at, objects.flatten(1))
    parent = torch.full((N, M + 1), -1).scatter(1, at, parents.flatten(1))
    return kind[:, :M].contiguous(), parent[:, :M].contiguous()


def group_of(kind: Tensor, parent: Tensor, group: int) -> Tensor:
    """The node of kind ``group`` that each node is or belongs to, ``(N, M)`` int64, -1 for none.

    Args:
        kind, parent: ``(N, M)`` int64 of a derivation.
    """
    own = torch.arange(kind.shape[1]).expand_as(kind)
    found, above = torch.where(kind == group, own, -1), parent
    while ((found < 0) & (above >= 0)).any():
        at = above.clamp(min=0)
        found = torch.where((found < 0) & (above >= 0) & (kind.gather(1, at) == group), above, found)
        above = torch.where(above >= 0, parent.gather(1, at), above)
    return found
