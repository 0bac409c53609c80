"""Ways of learning parameters by images as wholes, of which nothing is read. Axis letters: L images, C H W."""

from typing import Any

from torch import Tensor

from probscene.inference.guides.base import Guide
from probscene.inference.parameters.meta_sim.learning import MetaSimLearning
from probscene.inference.parameters.meta_sim.schedule import MetaSimSchedule
from probscene.inference.parameters.tilting.image_statistics import image_statistics
from probscene.inference.parameters.tilting.learning import TiltingLearning
from probscene.inference.parameters.tilting.schedule import TiltingSchedule
from probscene.inference.training import batch_seed

from .rendered_features import RenderedFeatures
from .run import RunFolder

ImageLevelTraining = MetaSimLearning | TiltingLearning


def meta_sim_learning(
    run: RunFolder, observer: RenderedFeatures, guide: Guide, images: Tensor, schedule: MetaSimSchedule
) -> MetaSimLearning:
    """Meta-Sim's training, by EfficientNet's pooled features.

    Args:
        guide: of the structures.
        images: ``(L, C, H, W)`` uint8 of the target.
    """
    from probscene.inference.features.pretrained import EfficientNetLite  # torchvision takes seconds to import

    look = EfficientNetLite(schedule.feature_size)
    seed = batch_seed(run.record["seed"], 5)
    return MetaSimLearning(run.model, guide, observer.observe(look), look.embed(images), schedule, seed)


def tilting_learning(
    run: RunFolder, observer: RenderedFeatures, guide: Guide, images: Tensor, schedule: TiltingSchedule
) -> TiltingLearning:
    """The training that tilts, by the same features and what can plainly be said; arguments as of
    ``meta_sim_learning``."""
    from probscene.inference.features.pretrained import EfficientNetLite

    seed = batch_seed(run.record["seed"], 5)
    looks = EfficientNetLite(schedule.feature_size).embed, image_statistics
    real = tuple(look(images) for look in looks)
    return TiltingLearning(run.model, guide, observer.labelled, looks, real, schedule, seed)


def sites_record(learning: ImageLevelTraining) -> list[dict[str, Any]]:
    """For JSON, as of ``parameters``; nothing is read, so no site has a skill."""
    sites = []
    for site in learning.sites:
        because, is_learnt = site.keeps, site in learning.learnt
        if not because and not is_learnt:
            because = (
                "the similarity of images does not depend on it" if site.of_scene else "it is not of the whole scene"
            )
        about = {"name": site.name, "kinds": site.kinds, "learnt": is_learnt}
        about |= {"fitted": site in learning.guide.sites if learning.guide is not None else False}
        sites.append(about | {"skill": None, "because": because})
    return sites
