"""Which real images a model cannot have, by their numbers of objects, and what to change in it.

A number is out of reach where no derivation of at most T_max rules that prior or pretraining hold possible has it; with
labels, so are numbers that only cannot go together. Axis letters: L images, C classes, S sets of classes.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from probscene.lists import ListBounds, bounded_lists, element_kinds
from probscene.model import SceneModel
from probscene.reach import Reach
from probscene.structure import StructurePrior
from probscene.support import Support

from .list_advice import called, more_room, steps_for
from .sources import Source

MORE, FEWER, TOGETHER = "more", "fewer", "together"
SEEN = 0.01  # share of images from which on what a network counts is said
WANTED = 0.99  # quantile of what it counts, for which there should be room
LOOKED = 200  # different sets of numbers at most of which it is asked whether they go together
NAMED = 3  # images in a sentence
ALL = "objects in all"


@dataclass(frozen=True)
class UnreachableCounts:
    """Images whose numbers a model cannot have for one reason.

    Attributes:
        what: the class, or ``ALL``; in words the numbers of one of the images, where they only cannot go together.
        side: ``MORE`` than the most, ``FEWER`` than the fewest, or ``TOGETHER``.
        limit: the most, or the fewest; None of numbers together.
        images: how many there are of them, of ``of``.
        rows: which ones, in the order of the source.
        names: their files, where they are known.
        labelled: whether labels say so, or the network's counts.
        remedy: what to change.
    """

    what: str
    side: str
    limit: int | None
    of: int
    rows: tuple[int, ...]
    names: tuple[str, ...]
    labelled: bool
    remedy: str

    @property
    def images(self) -> int:
        return len(self.rows)

    def __str__(self) -> str:
        who = f"{self.images} of {self.of} images" + ("" if self.labelled else ", as the network counts,")
        show = "show" if self.images != 1 or self.of != 1 else "shows"
        if self.side == TOGETHER:
            text = f"{who} {show} numbers of objects that no scene of the model has together, such as {self.what}"
        elif self.side == MORE:
            text = f"{who} {show} more than {self.limit} {self.what}, the most that the model can have"
        else:
            text = f"{who} {show} fewer than {self.limit} {self.what}, the fewest that the model can have"
        some = ", ".join(self.names[:NAMED]) + (", ..." if len(self.names) > NAMED else "")
        return f"{text}{f' ({some})' if some else ''}. To allow it: {self.remedy}."

    def record(self) -> dict[str, Any]:
        """For JSON."""
        return {**vars(self), "images": self.images, "sentence": str(self)}


def unreachable_counts(
    model: SceneModel,
    source: Source,
    classes: Sequence[str],
    labelled: bool,
    names: Sequence[str] = (),
    visible: bool = False,
) -> tuple[UnreachableCounts, ...]:
    """What the model cannot have of the images of a source.

    Args:
        source: their numbers of ``classes``, C of the model's.
        labelled: whether they are labels, or what a network counts.
        names: of the images' files.
        visible: whether only objects that can be seen are counted, so that a scene may have more.
    """
    return _Walls(model, source, classes, labelled, names, visible).found()


class _Room(NamedTuple):
    """A list that is to have other lengths, and the fewest rules of a scene that needs it."""

    bounds: ListBounds
    shortest: int
    longest: int
    rules: int = 0


class _Walls:
    """One source's numbers ``(L, S)`` against the model: each class, and all classes together."""

    def __init__(self, model: SceneModel, source: Source, classes, labelled: bool, names, visible: bool):
        grammar = model.grammar
        self.model, self.grammar, self.classes, self.labelled = model, grammar, list(classes), labelled
        self.names, self.visible = list(names), visible
        self.support = model.support or Support(grammar, grammar.legal[:, None, None])
        prior = model.prior if model.support is not None else None
        self.lists = bounded_lists(grammar, prior, self.support) if isinstance(prior, StructurePrior) else []
        kinds = [[grammar.kind(name)] for name in classes]
        self.kinds = kinds if len(kinds) < 2 else [*kinds, [kind for each in kinds for kind in each]]
        self.numbers = source.counts if len(kinds) < 2 else np.column_stack([source.counts, source.total])

    def reach(self, support: Support, max_steps: int | None = None) -> Reach:
        return Reach(self.grammar, support, max_steps, self.kinds)

    def found(self) -> tuple[UnreachableCounts, ...]:
        reach, bad = self.reach(self.support, self.model.max_steps), np.zeros(len(self.numbers), bool)
        cases: list[tuple[UnreachableCounts, str | _Room]] = []
        for s, what in enumerate([*self.classes, ALL][: len(self.kinds)]):
            number, own = self.numbers[:, s], s < len(self.classes)
            for side in (MORE, FEWER):
                if side == FEWER and self.visible:
                    continue
                limit = reach.most(s) if side == MORE else reach.least(s)
                if not np.isfinite(limit):
                    continue
                rows = (number > limit if side == MORE else number < limit) & (own | ~bad)
                if rows.sum() > (0 if self.labelled else SEEN * len(rows)):
                    case = self.finding(what, side, int(limit), rows)
                    cases.append((case, self.remedy(s, side, int(limit))))
                bad |= rows
        rooms = [remedy for _, remedy in cases if isinstance(remedy, _Room)]
        out = [replace(case, remedy=self.said(remedy, rooms)) for case, remedy in cases]
        if self.labelled and len(self.classes) > 1:
            out += self.together(reach, ~bad)
        return tuple(out)

    def finding(
        self, what: str, side: str, limit: int | None, rows: NDArray[np.bool_], remedy: str = ""
    ) -> UnreachableCounts:
        which = np.flatnonzero(rows).tolist()
        names = tuple(self.names[i] for i in which) if self.names else ()
        return UnreachableCounts(what, side, limit, len(rows), tuple(which), names, self.labelled, remedy)

    def said(self, remedy: "str | _Room", rooms: "list[_Room]") -> str:
        """A remedy in words; a list gets as much room as all of the remedies give it."""
        if isinstance(remedy, str):
            return remedy
        same = [room for room in rooms if room.bounds == remedy.bounds]
        longest, rules = max(room.longest for room in same), max(room.rules for room in same)
        text = more_room(self.model, remedy.bounds, longest, min(room.shortest for room in same))
        enough = max(self.model.max_steps, steps_for(self.model, remedy.bounds, longest))
        return text + (f", and max_steps={rules}" if rules > enough else "")

    def remedy(self, s: int, side: str, limit: int) -> "str | _Room":
        """What would let all these images be, as the first of these does: T_max, one list, one nonterminal, the prior,
        the grammar."""
        number = self.numbers[:, s]
        need = int(number.max() if side == MORE else number.min())
        if not self.labelled:  # a few of its counts may be wrong by far
            share = WANTED if side == MORE else 1 - WANTED
            near = int(np.quantile(number, share, method="nearest"))
            need = max(limit + 1, near) if side == MORE else min(limit - 1, near)
        wanted = np.full(len(self.kinds), -1)
        wanted[s] = need

        def lets(support: Support) -> bool:
            reach = self.reach(support)
            return reach.most(s) >= need if side == MORE else reach.least(s) <= need

        if lets(self.support):
            return f"max_steps={int(self.reach(self.support).fewest_rules(wanted, side == MORE))}"
        grammar = self.grammar
        direct = [b for b in self.lists if set(self.kinds[s]) & set(self.of_elements(b))]
        for bounds in (*direct, *(b for b in self.lists if b not in direct)):
            if side == MORE:
                longest = self.shortest_that(lets, bounds, need)
                if longest is not None:
                    reach = self.reach(self.support.widened(bounds.symbol, longest, bounds.parent_list_index))
                    return _Room(bounds, bounds.shortest, longest, int(reach.fewest_rules(wanted, True)))
            elif lets(self.support.widened(bounds.symbol)):
                kinds, more = element_kinds(grammar, bounds.symbol, self.kinds[s])
                return _Room(bounds, max(0, need - more) if kinds else 0, bounds.prior)
        for v in range(len(grammar.nonterminals)):
            if lets(self.support.widened(v)) and (never := self.never(v)):
                return f"give {called(grammar, v)} a weight above 0 for {never} in the prior"
        if lets(Support(grammar, grammar.legal[:, None, None])):
            some = [called(grammar, v) for v in range(len(grammar.nonterminals)) if self.never(v)]
            return f"widen the prior in more than one place, of {', '.join(some)}"
        kind = grammar.kinds[self.kinds[s][0]]
        if len(self.kinds[s]) > 1 or side == MORE:
            name = kind[:1].upper() + kind[1:]
            return f"make a list of it in the grammar, such as {name}s -> {kind} {name}s | ε, where it stands alone now"
        alone = sorted({str(rule) for rule in grammar.rules if kind in dict(rule.flatten()[0])})
        return f"give the grammar a way to do without it, such as ε beside '{alone[0]}'"

    def shortest_that(self, lets, bounds: ListBounds, need: int) -> int | None:
        """The shortest end of a list that is enough, at most as many elements more as are needed."""
        low, high = bounds.longest, bounds.longest + need

        def enough(longest: int) -> bool:
            return lets(self.support.widened(bounds.symbol, longest, bounds.parent_list_index))

        if not enough(high):
            return None
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (low, middle) if enough(middle) else (middle, high)
        return high

    def of_elements(self, bounds: ListBounds) -> tuple[int, ...]:
        return element_kinds(self.grammar, bounds.symbol, [kind for each in self.kinds for kind in each])[0]

    def never(self, symbol: int) -> str:
        """The productions of a nonterminal that are possible nowhere, in words."""
        nowhere = self.grammar.legal[symbol] & ~self.support.possible[symbol].any(0).any(0)
        return " and ".join(f"'{self.grammar.rules[k]}'" for k in nowhere.nonzero().flatten().tolist())

    def together(self, reach: Reach, rows: NDArray[np.bool_]) -> list[UnreachableCounts]:
        """Of the images that no one number keeps out, those that their numbers together do."""
        counts = np.column_stack([self.numbers[:, : len(self.classes)], np.full(len(rows), -1)])
        different, which = np.unique(counts[rows], axis=0, return_inverse=True)
        out = [not np.isfinite(reach.fewest_rules(each, self.visible)) for each in different[:LOOKED]]
        out = np.array([*out, *[False] * max(0, len(different) - LOOKED)], bool)
        if not out.any():
            return []
        bad = np.zeros(len(rows), bool)
        bad[np.flatnonzero(rows)[out[which.ravel()]]] = True
        first = different[out][0]
        what = ", ".join(f"{n} {name}" for n, name in zip(first, self.classes, strict=False))
        return [self.finding(what, TOGETHER, None, bad, self.remedy_together(different[out]))]

    def remedy_together(self, wanted: NDArray[np.int64]) -> str:
        grammar = self.grammar

        def fewest(support: Support) -> float:
            reach = self.reach(support)
            return max(reach.fewest_rules(each, self.visible) for each in wanted)

        def steps(rules: float) -> str:
            return f", and max_steps={int(rules)}" if rules > self.model.max_steps else ""

        if np.isfinite(rules := fewest(self.support)):
            return f"max_steps={int(rules)}"
        for v in range(len(grammar.nonterminals)):
            if np.isfinite(rules := fewest(self.support.widened(v))):
                return f"give the prior more room at {called(grammar, v)}{steps(rules)}"
        if np.isfinite(rules := fewest(Support(grammar, grammar.legal[:, None, None]))):
            return f"widen the prior in more than one place{steps(rules)}"
        return "productions of the grammar that make these objects independently of each other"
