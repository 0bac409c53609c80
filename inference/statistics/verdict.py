"""The verdict on a fit, and the figures that it rests on.

In this order, the first that holds:

- another domain: more than half of the real images show what is unlike anything in scenes, wherever it stands
  (``support.strange``). Without features of appearance: they are farther from every scene than two random scenes are
  from one another.
- out of reach: surely more than one real image in twenty is like no generated and no prior scene, and without these
  images generated and real features are less than half as far apart.
- not fitted yet: generated and real features differ by more than is tolerated (``difference_test``), and generated ones
  cannot be told from the prior's.
- out of reach: more than half of the real images are like no scene.
- modes lost: a cluster of the real images has surely less than a quarter of its share among the generated, and more
  among the prior's; and such clusters hold more than the generated scenes that are like no real image, which show that
  scenes are somewhere else and not just fewer kinds.
- still apart: generated and real features differ by more than is tolerated.
- good: none of these. The total variation from which on a difference would have been found is named.

What the prior's scenes are told by, what a nearest neighbour is and which shares are sure comes from halves of the sets
and from binomial limits. The limits "half", "a quarter" and "one in twenty" are the resolution of the clusters and of
the neighbourhoods (``modes``, ``support``). A good verdict is about what the features see: a network that counts
wrongly in real images and rightly in renders gives a good match of wrong counts.
"""

from enum import StrEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .difference_test import DifferenceTest
from .domain_shift import Fidelity
from .modes import Modes
from .two_sample import EnergyTest, Marginals

ALIEN, DOUBTFUL = 0.5, 0.2  # of the real images: another domain; and what is said beside "not fitted yet"
SHARE = 0.05  # of the real images: what is smaller is a figure and no verdict


class Verdict(StrEnum):
    """In words."""

    GOOD = "good"
    NOT_FITTED = "not fitted yet"
    APART = "still apart"
    MODES_LOST = "modes lost"
    OUT_OF_REACH = "real images lie outside what the model can make"
    ANOTHER_DOMAIN = "another domain"


REMEDY = {
    Verdict.GOOD: "Use it; look at the images named below, and label a few to be sure that the network counts rightly.",
    Verdict.NOT_FITTED: "Fit it: the guide still makes what the prior makes. Take the default preset or more batches.",
    Verdict.APART: "Fit longer (the default preset, more batches), or train the feature network longer.",
    Verdict.MODES_LOST: "Fit again with another seed or a lower learning rate, with the KDE objective and "
    "leave_one_out, or pretrain on a wider prior.",
    Verdict.OUT_OF_REACH: "Look at these images: widen the prior or the grammar, so that it can make them, or leave "
    "them out of the target folder.",
    Verdict.ANOTHER_DOMAIN: "Check that the target folder belongs to this model; if it does, its renders do not look "
    "like the images: change its sprites and their scale, or take pretrained features.",
}
PRETRAINED_REMEDY = {
    Verdict.APART: "Fit longer (the default preset, more batches).",
    Verdict.ANOTHER_DOMAIN: "Check that the target folder belongs to this model; if it does, its renders do not look "
    "like the images: change its sprites and their scale.",
}
"""What to do instead where the features are a pretrained network's: to take them, or to train them, is no advice."""


class Gap(NamedTuple):
    """Images of one side that are like none of the other.

    Attributes:
        share: of the images that were examined.
        low, high: its binomial limits, 95 %.
        floor: the largest such share between two halves of the real images.
        worst: indices of some images, those farthest from the other side first, whether or not they count.
    """

    share: float
    low: float
    high: float
    floor: float
    worst: NDArray[np.int64]


