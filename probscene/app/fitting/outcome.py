"""What a fit leaves: the learnt guide, or the prior where the guide's scenes are farther from the target.

New scenes of both are looked at through the run's own features.
"""

from typing import Any

import torch
from torch import Tensor

from probscene.inference.features.base import FeatureNet
from probscene.inference.guides.base import Guide
from probscene.inference.judging.farther import farther
from probscene.inference.training import batch_seed
from probscene.policy import Policy
from probscene.sampling import sample, seed_everything

from ..progress import Progress
from .observer import RENDERED_AT_ONCE, Observer
from .run import PRIOR_KEPT, RunFolder

SCENES = 500  # of each policy, at most; fewer where the fit's batches are smaller
REJECTED = "guide-rejected"


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
    """Keep the guide or the prior; a sentence where it is the prior, else nothing.

    Args:
        net: what it learnt by.
        real: ``(L, D)``.
    """
    if not run.preset.prior_if_worse:
        run.write_tensors("guide", guide.state_dict())
        return ""
    which = compared(net)
    which = slice(None) if which is None else which
    found = []
    number = min(SCENES, 2 * run.preset.num_scenes)
    policies: tuple[Policy, ...] = (guide.eval(), run.model.prior)
    for i, policy in enumerate(policies):
        seed_everything(batch_seed(run.record["seed"], 4, i))
        observe, parts = observer.observe(net, run.preset.draws_per_structure), []
        for first in range(0, number, RENDERED_AT_ONCE):
            parts.append(observe(sample(run.model, policy, min(RENDERED_AT_ONCE, number - first))))
            progress("outcome", i * number + first + len(parts[-1]), 2 * number, "")
        found.append(torch.cat(parts)[:, which].double().numpy())
    apart = farther(found[0], found[1], real[:, which].double().numpy())
    record: dict[str, Any] = {"kept": "learnt", "scenes": number, "learnt": apart.one, "prior": apart.other}
    if not apart.sure:
        run.write_outcome(record)
        run.write_tensors("guide", guide.state_dict())
        return ""
    because = (
        f"Learnt scenes are farther from the target than the prior's, {apart.one:.2f} against {apart.other:.2f} in "
        "energy distance of the features"
    )
    run.write_tensors(REJECTED, guide.state_dict())
    _keep_prior(run, record | {"kept": "prior", "because": because})
    return f"{because}; the prior is kept. What was learnt is in {run.path / REJECTED}.safetensors."


def _keep_prior(run: RunFolder, record: dict[str, Any]) -> None:
    run.write_outcome(record)
    run.write_tensors("guide", {PRIOR_KEPT: torch.ones(1)})
