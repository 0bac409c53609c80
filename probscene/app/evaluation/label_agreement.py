"""Was the verdict right? With labels, of a few images or all, learnt structures are compared with the true ones.

What is compared are histograms: of the number of objects, of each class, and, where kinds nest and whole structures are
known, of the children of the first, second, ... node. Their total variation stands beside its floor, that of two
samples of the labels' own histogram. Axis letters: N structures, L labelled images, K bins.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from probscene.inference.statistics.residual import Grade
from probscene.inference.statistics.two_sample import JUDGED
from probscene.inference.statistics.verdict import Verdict

from .sources import Source

RESAMPLES = 400
RANKS = 6
DISAGREE = "not good by the labels"


class Compared(NamedTuple):
    """One histogram.

    Attributes:
        distance: total variation between all learnt structures and all labels.
        seen: between ``judged`` of each side, mean over resamples.
        floor, high: between as many and as many of the labels, mean and the limit that chance keeps below with 97.5 %
            in all histograms at once.
    """

    distance: float
    seen: float
    floor: float
    high: float

    @property
    def close(self) -> bool:
        return bool(self.seen <= self.high)


class Agreement(NamedTuple):
    """Learnt structures beside labels, by the histogram's name.

    Attributes:
        judged: how many of each side the comparison sees.
        labelled: how many images have labels.
        remedy: what to do where a class is read wrongly, in words that follow others.
    """

    each: dict[str, Compared]
    judged: int
    labelled: int
    remedy: str

    @property
    def close(self) -> bool:
        """Whether the labels take what was learnt for the truth."""
        return all(found.close for found in self.each.values())

    @property
    def worst(self) -> str:
        return max(self.each, key=lambda name: self.each[name].seen / max(self.each[name].high, 1e-9))

    def agrees(self, verdict: Verdict) -> bool:
        """Whether the labels say of the structures what the verdict says of the features."""
        return self.close == (verdict is Verdict.GOOD)

    @property
    def wrong(self) -> tuple[str, ...]:
        """The histograms that are farther from the labels' than chance leaves."""
        return tuple(name for name, found in self.each.items() if not found.close)

    def sentence(self, verdict: Verdict) -> str:
        """In words, with the figures of the worst histogram."""
        figures = self._figures
        if self.agrees(verdict):
            which = "as near to the labels as labels are to one another" if self.close else "far from the labels"
            return f"The labels agree: learnt structures are {which} ({figures})."
        if self.close:
            return (
                f"The labels disagree: learnt structures are right ({figures}), so it is the features of the images "
                "that differ."
            )
        return f"{self._disagreement} {self._what_to_do}"

    @property
    def _figures(self) -> str:
        """Of the worst histogram."""
        found = self.each[self.worst]
        return (
            f"{self.worst}: total variation {found.distance:.3f}; seen on {self.judged} of each, {found.seen:.3f}, by "
            f"chance {found.floor:.3f} and up to {found.high:.3f}"
        )

    @property
    def _disagreement(self) -> str:
        return f"The labels disagree: features match and structures do not ({self._figures})."

    @property
    def _what_to_do(self) -> str:
        return f"Wrongly read in the images: {', '.join(self.wrong)}. {self.remedy[:1].upper()}{self.remedy[1:]}."

    def corrected(self, verdict: dict[str, Any]) -> dict[str, Any]:
        """A verdict on parts and classes, for JSON, in which nothing is good that the labels disagree with."""
        if self.close:
            return verdict
        words = verdict["classes"]
        wrong = {name for name in words if name in self.wrong and words[name]["counts"] == Grade.GOOD}
        found = verdict | {"classes": {n: w | ({"counts": DISAGREE} if n in wrong else {}) for n, w in words.items()}}
        structure = verdict["parts"]["structure"]
        if structure["word"] != Grade.GOOD:
            return found
        said = {"verdict": DISAGREE, "because": self._disagreement, "remedy": self._what_to_do}
        overall = str(Grade.BETTER) if verdict["overall"] == Grade.GOOD else verdict["overall"]
        parts = verdict["parts"] | {"structure": structure | {"word": str(Grade.BETTER)} | said}
        return found | said | {"overall": overall, "parts": parts}

    def record(self, verdict: Verdict) -> dict[str, Any]:
        """For JSON."""
        return {
            "agree": self.agrees(verdict),
            "because": self.sentence(verdict),
            "images": self.labelled,
            "judged": self.judged,
            "each": {name: found._asdict() | {"close": found.close} for name, found in self.each.items()},
        }


def agreement(learnt: Source, truth: Source, classes: tuple[str, ...], remedy: str, seed: int = 0) -> Agreement:
    """Compare.

    Args:
        learnt: structures of the guide.
        truth: the labels.
        classes: the C names.
        remedy: see ``Agreement``.
    """
    rng = np.random.default_rng(seed)
    one, other = _columns(learnt, classes), _columns(truth, classes)
    judged = min(JUDGED, max(1, len(truth.total) // 2))
    names = [name for name in other if name in one]
    found = {name: _resampled(one[name], other[name], judged, rng) for name in names}
    scale = {name: max(floor.mean(), 1 / judged) for name, (_, _, floor) in found.items()}
    largest = np.max([floor / scale[name] for name, (_, _, floor) in found.items()], 0)
    limit = float(np.quantile(largest, 0.975))
    each = {
        name: Compared(float(distance), float(seen.mean()), float(floor.mean()), limit * scale[name])
        for name, (distance, seen, floor) in found.items()
    }
    return Agreement(each, judged, len(truth.total), remedy)


def _columns(source: Source, classes: tuple[str, ...]) -> dict[str, NDArray[np.int64]]:
    """Whole numbers of every scene, by name; -1 where it has no such node."""
    columns = {"number of objects": source.total} | dict(zip(classes, source.counts.T, strict=True))
    for (parent, child), found in source.children.items():
        scene, rank, count = (x.numpy() for x in found)
        for i in range(RANKS):
            column = np.full(len(source.total), -1)
            # Below several parents there are several nodes of a rank: the last one's count stands for them.
            column[scene[rank == i]] = count[rank == i]
            columns[f"{child} of {parent} {i + 1}"] = column
    return columns


def _resampled(one: NDArray[np.int64], other: NDArray[np.int64], judged: int, rng: np.random.Generator):
    """Total variation of all, and of resamples: between the sides, and within ``other``."""
    low, bins = min(one.min(), other.min()), max(one.max(), other.max()) + 1
    p, q = (np.bincount(side - low, minlength=bins - low) / len(side) for side in (one, other))
    a, b, c = (rng.multinomial(judged, share, RESAMPLES) / judged for share in (p, q, q))
    return (np.abs(p - q).sum() / 2, np.abs(a - b).sum(1) / 2, np.abs(c - b).sum(1) / 2)
