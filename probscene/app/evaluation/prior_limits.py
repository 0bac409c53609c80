"""Where a prior is too narrow for the target, and what to change in it.

- Saturated lists: the guide gives a list's longest length a clearly larger share than prior and pretraining do. Where
  the network counts the list's elements, and longer lists in next to no image, that is the target's own longest, and
  not reported; where it counts them often, it is reported whatever the guide does.
- Unreachable counts: images with more or fewer objects than any derivation has of at most T_max rules that prior or
  pretraining hold possible, of each class by itself and of all together.

Axis letters: N scenes, L images, S sets of classes, E productions.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from probscene.branching import Branching
from probscene.derive import derive_complete
from probscene.enumeration import shortest_lengths
from probscene.errors import SamplingError
from probscene.grammar import Grammar
from probscene.lists import ListBounds, bounded_lists, element_kinds, hangs_below, is_alone, lengths, share_from
from probscene.model import SceneModel
from probscene.policy import Policy
from probscene.scenarios import JointGrammar
from probscene.structure import StructurePrior
from probscene.support import Support
from probscene.threads import threads

from ..chunks import chunk_randomness
from .sources import Source

COUNT_QUANTILE = 0.99  # of a network's counts, for which there should be room
NUM_SCENES = 2000  # of the guide
MIN_EXCESS_SHARE, MIN_EXCESS_RATIO = 0.1, 1.5  # of learnt lists at their end, to the prior's
MIN_BEYOND_SHARE = 0.05  # of learnt lists beyond the prior's longest, in addition to pretraining's
MIN_LONGER_SHARE = 0.05  # of images in which the network counts longer lists than the model allows
MIN_LONGER_SHARE_ALONE = 0.2  # the same where the guide does not fill its own
LENGTH_MARGIN = 0.1  # for the list's new length, of what the network counts
GUESSED_LENGTH_RATIO = 1.5  # of the list's new length, where the network does not count it
MORE, FEWER = "more", "fewer"
ALL = "objects in all"
MIN_IMAGE_SHARE = 0.01  # of images with unreachable counts, from which on a network's are reported
NAMED_IMAGES = 3  # in a sentence
MAX_STEPS_FACTOR = 8  # times T_max, up to which a larger one is advised
LENGTH_QUANTILE = 0.999 - 1e-6  # of a prior's derivations
MAX_LENGTH = 1000  # rules, up to which lengths are computed


@dataclass(frozen=True)
class SaturatedList:
    """A list that is too short.

    Attributes:
        name: the nonterminal, with its scenario where there are several.
        rank: of the parent list, where it is about one; None for all.
        longest: the longest length that the model allows; where lists are beyond it, that the prior allows.
        beyond_prior: whether the learnt lists are longer than the prior's longest, as pretraining allows.
        learnt: share of learnt lists of that length, or beyond it.
        declared: that of the prior, or of pretraining if larger.
        longer_images: share of images with longer lists, as the network counts; None where it cannot.
        length: the new longest length.
        remedy: the change of the model.
    """

    name: str
    rank: int | None
    longest: int
    beyond_prior: bool
    learnt: float
    declared: float
    longer_images: float | None
    length: int
    remedy: str

    @property
    def which(self) -> str:
        """The name, and the rank where it is about one."""
        return self.name if self.rank is None else f"{self.name} at rank {self.rank + 1}"

    def __str__(self) -> str:
        what = "are longer than the prior's maximum" if self.beyond_prior else "have the model's maximum length"
        text = f"{self.which}: {_percent(self.learnt)} of the learnt lists {what}, {self.longest}"
        text += f" ({_percent(self.declared)} {'in pretraining' if self.beyond_prior else 'in the prior'})"
        if self.longer_images is not None:
            text += f", and the network counts more in {_percent(self.longer_images)} of the images"
        guess = "" if self.longer_images else ", as a first try"
        return f"{text}. If the images have more, allow longer lists{guess}: {self.remedy}."

    def record(self) -> dict[str, Any]:
        """For JSON."""
        keys = {"beyond_prior": "past", "longer_images": "seen"}
        return {keys.get(name, name): value for name, value in vars(self).items()} | {"sentence": str(self)}


def saturation_warnings(found: Iterable[SaturatedList]) -> list[str]:
    """A warning for each list at its end, and one note for all those beyond the prior's longest."""
    found = list(found)
    warnings = [f"Warning: {one}" for one in found if not one.beyond_prior]
    beyond = [one for one in found if one.beyond_prior]
    if len(beyond) == 1:
        return [*warnings, f"Note: {beyond[0]}"]
    if beyond:
        lists = ", ".join(f"{one.which} up to {one.length} ({_percent(one.learnt)} are longer)" for one in beyond)
        warnings.append(
            "Note: learnt lists are longer than the prior's maximum, as pretraining allows; if images have such lists, "
            f"widen the prior: {lists}."
        )
    return warnings


