"""Objects that the reader misses: what is far, small or behind something is detected less often.

What is read in a target is of the objects that are found there, which are not a fair sample. So each scene graph that
was read gets, beside its own objects, those that were not found in a render of the guide. That is the expectation step
of EM [1], by Monte Carlo: what a guide learns next is the maximization. Values that nothing can tell keep what the
guide said of them before, which is the prior at first. A value counts only where finding goes by it; of all others
what is found is a fair sample. Axis letters: N renders, L images, M nodes, K objects, S sites, C classes.

References:
    [1] Dempster, Laird, Rubin, *Maximum likelihood from incomplete data via the EM algorithm*, JRSS B 1977.
"""

from typing import NamedTuple

import torch
from scipy.stats import wasserstein_distance
from torch import Tensor

from .graph import class_of
from .reader import Detections
from .reader_training import SupervisedBatch

MIN_OBJECTS = 20  # objects of a class that are found, and that are not, by which it is told
MIN_DISTANCE = (
    0.03  # least Wasserstein-1 distance between u of what is found and of all by which finding goes by a site
)
MAX_WEIGHT = 4.0  # weight


class MissedObjects(NamedTuple):
    """Objects of N renders that were not found in them, K in all, render by render.

    Attributes:
        renders: N, as a tensor.
        image: ``(K,)`` int64 which render.
        label: ``(K,)`` int64 class.
        centre, parent: ``(K, 2)`` x and y of its middle, and of its parent's, pixels.
        u: ``(K, S)``, NaN where finding does not go by the site, or one has none.
        rate: ``(C,)`` objects of each class that were found in a render, in the mean.
    """

    renders: Tensor
    image: Tensor
    label: Tensor
    centre: Tensor
    parent: Tensor
    u: Tensor
    rate: Tensor

    @staticmethod
    def from_renders(valued: SupervisedBatch, kinds: Tensor, found: Tensor, sites: Tensor) -> "MissedObjects":
        """Of renders.

        Args:
            kinds: ``(C,)`` the grammar's kind of each class.
            found: ``(N, M)`` bool, which of the nodes are found.
            sites: columns of those that are learnt.
        """
        label = class_of(valued.kind, kinds)
        u, counts = valued.u[..., sites], torch.zeros(len(kinds), len(sites), dtype=torch.bool)
        for c in range(len(kinds)):
            of_class, here = label == c, found & (label == c)
            if MIN_OBJECTS <= int(here.sum()) <= int(of_class.sum()) - MIN_OBJECTS:
                sides = zip(u[here].unbind(1), u[of_class].unbind(1), strict=True)
                counts[c] = torch.tensor([_detection_depends_on(*pair) for pair in sides])
        n, m = ((label >= 0) & ~found & counts.any(1)[label]).nonzero(as_tuple=True)
        centre, above = valued.drawn.centre, valued.parent[n, m].clamp(min=0)
        return MissedObjects(
            torch.tensor(len(found)),
            n,
            label[n, m],
            centre[n, m],
            centre[n, above],
            u[n, m].where(counts[label[n, m]], torch.nan),
            label[found & (label >= 0)].bincount(minlength=len(kinds)) / len(found),
        )

    def impute(self, found: Detections, number: int) -> tuple[Detections, Tensor, Tensor]:
        """Add to the detections in each of so many images the objects that were missed in one of the renders.

        Returns:
            all objects, those that were found first; u of the others; and how much each of all counts, which is 1 for
            those that were found. Another counts as often as its class is found in the images for once in the renders.
        """
        rate = found.label.bincount(minlength=len(self.rate)) / max(number, 1)
        weight = (rate / self.rate.clamp(min=1e-6)).clamp(max=MAX_WEIGHT)
        render = torch.randint(max(int(self.renders), 1), (number,))
        image, which = (self.image == render[:, None]).nonzero(as_tuple=True)
        return (
            Detections(
                torch.cat([found.image, image]),
                torch.cat([found.score, found.score.new_zeros(len(which))]),
                torch.cat([found.label, self.label[which]]),
                torch.cat([found.centre, self.centre[which]]),
                torch.cat([found.parent, self.parent[which]]),
                torch.cat([found.raw, found.raw.new_zeros(len(which), *found.raw.shape[1:])]),
                found.scene_raw,
            ),
            self.u[which],
            torch.cat([torch.ones(len(found.label)), weight[self.label[which]]]),
        )


def _detection_depends_on(found: Tensor, every: Tensor) -> bool:
    """Whether finding goes by a site of a class, by u ``(K,)``."""
    if found.isnan().any():
        return False
    return float(wasserstein_distance(found.numpy(), every.numpy())) > MIN_DISTANCE
