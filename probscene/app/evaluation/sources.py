"""One source of counts that an evaluation compares: sampled structures, labels, or what a network reads.

Axis letters: N scenes, C classes.
"""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from probscene.inference.statistics.count_metrics import (
    Histogram,
    Tally,
    histogram_interval,
    pooled_shares_interval,
    resamples,
    tally_images,
)
from probscene.model import SceneModel
from probscene.policy import Policy
from probscene.relations import PerParent

from .structure_counts import Counts, Relation, tallies

PRIOR, START, LEARNT = "prior", "start", "learnt"
ESTIMATE, READ = "estimate", "read"  # what a network reads in the target's images, and in learnt renders
SAMPLED_SOURCES = PRIOR, START, LEARNT  # in the order of a fit; ``START`` is the initialisation


def baseline_policies(model: SceneModel) -> dict[str, Policy]:
    """The policies that a fit is compared with: the prior, and the initialisation, which guides are pretrained on,
    where that is another policy."""
    start = {} if model.pretraining is None else {START: model.pretraining}
    return {PRIOR: model.prior, **start}


@dataclass(frozen=True, eq=False)
class Source:
    """Counts of one source.

    Attributes:
        counts: ``(N, C)`` int64.
        total: ``(N,)`` int64 objects of all classes; an estimate's is rounded by itself.
        children: by relation, the children of each node, where kinds nest and structures are known.
        seed: of its resamples; different for sources that are compared.
    """

    counts: Counts
    total: Counts
    children: dict[Relation, PerParent] = field(default_factory=dict)
    seed: int = 0

    @staticmethod
    def from_counts(counts: Counts, children: dict[Relation, PerParent] | None = None, seed: int = 0) -> "Source":
        return Source(counts, counts.sum(1), children or {}, seed)

    def select(self, columns: list[int]) -> "Source":
        """Of some of the classes, as if there were no others."""
        if columns == list(range(self.counts.shape[1])):
            return self
        counts = self.counts[:, columns]
        return Source(counts, counts.sum(1), self.children, self.seed)

    def number(self) -> Histogram:
        """Shares of scenes with 0, 1, 2, ... objects."""
        return histogram_interval(self.total)

    def classes(self) -> Histogram:
        """Shares of the classes among all objects, ``(C,)``."""
        return pooled_shares_interval(self.counts)

    @cached_property
    def kinds(self) -> tuple[Tally, ...]:
        """Images by their number of objects of each class."""
        return tuple(tally_images(column, self._weight) for column in self.counts.T)

    @cached_property
    def nested(self) -> dict[Relation, dict[str, Tally]]:
        """By relation, the children of a node; see ``structure_counts.GROUPS``."""
        return {relation: tallies(found, self._weight) for relation, found in self.children.items()}

    @cached_property
    def _weight(self) -> NDArray[np.float32]:
        return resamples(len(self.counts), seed=self.seed)