def saturated_lists(model: SceneModel, guide: Policy, read: Source | None, seed: int = 0) -> tuple[SaturatedList, ...]:
    """The lists that are too short, in the grammar's order; none where nothing declares a longest.

    Args:
        read: what the network counts in the target's images, of all of the model's classes.
        seed: of the scenes that are derived.
    """
    prior, support, policy = model.prior, model.support, model.pretraining_policy
    if support is None or not isinstance(prior, StructurePrior) or not isinstance(policy, StructurePrior):
        return ()
    lists = bounded_lists(model.grammar, prior, support)
    if not lists:
        return ()
    parts = []
    try:
        with torch.no_grad(), threads(1), chunk_randomness(seed, 0):
            parts = derive_complete(model.grammar, guide, NUM_SCENES, model.max_steps)[0]
    except SamplingError:  # of a guide whose scenes hardly end nothing is known
        return ()
    processes = [Branching(model.grammar, one.table) for one in (prior, policy)]
    found = []
    for bounds in lists:
        learnt = lengths(model.grammar, parts, bounds.symbol).select(bounds, support.possible.shape[1])
        if not len(learnt):
            continue

        def declared(length: int, bounds: ListBounds = bounds) -> float:
            return max(share_from(process, bounds, length) for process in processes)

        counted = read_lengths(model, bounds, read)
        at_end, own = float((learnt >= bounds.longest).mean()), declared(bounds.longest)
        beyond = float((learnt > bounds.prior).mean())
        if bounds.longest > bounds.prior and beyond > declared(bounds.prior + 1) + MIN_BEYOND_SHARE:
            found.append(_saturated_list(model, bounds, True, (beyond, declared(bounds.prior + 1)), learnt, counted))
        else:
            one = _saturated_list(model, bounds, False, (at_end, own), learnt, counted)
            full = at_end > max(own + MIN_EXCESS_SHARE, MIN_EXCESS_RATIO * own)
            enough = MIN_LONGER_SHARE if full else MIN_LONGER_SHARE_ALONE
            if full if one.longer_images is None else one.longer_images >= enough:
                found.append(one)
    return tuple(found)


def read_lengths(model: SceneModel, bounds: ListBounds, read: Source | None) -> NDArray[np.int64] | None:
    """The lengths ``(n,)`` of a list as the network counts them in images, where each element is one object: of the one
    list of an image, or of those below each parent that has counts of its own; else None."""
    grammar = model.grammar
    numbers = [grammar.kind(name) for name in model.classes]
    kinds, more = element_kinds(grammar, bounds.symbol, numbers)
    if read is None or not kinds:
        return None
    if bounds.parent_list_index is None and is_alone(grammar, bounds.symbol, kinds):
        columns = [numbers.index(kind) for kind in kinds]
        whole = len(columns) == len(numbers)
        return ((read.total if whole else read.counts[:, columns].sum(1)) - more).clip(min=0)
    if model.groups is None or not hangs_below(grammar, bounds.symbol, grammar.kind(model.groups.kind)):
        return None
    children = [read.children.get((model.groups.kind, grammar.kinds[kind])) for kind in kinds]
    below = [found for found in children if found is not None]
    if not below or len(below) < len(children):
        return None
    of_rank = below[0].rank >= 0 if bounds.parent_list_index is None else below[0].rank == bounds.parent_list_index
    count = torch.stack([found.count for found in below]).sum(0)[of_rank]
    return (count.numpy() - more).clip(min=0)


