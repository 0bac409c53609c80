"""Rules by which counts are read from the probabilities that a network gives to the places of an image.

On renders nearly any rule counts right. In photographs a network gives too little probability to some objects that are
there and a little to many that are not, and by how much differs from class to class, so that each class needs rules
of its own. Axis letters: N images, C classes, h w places, R rules.
"""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor


class Rule(NamedTuple):
    """One way to read counts.

    Attributes:
        name: ``"sum"``, ``"soft"`` or ``"peaks"``.
        window: the side, in places, of the square in which an object's probability is summed.
        nothing: of which probability on something is counted.
        whole: from which probability on an object counts as one, with a smooth transition; for ``"soft"`` alone.
    """

    name: str
    window: int = 3
    nothing: float = 0.0
    whole: float = 0.0

    def __str__(self) -> str:
        if self.name == "sum":
            return "the sum of probabilities"
        around = f"in {self.window} x {self.window} places"
        if self.name == "peaks":
            return f"peaks above {self.nothing:g} {around}"
        return f"objects from {self.nothing:g} to {self.whole:g} {around}"


class Scope(NamedTuple):
    """Which objects are counted, and where.

    Attributes:
        visible: least share of an object that can be seen.
        pixels: that its longer side spans at least, of what enters the network.
        stride: pixels from one place to the next.
    """

    visible: float
    pixels: float
    stride: int


SCOPES = (Scope(0.25, 16, 16), Scope(0.25, 16 / 3, 8), Scope(0.6, 16 / 3, 8), Scope(0.9, 16 / 3, 8))
LARGE, SMALL = 0, 1  # of the scopes, those that do without labels
AT_ONCE = 8  # images, so that they stay in the processor's cache from one rule to the next
THRESHOLDS = (0.05, 0.1, 0.2, 0.3, 0.5, 0.8)
SOFT = ((0.03, 0.2), (0.05, 0.3), (0.1, 0.5), (0.2, 0.7), (0.4, 0.8), (0.6, 1.0))
PEAKS = tuple(Rule("peaks", 3, threshold) for threshold in THRESHOLDS)
RULES = (Rule("sum"), *(Rule("soft", window, *limits) for window in (3, 5) for limits in SOFT), *PEAKS)


def read(probability: Tensor, rule: Rule, mass: Tensor | None = None) -> Tensor:
    """Counts ``(N, C)`` by one rule.

    Args:
        probability: ``(N, C, h, w)``, that a place is the middle of an object.
        mass: by the rule, see ``mass_of``, where it is known.
    """
    if rule.name == "sum":
        return probability.sum((2, 3))
    mass = mass_of(probability, rule) if mass is None else mass
    if rule.name == "peaks":
        return (mass > rule.nothing).float().sum((2, 3))
    return _whole(probability, rule, mass).sum((2, 3))


def mass_of(probability: Tensor, rule: Rule) -> Tensor:
    """The probability in the window around each place ``(N, C, h, w)``; of peaks elsewhere 0."""
    mass = rule.window**2 * F.avg_pool2d(probability, rule.window, 1, rule.window // 2)
    return mass.where(F.max_pool2d(mass, 3, 1, 1) == mass, 0.0) if rule.name == "peaks" else mass


def whole(probability: Tensor, rule: Rule) -> Tensor:
    """Probabilities ``(N, C, h, w)`` with objects taken to one, and faint ones to none, by a soft rule."""
    return _whole(probability, rule, mass_of(probability, rule))


def _whole(probability: Tensor, rule: Rule, mass: Tensor) -> Tensor:
    part = ((mass - rule.nothing) / (rule.whole - rule.nothing)).clamp(0, 1)
    to_one = (1 / mass.clamp(min=rule.nothing)).clamp(min=1.0)
    return probability * part.square() * (3 - 2 * part) * to_one


def read_all(probability: Tensor) -> Tensor:
    """Counts ``(N, R, C)`` by every rule of ``RULES``."""
    return torch.cat([_read_all(some) for some in probability.split(AT_ONCE)])


def _read_all(probability: Tensor) -> Tensor:
    alike = {(rule.name, rule.window): rule for rule in RULES if rule.name != "sum"}
    mass = {key: mass_of(probability, rule) for key, rule in alike.items()}
    return torch.stack([read(probability, rule, mass.get((rule.name, rule.window))) for rule in RULES], 1)


def read_each(probability: Tensor, rules: Tensor) -> Tensor:
    """Counts ``(N, C)``, each class by the median of its own rules.

    Args:
        rules: ``(C, R)`` bool, at least one for each class.
    """
    counts = probability.new_zeros(probability.shape[:2])
    if not len(counts):
        return counts
    for c, of_class in enumerate(rules):
        some = [read(probability[:, c : c + 1], RULES[r]) for r in of_class.nonzero().flatten().tolist()]
        counts[:, c] = torch.cat(some, 1).quantile(0.5, 1)
    return counts


def by_steps(counts: Tensor, steps: Tensor) -> Tensor:
    """How many of the ``steps (C, K)`` each count of ``(N, C)`` reaches; as it is where the first step is infinite."""
    return torch.where(steps[:, 0].isinf(), counts, (counts[..., None] >= steps).sum(-1).float())
