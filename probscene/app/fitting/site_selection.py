"""Which learnt parameters are kept, by images that nothing was learnt from.

Sites that are read are judged one by one: a site is learnt where the readings of held-out images are likelier under the
guide than under the prior, beyond chance (``inference.parameters.split_likelihood_ratio``). Images as wholes are one
guard: where renders with all that was learnt are significantly farther from held-out images than renders with the
prior's parameters, all sites keep the prior. Axis letters: L images, C H W.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.stats import wasserstein_distance
from torch import Tensor

from probscene.inference.guides.base import Guide
from probscene.inference.parameters.guide import ParameterGuide
from probscene.inference.parameters.learning import ParameterLearning
from probscene.inference.parameters.split_likelihood_ratio import log_e_values, log_threshold, significant
from probscene.inference.parameters.tilting.learning import TiltingLearning
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
    images = {
        "target": held[rows],
        "prior": _renders_of(run, run.model, guide, len(rows), "prior"),
        "learnt": _renders_of(run, learnt.with_parameters(run.model), guide, len(rows), "learnt"),
    }
    embed = _embedding()
    test = bootstrap_test(embed(images["learnt"]), embed(images["prior"]), embed(images["target"]))
    if isinstance(learning, ParameterLearning):
        is_kept = not test.significant and len(because) < len(learnt.sites)
    else:  # of which images as wholes are the only evidence
        is_kept = test.distance < test.baseline_distance
        is_kept &= bool(learning.learnt) or not isinstance(learning, TiltingLearning)
    distances = {"kept": "learnt" if is_kept else "prior"}
    distances |= {"learnt": test.distance, "prior": test.baseline_distance}
    if not isinstance(learning, ParameterLearning):
        return SiteSelection(distances, {}, {})
    return SiteSelection(distances, because, _read_in(learning, images, batch_seed(run.record["seed"], 6, 2)))


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


def _renders_of(run: RunFolder, model: SceneModel, guide: Guide, number: int, name: str) -> Tensor:
    """Renders with learnt parameters, or with the prior's."""
    seed_everything(batch_seed(run.record["seed"], 6, int(name == "prior")))
    observer = RenderedFeatures(model, run.record["threads"])
    sizes = [min(RENDERED_AT_ONCE, number - i) for i in range(0, number, RENDERED_AT_ONCE)]
    return torch.cat([observer.labelled(sample(model, guide, size, density=False)).image for size in sizes])


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