def _saturated_list(
    model: SceneModel,
    bounds: ListBounds,
    beyond_prior: bool,
    shares: tuple[float, float],
    learnt: NDArray[np.int64],
    counted: NDArray[np.int64] | None,
) -> SaturatedList:
    end = bounds.prior if beyond_prior else bounds.longest
    longer, length = None, math.ceil(GUESSED_LENGTH_RATIO * end)
    if beyond_prior:
        length = int(np.quantile(learnt, COUNT_QUANTILE, method="higher"))
    if counted is not None and len(counted):
        longer = float((counted > end).mean())
        needed = float(np.quantile(counted, COUNT_QUANTILE, method="higher"))
        if needed > end:
            length = max(math.ceil((1 + LENGTH_MARGIN) * needed), length if beyond_prior else 0)
    length = max(length, end + 1 if beyond_prior else end + 2)
    name, remedy = qualified_name(model.grammar, bounds.symbol), more_room(model, bounds, length)
    return SaturatedList(name, bounds.parent_list_index, end, beyond_prior, *shares, longer, length, remedy)


@dataclass(frozen=True)
class UnreachableCounts:
    """Images with more, or fewer, objects than a model can generate.

    Attributes:
        what: the class, or ``ALL``.
        side: ``MORE`` or ``FEWER``.
        limit: the most, or the fewest.
        of: number of images, with those that have no such count.
        rows: which ones, in the order of the source.
        names: their files, where they are known.
        labelled: whether labels say so, or the network's counts.
        remedy: what to change.
    """

    what: str
    side: str
    limit: int
    of: int
    rows: tuple[int, ...]
    names: tuple[str, ...]
    labelled: bool
    remedy: str = ""

    def __str__(self) -> str:
        who = f"{len(self.rows)} of {self.of} images" + ("" if self.labelled else ", by the network's counts,")
        show = "show" if len(self.rows) != 1 or self.of != 1 else "shows"
        extreme = "maximum" if self.side == MORE else "minimum"
        text = f"{who} {show} {self.side} than {self.limit} {self.what}, the model's {extreme}"
        files = ", ".join(self.names[:NAMED_IMAGES]) + (", ..." if len(self.names) > NAMED_IMAGES else "")
        return f"{text}{f' ({files})' if files else ''}. To allow that: {self.remedy}."

    def record(self) -> dict[str, Any]:
        """For JSON."""
        return {**vars(self), "images": len(self.rows), "sentence": str(self)}


def unreachable_counts(
    model: SceneModel,
    source: Source,
    classes: Sequence[str],
    labelled: bool,
    names: Sequence[str] = (),
    visible: bool = False,
) -> tuple[UnreachableCounts, ...]:
    """The counts of a source's images that the model cannot generate.

    Args:
        source: their numbers of ``classes``, C of the model's.
        labelled: whether they are labels, or what a network counts.
        names: of the images' files.
        visible: whether only visible objects are counted, so that a scene may have more.
    """
    sets = _Sets(model, classes)
    numbers = source.counts if len(classes) < 2 else np.column_stack([source.counts, source.total])
    process, unreachable = sets.process(sets.support), np.zeros(len(numbers), bool)
    cases: list[tuple[UnreachableCounts, str | _Room]] = []
    for s, what in enumerate([*classes, ALL][: len(sets.kinds)]):
        for side in (MORE,) if visible else (MORE, FEWER):
            sign = 1 if side == MORE else -1
            limit = sign * process.max_totals(sign * sets.objects(process, s), model.max_steps)[-1]
            if not np.isfinite(limit):
                continue
            number = numbers[:, s]
            rows = (sign * number > sign * limit) & ((s < len(classes)) | ~unreachable)
            if rows.sum() > (0 if labelled else MIN_IMAGE_SHARE * len(rows)):
                which = np.flatnonzero(rows).tolist()
                files = tuple(names[i] for i in which) if names else ()
                case = UnreachableCounts(what, side, int(limit), len(rows), tuple(which), files, labelled)
                cases.append((case, sets.remedy(s, sign, _needed(number, sign, int(limit), labelled))))
            unreachable |= rows
    rooms = [remedy for _, remedy in cases if isinstance(remedy, _Room)]
    return tuple(replace(case, remedy=sets.describe(remedy, rooms)) for case, remedy in cases)


