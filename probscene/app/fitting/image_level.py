"""Ways of learning parameters without a reader: by images as wholes, and by objects in boxes. Axis letters: L images, K
labelled ones, M boxes of one, C H W."""

from typing import Any

import torch
from torch import Tensor

from probscene.dataset import Images
from probscene.device import CPU
from probscene.inference.guides.base import Guide
from probscene.inference.parameters.meta_sim.learning import MetaSimLearning
from probscene.inference.parameters.meta_sim.schedule import MetaSimSchedule
from probscene.inference.parameters.tilting.image_statistics import image_statistics
from probscene.inference.parameters.tilting.learning import TiltingLearning
from probscene.inference.parameters.tilting.objects import Objects, measure
from probscene.inference.parameters.tilting.schedule import TiltingSchedule
from probscene.inference.training import batch_seed

from ..labels.boxes import Boxes
from .given_boxes import stacked
from .rendered_features import RenderedFeatures
from .run import RunFolder

ImageLevelTraining = MetaSimLearning | TiltingLearning
MAX_BOXED_IMAGES = 500


def meta_sim_learning(
    run: RunFolder,
    observer: RenderedFeatures,
    guide: Guide,
    images: Tensor,
    schedule: MetaSimSchedule,
    device: torch.device = CPU,
) -> MetaSimLearning:
    """Meta-Sim's training, by EfficientNet's pooled features.

    Args:
        guide: of the structures.
        images: ``(L, C, H, W)`` uint8 of the target.
        device: of EfficientNet.
    """
    from probscene.inference.features.pretrained import EfficientNetLite  # torchvision takes seconds to import

    look = EfficientNetLite(schedule.feature_size).to(device)
    seed = batch_seed(run.record["seed"], 5)
    return MetaSimLearning(run.model, guide, observer.observe(look), look.embed(images), schedule, seed)


def tilting_learning(
    run: RunFolder,
    observer: RenderedFeatures,
    guide: Guide,
    images: Tensor,
    schedule: TiltingSchedule,
    objects: Objects | None,
    device: torch.device = CPU,
) -> TiltingLearning:
    """The training that tilts, by the same features and by image statistics; other arguments as of
    ``meta_sim_learning``.

    Args:
        objects: of the target, see ``labelled_objects``.
    """
    from probscene.inference.features.pretrained import EfficientNetLite

    seed = batch_seed(run.record["seed"], 5)
    looks = EfficientNetLite(schedule.feature_size).to(device).embed, image_statistics
    real = tuple(look(images) for look in looks)
    return TiltingLearning(run.model, guide, observer.labelled, looks, real, schedule, seed, objects)


def labelled_objects(run: RunFolder, boxes: Boxes | None, images: Images) -> Objects | None:
    """The objects of the target that are in boxes, of at most ``MAX_BOXED_IMAGES``; None where there are none."""
    if boxes is None or not any(map(len, boxes.boxes)):
        return None
    return measure(*stacked(boxes.some(MAX_BOXED_IMAGES), run.model.classes, images))


def sites_record(learning: ImageLevelTraining, discarded: dict[str, str]) -> list[dict[str, Any]]:
    """For JSON, as of ``parameters``; nothing is read, so no site has a skill.

    Args:
        discarded: of what was learnt, by name of the site, why.
    """
    sites = []
    for site in learning.sites:
        is_learnt = site in learning.learnt and site.name not in discarded
        because = "" if is_learnt else discarded.get(site.name) or learning.why_not(site)
        about = {"name": site.name, "kinds": site.kinds, "learnt": is_learnt}
        about |= {"fitted": site in learning.guide.sites if learning.guide is not None else False}
        sites.append(about | {"skill": None, "because": because})
    return sites
