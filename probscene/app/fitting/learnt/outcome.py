"""What a fit leaves: the learnt guide, or the prior where the guide's scenes are farther from the target.

New scenes of both are looked at through the run's own features. The number of a class that cannot be read is held
(``inference.holding``); where it changes all the same, as it goes with what was learnt of others, that is said.
"""

import math
from typing import Any

import torch
from torch import Tensor

from probscene.inference.features.base import FeatureNet
from probscene.inference.guides.base import Guide
from probscene.inference.judging.farther import farther
from probscene.inference.training import batch_seed
from probscene.policy import Policy
from probscene.sampling import sample, seed_everything

from ...progress import Progress
from ..observer import RENDERED_AT_ONCE, Observer
from ..run import PRIOR_KEPT, RunFolder
from .parameters import NAME, beside

SCENES = 500  # of each policy, at most; fewer where the fit's batches are smaller
REJECTED = "guide-rejected"
SURELY, MUCH = 4.0, 0.1  # standard errors by which means differ that are told, and what part of the larger one


def compared(net: FeatureNet) -> Tensor | None:
    """``(D,)`` whether a feature says anything of the target's images; None where all do."""
    return getattr(net, "compared", None)


def give_up(run: RunFolder) -> str:
    """Keep the prior, as no feature can be read; why, in a sentence."""
    because = "Nothing can be read in the target's images, so that nothing can be learnt from them"
    _keep_prior(run, {"kept": "prior", "because": because})
    return f"{because}; the prior is kept."


def conclude(
    run: RunFolder, observer: Observer, net: FeatureNet, real: Tensor, guide: Guide, progress: Progress
) -> str:
    """Keep the guide or the prior; a sentence where it is the prior, or where a class that cannot be read has another
    number than in the prior, else nothing.

    Args:
        net: what it learnt by.
        real: ``(L, D)``.
    """
    if not run.preset.prior_if_worse:
        run.write_tensors("guide", guide.state_dict() | beside(run.read_tensors(NAME) or {}))
        return ""
    which = compared(net)
    which = slice(None) if which is None else which
    found, numbers = [], []
    number = min(SCENES, 2 * run.preset.num_scenes)
    policies: tuple[Policy, ...] = (guide.eval(), run.model.prior)
    for i, policy in enumerate(policies):
        seed_everything(batch_seed(run.record["seed"], 4, i))
        draws = 1 if policy.suits else run.preset.draws_per_structure
        observe, parts, counts = observer.observe(net, draws), [], []
        for first in range(0, number, RENDERED_AT_ONCE):
            scenes = sample(run.model, policy, min(RENDERED_AT_ONCE, number - first), density=False)
            parts.append(observe(scenes))
            counts.append(scenes.derivation.counts(len(run.model.grammar.kinds)))
            progress("outcome", i * number + first + len(parts[-1]), 2 * number, "")
        found.append(torch.cat(parts)[:, which].double().numpy())
        numbers.append(torch.cat(counts).double())
    apart = farther(found[0], found[1], real[:, which].double().numpy())
    record: dict[str, Any] = {"kept": "learnt", "scenes": number, "learnt": apart.one, "prior": apart.other}
    if not apart.sure:
        unread = run.unread
        kinds = {kind: i for i, kind in enumerate(run.model.grammar.kinds) if kind in unread}
        changed = moved(numbers[0], numbers[1], kinds)
        run.write_outcome(record | ({"moved": changed} if changed else {}))
        run.write_tensors("guide", guide.state_dict() | beside(run.read_tensors(NAME) or {}))
        return _said(changed)
    because = (
        f"Learnt scenes are farther from the target than the prior's, {apart.one:.2f} against {apart.other:.2f} in "
        "energy distance of the features"
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


def _said(changed: dict[str, tuple[float, float]]) -> str:
    if not changed:
        return ""
    each = ", ".join(
        f"{name} (from {before:.2f} to {after:.2f} in a structure)" for name, (before, after) in changed.items()
    )
    return (
        "Not readable in the target's images, and yet of another number than in the prior, as they go with what was "
        f"learnt of other classes: {each}. Label ten images to have them compared."
    )


def _keep_prior(run: RunFolder, record: dict[str, Any]) -> None:
    run.write_outcome(record)
    run.write_tensors("guide", {PRIOR_KEPT: torch.ones(1)})
