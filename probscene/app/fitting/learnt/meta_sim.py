"""Meta-Sim's way of learning parameters, as a stage of a fit. Axis letters: L images, C H W."""

from typing import TYPE_CHECKING, Any

from torch import Tensor

from probscene.inference.guides.base import Guide
from probscene.inference.parameters.meta_sim.learning import MetaSimLearning
from probscene.inference.training import batch_seed

from ..observer import Observer

if TYPE_CHECKING:
    from ..run import RunFolder


def meta_sim_learning(run: "RunFolder", observer: Observer, guide: Guide, images: Tensor) -> MetaSimLearning:
    """The training, by EfficientNet's pooled features.

    Args:
        guide: of the structures.
        images: ``(L, C, H, W)`` uint8 of the target.
    """
    from probscene.inference.features.pretrained import EfficientNetLite  # torchvision takes seconds to import

    schedule = run.preset.meta_sim
    look = EfficientNetLite(schedule.feature_size)
    seed = batch_seed(run.record["seed"], 5)
    return MetaSimLearning(run.model, guide, observer.observe(look), look.embed(images), schedule, seed)


def sites_record(learning: MetaSimLearning) -> list[dict[str, Any]]:
    """For JSON, as of ``parameters``; nothing is read, so no site has a skill."""
    sites = []
    for site in learning.sites:
        about = {"name": site.name, "kinds": site.kinds, "learnt": site in learning.learnt}
        sites.append(about | {"skill": None, "because": site.keeps})
    return sites
