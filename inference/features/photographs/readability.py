"""Which classes can be counted in photographs, and by which rule: with a few labels, or without.

Without labels all rules that count renders about as well as the best one are taken, and their median is read. It is
believed where heads that agree on renders agreed on the photographs too, before they learnt from one another, where it
counts right on renders that nothing was trained on, where those rules read about as much as each other, and where most
objects are large: what heads take for a small object, dirt or a speck, all of them take for one. With labels
the rule is that with the least error on them, a little held by its error on renders, as ten labels alone would choose
among many rules by luck; where they bear out what is read without them, nothing changes. Where the other labels'
histogram predicts a label better than what is read, that histogram is what is learnt; as well where the rule reads
another number in the images without labels, as in those of another place, where it may not hold. What is read of one
image errs more than what is read of all of them, so both are asked: how far it is from the label of its image, and how
well the histogram of all that is read, which is what would be learnt, predicts the labels [1].

Axis letters: L photographs, V renders, K labelled images, S scopes, R rules, C classes.

References:
    [1] Gneiting, Raftery, *Strictly proper scoring rules, prediction, and estimation*, 2007: the continuous ranked
        probability score.
"""

import math
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .reading import LARGE, RULES, SCOPES, SMALL

MAX_DISAGREEMENT = 0.25  # largest disagreement of heads, a mean difference over the mean count and ``BASE``
MAX_RULE_SPREAD = 0.7  # largest difference of the means that rules read, over their own mean and ``BASE``
TIE_RATIO, TIE_SLACK = 1.1, 0.02  # by which factor, and how many objects, errors that are as good may exceed the least
MIN_LARGE_SHARE = 0.7  # of a class's objects must be in the scope of large ones for this to be read
MIN_CORRELATION = 0.8  # least correlation with the true counts of renders
BASE = 0.3  # objects
RENDER_WEIGHT = 1.0  # how many labelled images the error on renders is worth
MIN_LABELS = 5  # labelled images from which on rules are chosen by them
ERROR_RATIO, ERROR_SLACK = 1.25, 0.1  # by which factor, and how many objects, errors on so few labels must differ
MAX_BIAS = 2  # standard errors by which the mean of a reading may differ from that of labels which bear it out
MIN_LABEL_CORRELATION = 0.4  # of labels with a reading that is believed without them
MAX_MEAN_DIFFERENCE = (
    0.25  # relative difference of means from which on labels and such a reading are of different things
)
Array = NDArray[np.float64]


class Read(NamedTuple):
    """What a network reads, by every rule.

    Attributes:
        photographs: ``(L, S, R, C)``.
        labelled: ``(K, S, R, C)``, those of the photographs that have labels.
        apart: ``(S, R, C)``, see ``disagreement``.
        renders: ``(V, S, R, C)``.
        true: ``(V, S, C)`` counts of those renders.
    """

    photographs: Tensor
    labelled: Tensor
    apart: Tensor
    renders: Tensor
    true: Tensor


class Reading(NamedTuple):
    """How one class is read in photographs.

    Attributes:
        readable: whether its counts are compared.
        by: ``"agreement"``, ``"labels"``, or ``"histogram"`` of the labels.
        rules: of ``RULES``, whose median is read.
        scope: of ``SCOPES``.
        mean: of the counts that are read.
        disagreement, spread, skill: see ``MAX_DISAGREEMENT``, ``MAX_RULE_SPREAD`` and ``MIN_CORRELATION``.
        error: mean absolute leave-one-out error on the labelled images; NaN without labels.
        steps: counts are how many of these values the reading reaches, where the labels' histogram is learnt.
        because: one sentence.
    """

    readable: bool
    by: str
    rules: tuple[int, ...]
    scope: int
    mean: float
    disagreement: float
    spread: float
    skill: float
    error: float
    steps: tuple[float, ...]
    because: str


def scopes_without_labels(true: Tensor) -> Tensor:
    """``(C,)`` the scope by which each class is read where nothing is labelled: large objects, if most are.

    Args:
        true: ``(V, S, C)`` counts of renders.
    """
    large = true[:, LARGE].sum(0) >= MIN_LARGE_SHARE * true[:, SMALL].sum(0)
    return torch.where(large, LARGE, SMALL)


def rules_for_renders(read: Tensor, true: Tensor) -> Tensor:
    """``(C, R)`` bool, for each class the rule with the least error on renders.

    Args:
        read: ``(V, C, R)``.
        true: ``(V, C)``.
    """
    least = (read - true[..., None]).abs().mean(0).argmin(1)
    return torch.arange(read.shape[2]) == least[:, None]


