"""Which classes can be counted in photographs, and by which rule: with a few labels, or without.

Without labels a reading is believed where heads that agree on renders agree on the photographs too, where the rule
counts right on renders that nothing was trained on, and where the mean count stays over a stretch of thresholds. With
labels the rule is that with the least error on them, a little held by its error on renders, as ten labels alone would
choose among fifty rules by luck. Where the other labels' histogram predicts a label better than any rule does, that
histogram is what is learnt. Axis letters: L photographs, V renders, K labelled images, S shares, R rules, C classes.
"""

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .reading import PEAKS, RULES, SHARES

AGREE = 0.12  # largest disagreement of heads, a mean difference over the mean count and ``BASE``
STEADY = 0.2  # largest relative change of the mean count from one threshold to the next
SKILL = 0.8  # least correlation with the true counts of renders
BASE = 0.3  # objects
RENDERS = 1.0  # how many labelled images the error on renders is worth
ENOUGH = 5  # labelled images from which on rules are chosen by them
MUCH, LITTLE = 1.25, 0.1  # by which factor, and how many objects, errors on so few labels must differ
GOES_WITH = 0.4  # least correlation of labels with a reading that is believed without them
APART = 0.25  # relative difference of means from which on labels and such a reading are of different things
Array = NDArray[np.float64]


class Read(NamedTuple):
    """What a network reads, by every rule.

    Attributes:
        photographs: ``(L, S, R, C)``.
        labelled: ``(K, S, R, C)``, those of the photographs that have labels.
        by_head: ``(heads, L, R, C)`` for the least share.
        renders: ``(V, S, R, C)``.
        true: ``(V, S, C)`` counts of those renders.
    """

    photographs: Tensor
    labelled: Tensor
    by_head: Tensor
    renders: Tensor
    true: Tensor


class Reading(NamedTuple):
    """How one class is read in photographs.

    Attributes:
        readable: whether its counts are compared.
        by: ``"agreement"``, ``"labels"``, or ``"histogram"`` of the labels.
        rule: of ``RULES``.
        share: of ``SHARES``.
        mean: of the counts that are read.
        disagreement, change, skill: see ``AGREE``, ``STEADY`` and ``SKILL``.
        error: mean absolute leave-one-out error on the labelled images; NaN without labels.
        steps: counts are how many of these values the reading reaches, where the labels' histogram is learnt.
        because: one sentence.
    """

    readable: bool
    by: str
    rule: int
    share: int
    mean: float
    disagreement: float
    change: float
    skill: float
    error: float
    steps: tuple[float, ...]
    because: str


def rules_for_renders(read: Tensor, true: Tensor) -> Tensor:
    """``(C,)`` the rule with the least error on renders.

    Args:
        read: ``(V, R, C)``.
        true: ``(V, C)``.
    """
    return (read - true[:, None]).abs().mean(0).argmin(0)


def without_labels(read: Read, c: int) -> Reading:
    """How class number ``c`` is read where no image is labelled.

    Args:
        read: by every rule.
    """
    heads = read.by_head[..., c].double().numpy()  # (heads, L, R)
    mean = read.photographs[:, 0, :, c].double().mean(0).numpy()
    pairs = [(i, j) for i in range(len(heads)) for j in range(i)]
    apart = np.mean([np.abs(heads[i] - heads[j]).mean(0) for i, j in pairs], 0) / (mean + BASE)
    skill = np.array([_correlation(read.renders[:, 0, r, c], read.true[:, 0, c]) for r in range(len(RULES))])
    change = _changes(mean)
    good = (apart <= AGREE) & (change <= STEADY) & (skill >= SKILL)
    cost = np.where(good, apart + change, np.inf if good.any() else apart + change + 10 * (skill < SKILL))
    best = int(np.argmin(cost))
    figures = (
        f"heads differ by {apart[best]:.0%}, the mean changes by {change[best]:.0%} from one threshold to the next, "
        f"r = {skill[best]:.2f} on renders"
    )
    word = "readable" if good[best] else "not readable"
    because = f"{word}, {mean[best]:.1f} an image by {RULES[best]} ({figures})"
    if not good[best]:
        because += "; label ten images"
    return Reading(
        bool(good[best]),
        "agreement",
        best,
        0,
        float(mean[best]),
        float(apart[best]),
        float(change[best]),
        float(skill[best]),
        float("nan"),
        (),
        because,
    )