class Figures(NamedTuple):
    """What is measured.

    Attributes:
        joint: energy distance of generated and real features.
        single: the features one by one.
        difference: whether it is more than is tolerated, and which would be detected.
        names: of the features, or of their principal components.
        from_prior: energy distance of generated and prior features; None where there is no prior.
        p_value: whether generated and real differ at all, by all images.
        real_unmatched: real images that no generated scene is like.
        real_out_of_support: real images that no generated and no prior scene is like.
        generated_unmatched: generated scenes that no real image is like; its floor is the real images' own.
        modes: the clusters.
        foreign: share of real images of another domain.
        by_appearance: whether ``foreign`` is by features of appearance.
        effective: ESS / N of the density ratio; ``effective_floor`` that of a real half to the other.
        fidelity, fidelity_floor: precision, recall, density, coverage, and those between real halves.
        numbers: of the generated, the real and the prior's images.
    """

    joint: EnergyTest
    single: Marginals
    difference: DifferenceTest
    names: tuple[str, ...]
    from_prior: EnergyTest | None
    p_value: float
    real_unmatched: Gap
    real_out_of_support: Gap
    generated_unmatched: Gap
    modes: Modes
    foreign: float
    by_appearance: bool
    effective: float
    effective_floor: float
    fidelity: Fidelity
    fidelity_floor: Fidelity
    numbers: tuple[int, int, int]


def decide(found: Figures, explained: bool) -> tuple[Verdict, str]:
    """The verdict and one sentence with the figures that decided; ``explained`` says whether the real images that are
    out of reach are what most of the distance comes from."""
    modes, outside, differ = found.modes, found.real_out_of_support, found.difference
    number = f"{differ.numbers[0]} generated and {differ.numbers[1]} real images"
    feature = "all features together" if differ.feature is None else f"the feature {found.names[differ.feature]!r}"
    most_different = f"{number} can be told apart, most by {feature} (total variation {differ.total_variation:.2f})"
    if found.foreign > ALIEN:
        how = (
            "show what is unlike anything in scenes"
            if found.by_appearance
            else "are by their features farther from every scene than two random scenes are from one another"
        )
        return Verdict.ANOTHER_DOMAIN, f"{_percent(found.foreign)} of the real images {how}."
    lost = float(modes.real[modes.lost].sum())
    gap = outside.low > max(SHARE, outside.floor)
    if gap and explained:
        return (
            Verdict.OUT_OF_REACH,
            f"{_outside(outside)}; without them generated and real features are less than half as far apart.",
        )
    doubt = found.by_appearance and found.foreign > DOUBTFUL
    beside = f" {_percent(found.foreign)} of the real images show what is unlike anything in scenes." if doubt else ""
    if differ.significant and found.from_prior is not None and found.from_prior.close:
        return Verdict.NOT_FITTED, f"{most_different}, while generated and prior scenes cannot be told apart.{beside}"
    if gap and outside.share > max(0.5, lost):
        return Verdict.OUT_OF_REACH, f"{_outside(outside)}."
    if lost > max(0.0, found.generated_unmatched.share - found.generated_unmatched.floor):
        left = float(modes.generated[modes.lost].sum())
        return (
            Verdict.MODES_LOST,
            f"{int(modes.lost.sum())} of {len(modes.real)} clusters, {_percent(lost)} of the real images, are "
            f"{_percent(left)} of the generated ones: surely less than a quarter of their share.",
        )
    if differ.significant:
        return Verdict.APART, f"{most_different}.{beside}"
    return (
        Verdict.GOOD,
        f"{number} cannot be told apart{_detectable(differ)}; {_percent(found.real_unmatched.share)} of the real "
        f"images are like no generated scene (between real halves up to {_percent(found.real_unmatched.floor)}).",
    )


def _detectable(differ: DifferenceTest) -> str:
    if differ.detectable is None:
        return ", as far as features that hardly vary say"
    return f": differences above a total variation of {differ.detectable:.2f} in any one feature would be seen"


def _outside(gap: Gap) -> str:
    return (
        f"{_percent(gap.share)} of the real images are like no generated and no prior scene (between real halves at "
        f"most {_percent(gap.floor)})"
    )


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"
