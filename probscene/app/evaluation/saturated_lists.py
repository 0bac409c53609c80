"""Lists that a fit has filled up to their end, or beyond what the prior has: the prior is too short for the target.

A list piles up where the guide gives its longest clearly more than prior and pretraining do. Where the network counts
what its elements are, and sees longer ones in next to no image, that is the target's own longest, and nothing is said;
where it sees them often, something is said whatever the guide does.

Axis letters: N scenes, L images.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from probscene.branching import Branching
from probscene.derive import derive_complete
from probscene.errors import SamplingError
from probscene.lists import ListBounds, bounded_lists, element_kinds, hangs_below, is_alone, lengths, share_from
from probscene.model import SceneModel
from probscene.policy import Policy
from probscene.structure import StructurePrior
from probscene.threads import threads

from ..chunks import chunk_randomness
from .list_advice import called, more_room
from .sources import Source

SCENES = 2000  # of the guide
CLEARLY = 0.1  # share of lists that the guide has at the end beyond the prior's, and half as much again
BEYOND = 0.05  # share of lists beyond the prior's longest, in addition to that of pretraining
SEEN = 0.05  # share of images in which the network sees longer lists
OFTEN = 0.2  # the same where the guide does not fill its own, as one that cannot count
WANTED = 0.99  # quantile of the lengths that it sees
MARGIN = 0.1  # of that, for the list's new length
FIRST_TRY = 1.5  # times the list's length, where nothing is seen of it


@dataclass(frozen=True)
class SaturatedList:
    """A list that is too short.

    Attributes:
        name: the nonterminal, with its scenario where there are several.
        rank: of the list around, which alone it is about; None for all.
        longest: the end that it is filled up to, or that it has passed.
        past: whether the learnt lists are longer than the prior's longest, as pretraining allows.
        learnt: share of learnt lists that are there.
        declared: that of the prior, or of pretraining if larger.
        seen: share of images with longer lists, as the network counts; None where it cannot.
        length: what to give it.
        remedy: the change of the model.
    """

    name: str
    rank: int | None
    longest: int
    past: bool
    learnt: float
    declared: float
    seen: float | None
    length: int
    remedy: str

    @property
    def which(self) -> str:
        """The name, and the rank where it is about one."""
        return self.name if self.rank is None else f"{self.name} at rank {self.rank + 1}"

    def __str__(self) -> str:
        what = "are longer than" if self.past else "have length"
        end = "the prior's longest" if self.past else "the longest that the model allows"
        text = f"{self.which}: {_percent(self.learnt)} of the learnt lists {what} {self.longest}, {end}"
        text += f" ({_percent(self.declared)} {'in pretraining' if self.past else 'in the prior'})"
        if self.seen is not None:
            text += f", and the network counts more in {_percent(self.seen)} of the images"
        guess = "" if self.seen else " as a first try"
        return f"{text}. Where the images have more, give it room{guess}: {self.remedy}."

    def record(self) -> dict[str, Any]:
        """For JSON."""
        return {**vars(self), "sentence": str(self)}


def sentences(found: Iterable[SaturatedList]) -> list[str]:
    """What to say of them: a warning for each list at its end, and one note for all those that are past the prior's."""
    found = list(found)
    out = [f"Warning: {each}" for each in found if not each.past]
    past = [f"{each.which} up to {each.length} ({_percent(each.learnt)} are longer)" for each in found if each.past]
    if len(past) == 1:
        return [*out, *(f"Note: {each}" for each in found if each.past)]
    if past:
        out.append(
            "Note: learnt lists are longer than the prior's longest, as pretraining allows; if images have such, the "
            f"prior should, too: {', '.join(past)}."
        )
    return out


def saturated_lists(model: SceneModel, guide: Policy, read: Source | None, seed: int = 0) -> tuple[SaturatedList, ...]:
    """The lists that are too short, in the grammar's order; none where nothing declares a longest.

    Args:
        read: what the network counts in the target's images, of all of the model's classes.
        seed: of the scenes that are derived.
    """
    prior, support, policy = model.prior, model.support, model.pretraining_policy
    if support is None or not isinstance(prior, StructurePrior) or not isinstance(policy, StructurePrior):
        return ()
    every = bounded_lists(model.grammar, prior, support)
    if not every:
        return ()
    parts = []
    try:
        with torch.no_grad(), threads(1), chunk_randomness(seed, 0):
            parts = derive_complete(model.grammar, guide, SCENES, model.max_steps)[0]
    except SamplingError:  # a guide whose scenes hardly end says nothing of its lists
        return ()
    before = [Branching(model.grammar, one.table) for one in (prior, policy)]
    found = []
    for bounds in every:
        learnt = lengths(model.grammar, parts, bounds.symbol).select(bounds, support.possible.shape[1])
        if not len(learnt):
            continue

        def declared(length: int, bounds: ListBounds = bounds) -> float:
            return max(share_from(process, bounds, length) for process in before)

        seen = read_lengths(model, bounds, read)
        at, own = float((learnt >= bounds.longest).mean()), declared(bounds.longest)
        past = float((learnt > bounds.prior).mean())
        if bounds.longest > bounds.prior and past > declared(bounds.prior + 1) + BEYOND:
            found.append(_piled(model, bounds, True, past, declared(bounds.prior + 1), learnt, seen))
        else:
            one = _piled(model, bounds, False, at, own, learnt, seen)
            full = at > max(own + CLEARLY, 1.5 * own)
            if full if one.seen is None else one.seen >= (SEEN if full else OFTEN):
                found.append(one)
    return tuple(found)


def read_lengths(model: SceneModel, bounds: ListBounds, read: Source | None) -> NDArray[np.int64] | None:
    """The lengths ``(n,)`` of a list as they are seen in images, where each element is one object: of the one list of
    an image, or of those below each parent that has counts of its own; else None."""
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
    each = [read.children.get((model.groups.kind, grammar.kinds[kind])) for kind in kinds]
    below = [found for found in each if found is not None]
    if not below or len(below) < len(each):
        return None
    of_rank = below[0].rank >= 0 if bounds.parent_list_index is None else below[0].rank == bounds.parent_list_index
    count = torch.stack([found.count for found in below]).sum(0)[of_rank]
    return (count.numpy() - more).clip(min=0)


def _piled(
    model: SceneModel,
    bounds: ListBounds,
    past: bool,
    share: float,
    declared: float,
    learnt: NDArray[np.int64],
    seen: NDArray[np.int64] | None,
) -> SaturatedList:
    end = bounds.prior if past else bounds.longest
    beyond, length = None, math.ceil(FIRST_TRY * end)
    if past:
        length = int(np.quantile(learnt, WANTED, method="higher"))
    if seen is not None and len(seen):
        beyond = float((seen > end).mean())
        wanted = float(np.quantile(seen, WANTED, method="higher"))
        if wanted > end:
            length = max(math.ceil((1 + MARGIN) * wanted), length if past else 0)
    length = max(length, end + 1 if past else end + 2)
    name = called(model.grammar, bounds.symbol)
    return SaturatedList(
        name, bounds.parent_list_index, end, past, share, declared, beyond, length, more_room(model, bounds, length)
    )


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %"
