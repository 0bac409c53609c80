"""Which learnt parameters are kept, by images that nothing was learnt from.

Sites that are read are judged one by one: a site is learnt where the readings of held-out images are likelier under the
guide than under the prior, beyond chance (``inference.parameters.split_likelihood_ratio``). Images as wholes are one
guard: where renders with all that was learnt are significantly farther from held-out images than renders with the
prior's parameters, all sites keep the prior.

What whole images have moved is kept only where renders come nearer by it, and not where objects get farther from those
that are labelled. Sites that labelled objects have moved have been tested by these. Axis letters: L images, C H W.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.stats import wasserstein_distance
from torch import Tensor

from probscene.inference.features.base import Examples
from probscene.inference.guides.base import Guide
from probscene.inference.parameters.guide import ParameterGuide
from probscene.inference.parameters.learning import ParameterLearning
from probscene.inference.parameters.split_likelihood_ratio import log_e_values, log_threshold, significant
from probscene.inference.parameters.tilting.learning import TiltingLearning
from probscene.inference.parameters.tilting.objects import (
    MIN_OBJECTS,
    MIN_SPREAD,
    Objects,
    concatenate_objects,
    objects_of,
)
from probscene.inference.statistics.energy import Features, bootstrap_test
from probscene.inference.training import batch_seed
from probscene.model import SceneModel
from probscene.sampling import sample, seed_everything

from .image_level import ImageLevelTraining
from .rendered_features import RENDERED_AT_ONCE, RenderedFeatures
from .run import RunFolder

QUANTILES = np.linspace(0, 1, 21)
MAX_COMPARED = 200  # images of each side, at most, that are compared as wholes


class SiteSelection(NamedTuple):
    """For JSON.

    Attributes:
        distances: ``kept``, ``"learnt"`` or ``"prior"``, and the energy distances of renders with learnt parameters
            and with the prior's from the images.
        because: why a site that was fitted keeps its prior, by name.
        sites: of each fitted site what is read of u in renders with the prior's parameters, with the learnt ones, and
            in the images: 21 quantiles of each, and Wasserstein-1 distances from the images; the floor is that of their
            two halves.
    """

    distances: dict[str, Any]
    because: dict[str, str]
    sites: dict[str, dict[str, Any]]


def select_sites(
    run: RunFolder, guide: Guide, learning: ParameterLearning | ImageLevelTraining, held: Tensor
) -> SiteSelection:
    """Decide, and tell the learnt guide which sites keep their prior.

    Args:
        guide: of the structures.
        held: images ``(L, C, H, W)`` uint8 that nothing was learnt from.
    """
    learnt, because = learning.guide, dict[str, str]()
    if learnt is None:
        return SiteSelection({"kept": "prior"}, {}, {})
    if isinstance(learning, ParameterLearning) and isinstance(learnt, ParameterGuide):
        because = sites_without_evidence(learning, held, batch_seed(run.record["seed"], 6, 4))
        learnt.prior_sites = frozenset(because)
    rows = torch.linspace(0, len(held) - 1, min(MAX_COMPARED, len(held))).round().long()
    if isinstance(learning, TiltingLearning):
        return _select_moved(run, guide, learning, held[rows])
    drawn = {
        "prior": _renders_of(run, run.model, guide, len(rows), "prior"),
        "learnt": _renders_of(run, learnt.with_parameters(run.model), guide, len(rows), "learnt"),
    }
    images = {"target": held[rows]} | {name: _images(some) for name, some in drawn.items()}
    embed = _embedding()
    test = bootstrap_test(embed(images["learnt"]), embed(images["prior"]), embed(images["target"]))
    if isinstance(learning, ParameterLearning):
        is_kept = not test.significant and len(because) < len(learnt.sites)
    else:  # of which images as wholes are the only evidence
        is_kept = test.distance < test.baseline_distance
    distances = {"kept": "learnt" if is_kept else "prior"}
    distances |= {"learnt": test.distance, "prior": test.baseline_distance}
    if not isinstance(learning, ParameterLearning):
        return SiteSelection(distances, {}, {})
    return SiteSelection(distances, because, _read_in(learning, images, batch_seed(run.record["seed"], 6, 2)))


def _select_moved(run: RunFolder, guide: Guide, learning: TiltingLearning, held: Tensor) -> SiteSelection:
    """Discard what whole images have moved, unless renders come nearer to them by it and objects no farther."""
    learnt = learning.guide
    assert learnt is not None
    by_images, because = frozenset(site.name for site in learning.by_images), dict[str, str]()
    drawn, own = {}, learnt.prior_sites
    for name, without in (("prior", by_images), ("learnt", frozenset[str]())):
        learnt.prior_sites = own | without
        drawn[name] = _renders_of(run, learnt.with_parameters(run.model), guide, len(held), name)
    embed = _embedding()
    test = bootstrap_test(embed(_images(drawn["learnt"])), embed(_images(drawn["prior"])), embed(held))
    if by_images and test.distance >= test.baseline_distance:
        why = f"energy distance {test.distance:.2f}, without it {test.baseline_distance:.2f}"
        because = dict.fromkeys(by_images, f"learnt scenes come no nearer to held-out images by it ({why})")
    elif by_images and learning.objects is not None and objects_farther(drawn, learning.objects):
        because = dict.fromkeys(by_images, "objects get farther from the labelled ones by it")
    learnt.prior_sites = own | because.keys()
    distances = {"kept": "learnt" if len(because) < len(learning.learnt) else "prior"}
    return SiteSelection(distances | {"learnt": test.distance, "prior": test.baseline_distance}, because, {})


def objects_farther(drawn: dict[str, list[Examples]], real: Objects) -> bool:
    """Whether objects of a class are significantly farther from the labelled ones in learnt renders than in others."""
    learnt, other = (concatenate_objects([objects_of(some) for some in drawn[name]]) for name in ("learnt", "prior"))
    for c in np.unique(real.label):
        of = [np.flatnonzero(objects.label == c) for objects in (learnt, other, real)]
        if min(len(rows) for rows in of) < MIN_OBJECTS:
            continue
        seen = [objects.seen[rows] for objects, rows in zip((learnt, other, real), of, strict=True)]
        scale = np.maximum(seen[2].std(0), MIN_SPREAD)
        images = tuple(objects.image[rows] for objects, rows in zip((learnt, other, real), of, strict=True))
        if bootstrap_test(*(some / scale for some in seen), images=images).significant:
            return True
    return False


def _images(drawn: list[Examples]) -> Tensor:
    return torch.cat([some.image for some in drawn])


def sites_without_evidence(learning: ParameterLearning, held: Tensor, seed: int) -> dict[str, str]:
    """The fitted sites for whose learnt distributions held-out images are no evidence; by name, why."""
    assert learning.guide is not None
    seed_everything(seed)
    sites = (*learning.guide.node_sites, *learning.guide.scene_sites)
    log_e = log_e_values(learning.guide.net, learning.readings(held))
    each = zip(sites, log_e.tolist(), significant(log_e).tolist(), strict=True)
    return {
        site.name: f"readings of {len(held)} held-out images are likelier than under the prior by {found:.1f} nats, of "
        f"{log_threshold(len(sites)):.1f} that it takes"
        for site, found, is_learnt in each
        if not is_learnt
    }


def _read_in(learning: ParameterLearning, images: dict[str, Tensor], seed: int) -> dict[str, dict[str, Any]]:
    seed_everything(seed)
    readings = {name: learning.calibrated.readings(some) for name, some in images.items()}
    halves = [learning.calibrated.readings(images["target"][i::2]) for i in (0, 1)]
    sites = {}
    for site in learning.learnt:
        each = {name: _quantiles(found[site.name]) for name, found in readings.items()}
        away = {
            name: _distance(readings[name][site.name], readings["target"][site.name]) for name in ("prior", "learnt")
        }
        sites[site.name] = each | {"distance": away | {"floor": _distance(*(half[site.name] for half in halves))}}
    return sites


def _renders_of(run: RunFolder, model: SceneModel, guide: Guide, number: int, name: str) -> list[Examples]:
    """Renders with learnt parameters, or with the prior's."""
    seed_everything(batch_seed(run.record["seed"], 6, int(name == "prior")))
    observer = RenderedFeatures(model, run.record["threads"])
    sizes = [min(RENDERED_AT_ONCE, number - i) for i in range(0, number, RENDERED_AT_ONCE)]
    return [observer.labelled(sample(model, guide, size, density=False)) for size in sizes]


def _embedding() -> Callable[[Tensor], Features]:
    from probscene.inference.features.pretrained import EfficientNetLite  # torchvision takes seconds to import

    embed = EfficientNetLite().embed
    return lambda images: embed(images).double().numpy()


def _quantiles(u: Tensor) -> list[float]:
    """Empty where nothing is read."""
    return np.quantile(u.numpy(), QUANTILES).tolist() if len(u) else []


def _distance(one: Tensor, other: Tensor) -> float | None:
    """None where nothing is read in one of them."""
    return float(wasserstein_distance(one.numpy(), other.numpy())) if len(one) and len(other) else None