def disagreement(by_head: Tensor) -> Tensor:
    """``(S, R, C)`` how far the heads' counts of photographs are apart: the mean difference of two of them, over the
    mean count and ``BASE``.

    Args:
        by_head: ``(heads, L, S, R, C)``.
    """
    pairs = torch.combinations(torch.arange(len(by_head))).unbind(1)
    apart = torch.stack([(by_head[i] - by_head[j]).abs().mean(0) for i, j in zip(*pairs, strict=True)]).mean(0)
    return apart / (by_head.mean((0, 1)) + BASE)


def without_labels(read: Read, c: int) -> Reading:
    """How class number ``c`` is read where no image is labelled.

    Args:
        read: by every rule.
    """
    s = int(scopes_without_labels(read.true)[c])
    true = read.true[:, s, c]
    error = (read.renders[:, s, :, c] - true[:, None]).abs().mean(0)
    rules = (error <= TIE_RATIO * error.min() + TIE_SLACK).nonzero().flatten()
    counts = read.photographs[:, s, rules, c].double().quantile(0.5, 1)
    mean, means = float(counts.mean()), read.photographs[:, s, rules, c].double().mean(0)
    apart = float(read.apart[s, rules, c].mean())
    spread = float((means.max() - means.min()) / (means.mean() + BASE))
    skill = _correlation(read.renders[:, s, rules, c].quantile(0.5, 1), true)
    good = s == LARGE and apart <= MAX_DISAGREEMENT and spread <= MAX_RULE_SPREAD and skill >= MIN_CORRELATION
    because = f"{'readable' if good else 'not readable'}, {mean:.1f} an image by {_by(tuple(rules.tolist()))}"
    if s == LARGE and true.sum() < read.true[:, SMALL, c].sum():
        because += f", of objects from {SCOPES[s].pixels:g} pixels"
    if s == SMALL:
        because += f", most objects under {SCOPES[LARGE].pixels:g} pixels"
    because += f" (heads differ by {apart:.0%}, rules by {spread:.0%}, r = {skill:.2f} on renders)"
    if not good:
        because += "; label ten images"
    nan = float("nan")
    return Reading(good, "agreement", tuple(rules.tolist()), s, mean, apart, spread, skill, nan, (), because)


def with_labels(read: Read, c: int, labels: Tensor) -> Reading:
    """How class number ``c`` is read where some images are labelled.

    Args:
        read: by every rule.
        labels: ``(K,)`` their counts.
    """
    free = without_labels(read, c)
    y = labels.double().numpy()
    if len(y) < MIN_LABELS or not y.any():
        why = "no labelled image shows one" if not y.any() else f"{len(y)} labelled images choose no rule"
        return free._replace(because=f"{free.because}; {why}")
    seen = read.labelled[..., c].double().numpy()  # (K, S, R)
    drawn = _errors(read.renders[..., c].double().numpy(), read.true[..., None, c].double().numpy())
    first = free.scope  # where most objects are small, the few large ones that go with the labels are not the labelled
    scope, rule = _choose(seen, y, drawn, first)
    others = ((np.delete(seen, i, 0), np.delete(y, i), drawn, first) for i in range(len(y)))
    chosen = [_choose(*some) for some in others]
    left_out = np.array([seen[(i, *each)] for i, each in enumerate(chosen)])
    error, histogram = float(np.abs(left_out - y).mean()), float(histogram_scores(y).mean())
    of_all = read.photographs[..., c].double().numpy()  # (L, S, R)
    score = float(np.mean([scores(of_all[:, s, r], y[i : i + 1]) for i, (s, r) in enumerate(chosen)]))
    of_free = read.labelled[:, free.scope, :, c][:, list(free.rules)].quantile(0.5, 1)
    all_of_free = read.photographs[:, free.scope, :, c][:, list(free.rules)].quantile(0.5, 1).double().numpy()
    with_free, seen_mean, mean = _correlation(of_free, labels), float(of_free.mean()), float(y.mean())
    of_histogram = f"of the labels' histogram {histogram:.2f}"
    figures = f"leave-one-out error {error:.2f} an image, {of_histogram}"
    off = (of_free - labels).double().numpy()
    without, surely = float(np.abs(off).mean()), MAX_BIAS * float(off.std(ddof=1)) / math.sqrt(len(y))
    as_by_labels = without <= ERROR_RATIO * error + ERROR_SLACK and abs(off.mean()) <= surely + ERROR_SLACK
    if free.readable and as_by_labels and _no_worse(without, scores(all_of_free, y).mean(), histogram):
        because = f"{free.because}; {len(y)} labels confirm it (error {without:.2f} an image, {of_histogram})"
        return free._replace(by="labels", error=without, because=because)
    found = of_all[:, scope, rule]
    differ = unlike(seen[:, scope, rule], found)
    if _no_worse(error, score, histogram) and differ is None:
        because = (
            f"readable by {len(y)} labels, {found.mean():.1f} an image by {RULES[rule]}, of objects from "
            f"{SCOPES[scope].pixels:.0f} pixels visible by {SCOPES[scope].visible:g} ({figures})"
        )
        return free._replace(
            readable=True,
            by="labels",
            rules=(rule,),
            scope=scope,
            mean=float(found.mean()),
            error=error,
            because=because,
        )
    if (
        free.readable
        and with_free < MIN_LABEL_CORRELATION
        and abs(seen_mean - mean) > MAX_MEAN_DIFFERENCE * max(seen_mean, mean)
    ):
        because = (
            f"{free.because}; the labels do not correlate with the readings (r = {with_free:.2f}, {mean:.1f} labelled "
            f"for {seen_mean:.1f} read) and are not used; check that all objects of this class are labelled"
        )
        return free._replace(error=error, because=because)
    steps = _steps(of_all[:, scope, 0], y)
    why = f"no rule reads them better ({figures})"
    if differ is not None:
        here, there = differ
        why = f"the best rule reads {here:.1f} in these images and {there:.1f} in the others; label some of those"
    because = f"the histogram of {len(y)} labels is learnt, {mean:.1f} an image: {why}"
    return free._replace(
        readable=True, by="histogram", rules=(0,), scope=scope, mean=mean, error=error, steps=steps, because=because
    )


