"""What a fit leaves: the learnt guide, or the prior where the guide's scenes are farther from the target.

New scenes of both are looked at through the run's own features. The number of a class that cannot be read is held
(``inference.holding``); where it changes all the same, as it goes with what was learnt of others, that is said. So is
where learnt scenes predict the few labels worse than the labels' own histogram does. Axis letters: N scenes, K labels.
"""

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from probscene.inference.features.base import FeatureNet, objects_counted
from probscene.inference.features.photographs.readability import MIN_LABELS, histogram_scores, scores
from probscene.inference.guides.base import Guide
from probscene.inference.statistics.energy import bootstrap_test
from probscene.inference.training import batch_seed
from probscene.policy import Policy
from probscene.sampling import sample, seed_everything

from ..labels.partial_labels import PartialLabels
from ..progress import Progress
from .learnt_parameters import NAME, prefixed
from .rendered_features import RENDERED_AT_ONCE, RenderedFeatures
from .run import PRIOR_KEPT, RunFolder

SCENES = 500  # of each policy, at most; fewer where the fit's batches are smaller
REJECTED = "guide-rejected"
WORSE, LITTLE = 2.0, 0.1  # standard errors, and objects, by which scores on labels differ that are told
SURELY, MUCH = 4.0, 0.1  # standard errors by which means differ that are told, and what part of the larger one


def feature_mask(net: FeatureNet) -> Tensor | None:
    """``(D,)`` whether a feature says anything of the target's images; None where all do."""
    return getattr(net, "feature_mask", None)


def give_up(run: RunFolder) -> str:
    """Keep the prior, as no feature can be read; why, in a sentence."""
    because = "Nothing can be read in the target's images, so nothing can be learnt from them"
    _keep_prior(run, {"kept": "prior", "because": because})
    return f"{because}; the prior is kept."


def conclude(
    run: RunFolder,
    observer: RenderedFeatures,
    net: FeatureNet,
    real: Tensor,
    guide: Guide,
    labels: PartialLabels | None,
    progress: Progress,
) -> str:
    """Keep the guide or the prior; sentences where it is the prior, where a class that cannot be read has another
    number than in the prior, and where the labels' histogram is better than what was learnt, else nothing.

    Args:
        net: what it learnt by.
        real: ``(L, D)``.
        labels: of some of the images.
    """
    if not run.config.fallback_to_prior:
        run.write_tensors("guide", guide.state_dict() | prefixed(run.read_tensors(NAME) or {}))
        return ""
    which = feature_mask(net)
    which = slice(None) if which is None else which
    found, numbers = [], []
    number = min(SCENES, 2 * run.config.structure.num_scenes)
    policies: tuple[Policy, ...] = (guide.eval(), run.model.prior)
    for i, policy in enumerate(policies):
        seed_everything(batch_seed(run.record["seed"], 4, i))
        draws = 1 if policy.with_parameters else run.config.structure.draws_per_structure
        observe, parts, counts = observer.observe(net, draws), [], []
        for first in range(0, number, RENDERED_AT_ONCE):
            scenes = sample(run.model, policy, min(RENDERED_AT_ONCE, number - first), density=False)
            parts.append(observe(scenes))
            counts.append(scenes.derivation.counts(len(run.model.grammar.kinds)))
            progress("outcome", i * number + first + len(parts[-1]), 2 * number, "")
        found.append(torch.cat(parts)[:, which].double().numpy())
        numbers.append(torch.cat(counts).double())
    test = bootstrap_test(found[0], found[1], real[:, which].double().numpy())
    record: dict[str, Any] = {
        "kept": "learnt",
        "scenes": number,
        "learnt": test.distance,
        "prior": test.baseline_distance,
    }
    if not test.significant:
        unread = run.unread
        kinds = {kind: i for i, kind in enumerate(run.model.grammar.kinds) if kind in unread}
        changed = moved(numbers[0], numbers[1], kinds)
        worse = {} if labels is None else worse_than_labels(labels, _class_counts(net, found[0], which))
        more = {"moved": changed, "worse_than_labels": worse}
        run.write_outcome(record | {name: what for name, what in more.items() if what})
        run.write_tensors("guide", guide.state_dict() | prefixed(run.read_tensors(NAME) or {}))
        return " ".join(filter(None, (_said(changed), _worse_said(worse))))
    because = (
        f"Learnt scenes are farther from the target than the prior's, {test.distance:.2f} against "
        f"{test.baseline_distance:.2f} in energy distance of the features"
    )
    run.write_tensors(REJECTED, guide.state_dict())
    _keep_prior(run, record | {"kept": "prior", "because": because})
    return f"{because}; the prior is kept. What was learnt is in {run.path / REJECTED}.safetensors."


def moved(learnt: Tensor, prior: Tensor, kinds: dict[str, int]) -> dict[str, tuple[float, float]]:
    """Kinds whose mean number in a structure has changed, by more than chance: the prior's mean and the learnt one.

    Args:
        learnt, prior: ``(N, K)`` counts of all kinds in structures.
        kinds: names and numbers of those that are looked at.
    """
    found = {}
    for name, k in kinds.items():
        before, after = float(prior[:, k].mean()), float(learnt[:, k].mean())
        chance = math.sqrt(sum(float(counts[:, k].var()) / len(counts) for counts in (learnt, prior)))
        if abs(after - before) > max(SURELY * chance, MUCH * max(before, after)):
            found[name] = before, after
    return found


def worse_than_labels(labels: PartialLabels, learnt: dict[str, NDArray[np.float64]]) -> dict[str, tuple[float, float]]:
    """Classes whose labels are surely predicted worse by learnt scenes than by the labels' own histogram: the mean
    continuous ranked probability scores of both.

    Args:
        learnt: by class, ``(N,)`` counts of what can be seen in learnt scenes.
    """
    found = {}
    for name, counts in zip(labels.classes, labels.counts.T.double().numpy(), strict=True):
        if name not in learnt or len(counts) < MIN_LABELS:
            continue
        of_scenes, of_labels = scores(learnt[name], counts), histogram_scores(counts)
        chance = float((of_scenes - of_labels).std(ddof=1)) / math.sqrt(len(counts))
        if (of_scenes - of_labels).mean() > max(WORSE * chance, LITTLE):
            found[name] = float(of_scenes.mean()), float(of_labels.mean())
    return found


def _class_counts(net: FeatureNet, features: NDArray[np.float64], which: slice | Tensor) -> dict[str, Any]:
    """By the names of features, what they count ``(N,)``."""
    unit = objects_counted(net, torch.ones(len(net.names))).double().numpy()
    return dict(zip(np.array(net.names)[which], (features * unit[which]).T, strict=True))


def _worse_said(worse: dict[str, tuple[float, float]]) -> str:
    if not worse:
        return ""
    each = ", ".join(f"{name} ({learnt:.2f} against {labels:.2f})" for name, (learnt, labels) in worse.items())
    return (
        "By the continuous ranked probability score, in objects, learnt scenes predict the labels worse than the "
        f"labels' own histogram does: {each}. Label more images, and fit again with all of them."
    )


def _said(changed: dict[str, tuple[float, float]]) -> str:
    if not changed:
        return ""
    each = ", ".join(f"{name} (from {before:.2f} to {after:.2f} a scene)" for name, (before, after) in changed.items())
    return (
        "These classes cannot be counted in the target's images, and their counts changed with those of other classes: "
        f"{each}. Label ten images to have them compared."
    )


def _keep_prior(run: RunFolder, record: dict[str, Any]) -> None:
    run.write_outcome(record)
    run.write_tensors("guide", {PRIOR_KEPT: torch.ones(1)})