def _needed(number: NDArray[np.int64], sign: int, limit: int, labelled: bool) -> int:
    """The count that the model should be able to generate."""
    if labelled:
        return int(number.max() if sign > 0 else number.min())
    quantile = COUNT_QUANTILE if sign > 0 else 1 - COUNT_QUANTILE  # a few counts may be wrong by far
    near = int(np.quantile(number, quantile, method="nearest"))
    return max(limit + 1, near) if sign > 0 else min(limit - 1, near)


class _Room(NamedTuple):
    """A list that is to have other lengths."""

    bounds: ListBounds
    shortest: int
    longest: int


class _Sets:
    """Each class, and all classes together, whose objects a model's derivations are asked for."""

    def __init__(self, model: SceneModel, classes: Sequence[str]):
        grammar = model.grammar
        self.model, self.grammar = model, grammar
        self.support = model.support or Support(grammar, grammar.legal[:, None, None])
        prior = model.prior if model.support is not None else None
        self.lists = bounded_lists(grammar, prior, self.support) if isinstance(prior, StructurePrior) else []
        kinds = [[grammar.kind(name)] for name in classes]
        self.kinds = kinds if len(kinds) < 2 else [*kinds, [kind for of_class in kinds for kind in of_class]]

    def process(self, support: Support) -> Branching:
        return Branching(self.grammar, support.uniform_table())

    def objects(self, process: Branching, s: int) -> NDArray[np.int64]:
        """``(E,)`` objects of set s that each production adds."""
        return np.isin(self.grammar.objects.numpy()[process.rule], self.kinds[s]).sum(1)

    def remedy(self, s: int, sign: int, needed: int) -> "str | _Room":
        """What would make the count possible, as the first of these does: T_max, one list, one nonterminal, the prior,
        the grammar.

        Args:
            s: number of the set.
            sign: 1 for more objects, -1 for fewer.
            needed: the count.
        """
        grammar, model = self.grammar, self.model

        def allows(support: Support) -> bool:
            process = self.process(support)
            return process.max_total(sign * self.objects(process, s)) >= sign * needed

        if allows(self.support):
            process, steps = self.process(self.support), MAX_STEPS_FACTOR * model.max_steps
            enough = process.max_totals(sign * self.objects(process, s), steps) >= sign * needed
            return f"max_steps={int(enough.argmax()) if enough.any() else steps}"
        every = [kind for kinds in self.kinds for kind in kinds]
        direct = [
            bounds for bounds in self.lists if set(self.kinds[s]) & set(element_kinds(grammar, bounds.symbol, every)[0])
        ]
        for bounds in (*direct, *(bounds for bounds in self.lists if bounds not in direct)):
            if sign > 0:
                longest = self.shortest_end(allows, bounds, needed)
                if longest is not None:
                    return _Room(bounds, bounds.shortest, longest)
            elif allows(self.support.widened(bounds.symbol)):
                kinds, more = element_kinds(grammar, bounds.symbol, self.kinds[s])
                return _Room(bounds, max(0, needed - more) if kinds else 0, bounds.prior)
        for v in range(len(grammar.nonterminals)):
            if allows(self.support.widened(v)) and (rules := self.impossible_rules(v)):
                return f"give {qualified_name(grammar, v)} a weight above 0 for {rules} in the prior"
        if allows(Support(grammar, grammar.legal[:, None, None])):
            symbols = [qualified_name(grammar, v) for v in range(len(grammar.nonterminals)) if self.impossible_rules(v)]
            return f"widen the prior of several nonterminals: {', '.join(symbols)}"
        kind = grammar.kinds[self.kinds[s][0]]
        if len(self.kinds[s]) > 1 or sign > 0:
            name = kind[:1].upper() + kind[1:]
            return f"make it a list in the grammar, such as {name}s -> {kind} {name}s | ε"
        alone = sorted({str(rule) for rule in grammar.rules if kind in dict(rule.flatten()[0])})
        return f"let the grammar leave it out, such as by ε beside '{alone[0]}'"

    def shortest_end(self, allows: Callable[[Support], bool], bounds: ListBounds, needed: int) -> int | None:
        """The shortest end of a list that is enough, at most as many elements more as are needed."""
        low, high = bounds.longest, bounds.longest + needed

        def enough(longest: int) -> bool:
            return allows(self.support.widened(bounds.symbol, longest, bounds.parent_list_index))

        if not enough(high):
            return None
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (low, middle) if enough(middle) else (middle, high)
        return high

    def impossible_rules(self, symbol: int) -> str:
        """The productions of a nonterminal that are possible nowhere, in words."""
        nowhere = self.grammar.legal[symbol] & ~self.support.possible[symbol].any(0).any(0)
        return " and ".join(f"'{self.grammar.rules[k]}'" for k in nowhere.nonzero().flatten().tolist())

    def describe(self, remedy: "str | _Room", rooms: "list[_Room]") -> str:
        """A remedy in words; a list gets as much room as all of the remedies give it."""
        if isinstance(remedy, str):
            return remedy
        same = [room for room in rooms if room.bounds == remedy.bounds]
        longest = max(room.longest for room in same)
        return more_room(self.model, remedy.bounds, longest, min(room.shortest for room in same))