def with_labels(read: Read, c: int, labels: Tensor) -> Reading:
    """How class number ``c`` is read where some images are labelled.

    Args:
        read: by every rule.
        labels: ``(K,)`` their counts.
    """
    free = without_labels(read, c)
    y = labels.double().numpy()
    if len(y) < ENOUGH or not y.any():
        why = "no labelled image shows one" if not y.any() else f"{len(y)} labelled images choose no rule"
        return free._replace(because=f"{free.because}; {why}")
    seen = read.labelled[..., c].double().numpy()  # (K, S, R)
    drawn = _errors(read.renders[..., c].double().numpy(), read.true[..., None, c].double().numpy())
    share, rule = _choose(seen, y, drawn)
    left_out = np.array([seen[(i, *_choose(np.delete(seen, i, 0), np.delete(y, i), drawn))] for i in range(len(y))])
    error, histogram = float(np.abs(left_out - y).mean()), _histogram_error(y)
    with_free = _correlation(read.labelled[:, 0, free.rule, c], labels)
    seen_mean, mean = float(read.labelled[:, 0, free.rule, c].mean()), float(y.mean())
    figures = f"leave-one-out error {error:.2f} an image, of the labels' histogram {histogram:.2f}"
    if error <= MUCH * histogram + LITTLE:
        found = read.photographs[:, share, rule, c]
        because = (
            f"readable by {len(y)} labels, {float(found.mean()):.1f} an image by {RULES[rule]}, of objects visible by "
            f"{SHARES[share]:g} ({figures})"
        )
        return free._replace(
            readable=True, by="labels", rule=rule, share=share, mean=float(found.mean()), error=error, because=because
        )
    if free.readable and with_free < GOES_WITH and abs(seen_mean - mean) > APART * max(seen_mean, mean):
        because = (
            f"{free.because}; the labels do not go with what is seen (r = {with_free:.2f}, {mean:.1f} labelled for "
            f"{seen_mean:.1f} read) and are not used; see whether all objects of this class are labelled"
        )
        return free._replace(error=error, because=because)
    steps = _steps(read.photographs[:, share, 0, c].double().numpy(), y)
    because = f"the histogram of {len(y)} labels is learnt, {mean:.1f} an image: no rule reads them better ({figures})"
    return free._replace(
        readable=True, by="histogram", rule=0, share=share, mean=mean, error=error, steps=steps, because=because
    )


def _choose(seen: Array, labels: Array, drawn: Array) -> tuple[int, int]:
    """The share and the rule with the least error on labelled images ``(K, S, R)`` and on renders ``(S, R)``; of shares
    that do about as well the least, which asks least of where objects stand."""
    cost = _errors(seen, labels[:, None, None]) + RENDERS / len(labels) * drawn
    share = int(np.argmax(cost.min(1) <= MUCH * cost.min() + LITTLE))
    return share, int(np.argmin(cost[share]))


def _errors(read: Array, true: Array) -> Array:
    """Mean absolute error and Wasserstein-1 distance of counts ``(N, S, R)``, ``(S, R)``."""
    return np.abs(read - true).mean(0) + np.abs(np.sort(read, 0) - np.sort(true, 0)).mean(0)


def _histogram_error(labels: Array) -> float:
    """How far a label is from the histogram of the others: the mean continuous ranked probability score, which is the
    absolute error where something predicts a single count."""
    K = len(labels)
    apart = np.abs(labels[:, None] - labels[None])
    to_others = apart.sum(1) / (K - 1)
    among_others = (apart.sum() - 2 * apart.sum(1)) / (K - 1) ** 2
    return float((to_others - among_others / 2).mean())


def _steps(read: Array, labels: Array) -> tuple[float, ...]:
    """Values that so many readings reach as labels reach 1, 2, 3, ..."""
    ranked = np.sort(read)[::-1]
    reached = [round(float((labels >= k).mean()) * len(ranked)) for k in range(1, int(labels.max()) + 1)]
    return tuple(float(ranked[n - 1]) for n in reached if n)


def _changes(mean: Array) -> Array:
    """``(R,)`` how much the mean count changes to the neighbouring thresholds, relative; that of the peaks is shared by
    all rules that have no neighbours."""
    at = {rule: i for i, rule in enumerate(RULES)}
    change = np.full(len(RULES), np.inf)
    families = [PEAKS] + [tuple(r for r in RULES if r.name == "soft" and r.window == window) for window in (3, 5)]
    for family in families:
        values = mean[[at[rule] for rule in family]]
        steps = np.abs(np.diff(values)) / (np.minimum(values[1:], values[:-1]) + BASE)
        for i, rule in enumerate(family):
            change[at[rule]] = max(steps[max(0, i - 1) : i + 1])
    return change


def _correlation(one: Tensor, other: Tensor) -> float:
    """Pearson's; 0 where one of them does not vary."""
    pair = torch.stack([one.double(), other.double()])
    return float(torch.corrcoef(pair)[0, 1]) if (pair.std(1) > 1e-9).all() else 0.0