def _no_worse(error: float, score: float, histogram: float) -> bool:
    """Whether what is read serves as well as the labels' histogram, which predicts a label with an error ``histogram``.

    Args:
        error: of what is read in an image, from its label.
        score: with which the histogram of all that is read predicts a label.
    """
    if error <= histogram + TIE_SLACK:
        return True
    return error <= ERROR_RATIO * histogram + ERROR_SLACK and score <= histogram + TIE_SLACK


def _choose(seen: Array, labels: Array, drawn: Array, first: int) -> tuple[int, int]:
    """The scope, from the ``first`` on, and the rule with the least error on labelled images ``(K, S, R)`` and on
    renders ``(S, R)``; of scopes that do about as well the earliest, which asks least of where objects stand."""
    cost = (_errors(seen, labels[:, None, None]) + RENDER_WEIGHT / len(labels) * drawn)[first:]
    scope = int(np.argmax(cost.min(1) <= ERROR_RATIO * cost.min() + ERROR_SLACK))
    return first + scope, int(np.argmin(cost[scope]))


def _errors(read: Array, true: Array) -> Array:
    """Mean absolute error and Wasserstein-1 distance of counts ``(N, S, R)``, ``(S, R)``."""
    return np.abs(read - true).mean(0) + np.abs(np.sort(read, 0) - np.sort(true, 0)).mean(0)


def unlike(labelled: Array, photographs: Array) -> tuple[float, float] | None:
    """The mean of what is read in the labelled photographs and in the others, where these differ beyond chance."""
    number = len(photographs) - len(labelled)
    if not number:
        return None
    mean = (photographs.sum() - labelled.sum()) / number
    # The variance of all: of a rare class, few that show none have next to none of their own.
    error = photographs.std(ddof=1) * math.sqrt(1 / len(labelled) + 1 / number)
    return (labelled.mean(), mean) if abs(labelled.mean() - mean) > MAX_BIAS * error else None


def histogram_scores(labels: Array) -> Array:
    """``(K,)`` how far each label is from the histogram of the others: the continuous ranked probability score, which
    is the absolute error where something predicts a single count."""
    K = len(labels)
    apart = np.abs(labels[:, None] - labels[None])
    to_others = apart.sum(1) / (K - 1)
    among_others = (apart.sum() - 2 * apart.sum(1)) / (K - 1) ** 2
    return to_others - among_others / 2


def scores(counts: Array, labels: Array) -> Array:
    """``(K,)`` how far each label is from the histogram of ``counts (L,)``, by the same score."""
    ranked, L = np.sort(counts), len(counts)
    among = 2 * float(((2 * np.arange(L) - L + 1) * ranked).sum()) / L**2  # mean |a - b|
    return np.abs(counts[:, None] - labels).mean(0) - among / 2


def _steps(read: Array, labels: Array) -> tuple[float, ...]:
    """Values that so many readings reach as labels reach 1, 2, 3, ..."""
    ranked = np.sort(read)[::-1]
    reached = [round(float((labels >= k).mean()) * len(ranked)) for k in range(1, int(labels.max()) + 1)]
    return tuple(float(ranked[n - 1]) for n in reached if n)


def _by(rules: tuple[int, ...]) -> str:
    return str(RULES[rules[0]]) if len(rules) == 1 else f"the median of {len(rules)} rules"


def _correlation(one: Tensor, other: Tensor) -> float:
    """Pearson's; 0 where one of them does not vary."""
    pair = torch.stack([one.double(), other.double()])
    return float(torch.corrcoef(pair)[0, 1]) if (pair.std(1) > 1e-9).all() else 0.0