def qualified_name(grammar: Grammar, symbol: int) -> str:
    """A nonterminal as its model writes it; with its scenario, where there are several."""
    name = grammar.nonterminals[symbol]
    if isinstance(grammar, JointGrammar) and symbol:
        number = sum(first <= symbol for first in grammar.first_symbol) - 1
        scenario = list(grammar.parts)[number]
        return f"{name.removesuffix(f'-{scenario}')} of scenario {scenario!r}"
    return name


def more_room(model: SceneModel, bounds: ListBounds, longest: int, shortest: int | None = None) -> str:
    """The change of the prior's line for a list up to ``longest``, and of T_max where that is too short for it.

    Args:
        shortest: where it is to be less than the prior's.
    """
    shortest = bounds.shortest if shortest is None else min(shortest, bounds.shortest)
    name, _, scenario = qualified_name(model.grammar, bounds.symbol).partition(" of ")
    zeros = f"*[0] * {shortest}, " if shortest else ""
    line = f"counts({zeros}*[1] * {longest - shortest + 1})"
    where = f" in {scenario}" if scenario else ""
    if bounds.parent_list_index is not None:
        rank = bounds.parent_list_index + 1
        text = f"{name}=ranked(...){where} with counts(...) up to {longest} at rank {rank}, such as {line}"
    else:
        lower = f" from {shortest}" if shortest < bounds.shortest else ""
        text = f"{name}=counts(...){where}{lower} up to {longest}, such as {name}={line}"
    steps = steps_for(model, bounds, longest)
    return text + (f", and max_steps={steps}" if steps > model.max_steps else "")


def steps_for(model: SceneModel, bounds: ListBounds, longest: int) -> int:
    """The T_max that leaves a longer list as much room as the prior's longest has now."""
    grammar, prior = model.grammar, model.prior
    now = _longest_length(grammar, prior, model.max_steps) if isinstance(prior, StructurePrior) else 0
    fewest = shortest_lengths(grammar)
    per_element = [
        1 + sum(fewest[v] for v in row if v >= 0 and v != bounds.symbol)
        for row in grammar.children[grammar.legal[bounds.symbol]].tolist()
        if bounds.symbol in row
    ]
    return now + max(per_element) * max(0, longest - bounds.prior)


@lru_cache(maxsize=4)
def _longest_length(grammar: Grammar, prior: StructurePrior, max_steps: int) -> int:
    """The length that nearly all of a prior's derivations do not exceed."""
    process = Branching(grammar, prior.table)
    known = process.lengths(max_steps, LENGTH_QUANTILE, MAX_LENGTH if process.spectral_radius < 1 else 0)
    enough = (known.cumsum() >= LENGTH_QUANTILE).nonzero()[0]
    return int(enough[0]) if len(enough) else len(known) - 1


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %"
