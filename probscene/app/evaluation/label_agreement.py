"""Whether labels, of a few images or all, confirm a verdict: learnt structures are compared with the true ones.

Histograms are compared: of the number of objects, of each class, and, where kinds nest and whole structures are known,
of the children of the first, second, ... node. The noise floor of their total variation is that of two samples of the
labels' own histogram. Axis letters: N structures, L labelled images, K bins.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from probscene.inference.statistics.count_metrics import total_variation
from probscene.inference.statistics.energy import MAX_SPLIT_SIZE
from probscene.inference.statistics.residual import Grade
from probscene.inference.statistics.verdict import Verdict

from .sources import Source

RESAMPLES = 400
MAX_RANKS = 6
DISAGREE = "not good by the labels"


class HistogramComparison(NamedTuple):
    """One histogram.

    Attributes:
        distance: total variation between all learnt structures and all labels.
        resampled: between ``sample_size`` of each side, mean over resamples.
        floor, high: between two samples of the labels of that size, mean and the 97.5 % limit for all histograms at
            once.
    """

    distance: float
    resampled: float
    floor: float
    high: float

    @property
    def close(self) -> bool:
        return bool(self.resampled <= self.high)


class Agreement(NamedTuple):
    """Learnt structures compared with labels.

    Attributes:
        histograms: by name.
        sample_size: of each side of a resample.
        labelled: number of images with labels.
        remedy: what to do where a class is read wrongly, in words that follow others.
    """

    histograms: dict[str, HistogramComparison]
    sample_size: int
    labelled: int
    remedy: str

    @property
    def close(self) -> bool:
        """Whether every histogram is within its noise floor."""
        return all(found.close for found in self.histograms.values())

    @property
    def worst(self) -> str:
        return max(self.histograms, key=lambda name: _excess(self.histograms[name]))

    def agrees(self, verdict: Verdict) -> bool:
        """Whether the labels say of the structures what the verdict says of the features."""
        return self.close == (verdict is Verdict.GOOD)

    @property
    def wrong(self) -> tuple[str, ...]:
        """The histograms that are farther from the labels' than chance leaves."""
        return tuple(name for name, found in self.histograms.items() if not found.close)

    def sentence(self, verdict: Verdict) -> str:
        """In words, with the figures of the worst histogram."""
        figures = self._figures
        if self.agrees(verdict):
            which = "within the noise floor of the labels" if self.close else "above the noise floor"
            return f"The labels agree: learnt structures are {which} ({figures})."
        if self.close:
            return (
                f"The labels disagree: learnt structures are right ({figures}), so only the features of the images "
                "differ."
            )
        return f"{self._disagreement} {self._full_remedy}"

    @property
    def _figures(self) -> str:
        """Of the worst histogram."""
        found = self.histograms[self.worst]
        return (
            f"{self.worst}: total variation {found.distance:.3f}; of samples of {self.sample_size}, "
            f"{found.resampled:.3f}, noise floor {found.floor:.3f}, up to {found.high:.3f}"
        )

    @property
    def _disagreement(self) -> str:
        return f"The labels disagree: the features match, and the structures do not ({self._figures})."

    @property
    def _full_remedy(self) -> str:
        return f"Counted wrongly in the images: {', '.join(self.wrong)}. {self.remedy[:1].upper()}{self.remedy[1:]}."

    def corrected(self, verdict: dict[str, Any]) -> dict[str, Any]:
        """A verdict on parts and classes, for JSON, in which nothing is good that the labels disagree with."""
        if self.close:
            return verdict
        grades = verdict["classes"]
        wrong = {name for name in grades if name in self.wrong and grades[name]["counts"] == Grade.GOOD}
        classes = {name: each | ({"counts": DISAGREE} if name in wrong else {}) for name, each in grades.items()}
        structure = verdict["parts"]["structure"]
        if structure["word"] != Grade.GOOD:
            return verdict | {"classes": classes}
        head = {"verdict": DISAGREE, "because": self._disagreement, "remedy": self._full_remedy}
        overall = str(Grade.BETTER) if verdict["overall"] == Grade.GOOD else verdict["overall"]
        parts = verdict["parts"] | {"structure": structure | {"word": str(Grade.BETTER)} | head}
        return verdict | head | {"classes": classes, "overall": overall, "parts": parts}

    def record(self, verdict: Verdict) -> dict[str, Any]:
        """For JSON."""
        return {
            "agree": self.agrees(verdict),
            "because": self.sentence(verdict),
            "images": self.labelled,
            "judged": self.sample_size,
            "each": {
                name: {
                    "distance": found.distance,
                    "seen": found.resampled,
                    "floor": found.floor,
                    "high": found.high,
                    "close": found.close,
                }
                for name, found in self.histograms.items()
            },
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
    columns, true_columns = _columns(learnt, classes), _columns(truth, classes)
    size = min(MAX_SPLIT_SIZE, max(1, len(truth.total) // 2))
    names = [name for name in true_columns if name in columns]
    found = {name: _resampled(columns[name], true_columns[name], size, rng) for name in names}
    scale = {name: max(floor.mean(), 1 / size) for name, (_, _, floor) in found.items()}
    largest = np.max([floor / scale[name] for name, (_, _, floor) in found.items()], 0)
    limit = float(np.quantile(largest, 0.975))
    histograms = {
        name: HistogramComparison(float(distance), float(resampled.mean()), float(floor.mean()), limit * scale[name])
        for name, (distance, resampled, floor) in found.items()
    }
    return Agreement(histograms, size, len(truth.total), remedy)


def _excess(found: HistogramComparison) -> float:
    return found.resampled / max(found.high, 1e-9)


def _columns(source: Source, classes: tuple[str, ...]) -> dict[str, NDArray[np.int64]]:
    """Whole numbers of every scene, by name; -1 where it has no such node."""
    columns = {"number of objects": source.total} | dict(zip(classes, source.counts.T, strict=True))
    for (parent, child), found in source.children.items():
        scene, rank, count = (x.numpy() for x in found)
        for i in range(MAX_RANKS):
            column = np.full(len(source.total), -1)
            # Below several parents there are several nodes of a rank: the last one's count stands for them.
            column[scene[rank == i]] = count[rank == i]
            columns[f"{child} of {parent} {i + 1}"] = column
    return columns


def _resampled(learnt: NDArray[np.int64], truth: NDArray[np.int64], size: int, rng: np.random.Generator):
    """Total variation of all, and of resamples: between the sides, and between two samples of the truth."""
    low, bins = min(learnt.min(), truth.min()), max(learnt.max(), truth.max()) + 1
    p, q = (np.bincount(side - low, minlength=bins - low) / len(side) for side in (learnt, truth))
    a, b, c = (rng.multinomial(size, share, RESAMPLES) / size for share in (p, q, q))
    return total_variation(p, q), np.abs(a - b).sum(1) / 2, np.abs(c - b).sum(1) / 2
