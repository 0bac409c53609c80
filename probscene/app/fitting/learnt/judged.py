"""Learnt parameters, judged by images that nothing was learnt from.

Axis letters: L images, C H W.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from scipy.stats import wasserstein_distance
from torch import Tensor

from probscene.inference.guides.base import Guide
from probscene.inference.judging.farther import SURE, Farther, farther
from probscene.inference.judging.two_sample import Features
from probscene.inference.parameters.best import HeldOut, useless
from probscene.inference.parameters.guide import ParameterGuide
from probscene.inference.parameters.learning import ParameterLearning
from probscene.inference.parameters.tilting.learning import TiltingLearning
from probscene.inference.training import batch_seed
from probscene.model import SceneModel
from probscene.sampling import sample, seed_everything

from ..observer import RENDERED_AT_ONCE, Observer
from .wholes import WholeLearning

if TYPE_CHECKING:
    from ..run import RunFolder

QUANTILES = np.linspace(0, 1, 21)


class Judged(NamedTuple):
    """For JSON.

    Attributes:
        distances: ``kept``, ``"learnt"`` or ``"prior"``, and the energy distances of renders with learnt parameters
            and with the prior's from the images. The guide passes sites of which what is read in its renders is surely
            farther from what is read in the images; where renders are no nearer, or the schedule says so, all of which
            it is not surely nearer; and where they are surely farther all the same, all but those that bring them
            nearer alone. With the others it is kept, unless its renders are surely farther then.
        lost: by learnt site that cannot be read in scenes like the target's and keeps its prior therefore, the share of
            its variance that is read there.
        sites: by learnt site, what is read of u with the prior's parameters, with the learnt ones, and in the images:
            21 quantiles of each, and Wasserstein-1 distances from the images; the floor is that of their two halves.
    """

    distances: dict[str, Any]
    lost: dict[str, float]
    sites: dict[str, dict[str, Any]]


def judged(
    run: "RunFolder",
    guide: Guide,
    learning: ParameterLearning | WholeLearning,
    held: Tensor,
    more: Callable[[], Tensor],
) -> Judged:
    """By images ``held (L, C, H, W)`` and as many renders of each; their looks are EfficientNet's pooled features.
    What is read with little skill takes ``more`` of them to tell."""
    learnt = learning.guide
    if learnt is None:
        return Judged({"kept": "prior"}, {}, {})
    judge = learning.best.held if isinstance(learning, ParameterLearning) and learning.best is not None else None
    look, images = _embed(), {"target": held}
    real = look(held) if judge is None else judge.real

    def drawn(name: str, model: SceneModel) -> Features:
        seed_everything(batch_seed(run.record["seed"], 6, int(name == "prior")))
        images[name] = _renders(run, model, guide, len(held))
        return look(images[name])

    of_prior = drawn("prior", run.model)

    def compared() -> Farther:
        return farther(drawn("learnt", learnt.suited(run.model)), of_prior, real)

    apart = compared()
    kept, lost = "learnt" if apart.one < apart.other else "prior", dict[str, float]()
    careful = kept == "prior" or run.preset.parameters.sure
    if isinstance(learning, ParameterLearning) and isinstance(learnt, ParameterGuide):
        seed_everything(batch_seed(run.record["seed"], 6, 4))
        doubtful = dict[str, Tensor]()
        if learning.tried.unclear:
            lost, doubtful = learning.lost()
            doubtful["target"] = more()
        learnt.passed = passed(learning, images, doubtful, careful) | lost.keys()
        if learnt.passed:
            apart = compared()
        if apart.sure and judge is not None:
            learnt.passed = useless(learnt, judge) | lost.keys()
            apart = compared()
        kept = "prior" if apart.sure or len(learnt.passed) == len(learnt.sites) else "learnt"
        if kept == "prior":
            learnt.passed = frozenset()
    if isinstance(learning, TiltingLearning) and not learning.learnt:
        kept = "prior"
    distances = {"kept": kept, "learnt": apart.one, "prior": apart.other}
    if not isinstance(learning, ParameterLearning):  # which reads nothing
        return Judged(distances, {}, {})
    seed_everything(batch_seed(run.record["seed"], 6, 2))
    readings = {name: learning.tried.readings(some) for name, some in images.items()}
    halves = [learning.tried.readings(held[i::2]) for i in (0, 1)]
    sites = {}
    for site in learning.learnt:
        each = {name: _quantiles(found[site.name]) for name, found in readings.items()}
        away = {
            name: _distance(readings[name][site.name], readings["target"][site.name]) for name in ("prior", "learnt")
        }
        sites[site.name] = each | {"distance": away | {"floor": _distance(*(half[site.name] for half in halves))}}
    return Judged(distances, lost, sites)


def passed(
    learning: ParameterLearning, images: dict[str, Tensor], doubtful: dict[str, Tensor], careful: bool
) -> frozenset[str]:
    """Sites that keep their prior, by what is read in learnt renders, in the prior's and in the target: those of which
    learnt renders are surely farther from the target; where one is careful, those of which they are not surely nearer,
    as there is nothing to be learnt of them, or it was not. What is read of unclear sites is mostly what other sites
    make of it: they are learnt where renders with the other learnt sites alone, ``"without"`` among the doubtful, are
    surely farther. All sites together keep to the chance of a mistake that one comparison has: with thirty of them,
    three would be nearer by chance."""
    read, unclear = learning.site_rows(images), learning.tried.unclear
    if unclear:
        read |= {name: of for name, of in learning.site_rows(doubtful).items() if name in unclear}
    chance = (1 - SURE) / max(1, len(read))

    def passes(of: dict[str, tuple[Tensor, Tensor]], unclear: bool) -> bool:
        if careful or unclear:
            return not _nearer(chance, of["learnt"], of["without" if unclear else "prior"], of["target"])
        return _nearer(1 - SURE, of["prior"], of["learnt"], of["target"])

    return frozenset(name for name, of in read.items() if passes(of, name in unclear))


def _nearer(chance: float, *sources: tuple[Tensor, Tensor]) -> bool:
    """Whether the first rows are nearer to the last ones than the second are, but for so small a chance."""
    learnt, prior, target = (rows.double().numpy() for rows, _ in sources)
    of = tuple(image.numpy() for _, image in sources)
    if not min(map(len, of)):
        return False
    apart = farther(prior, learnt, target, images=(of[1], of[0], of[2]))
    return apart.one > apart.other and apart.share >= 1 - chance


def held_out(run: "RunFolder", guide: Guide, held: Tensor) -> HeldOut:
    """What judges guides while they are trained, by the same images and features."""
    embed = _embed()

    def look(learnt: ParameterGuide) -> Features:
        seed_everything(batch_seed(run.record["seed"], 6, 3))
        return embed(_renders(run, learnt.suited(run.model), guide, len(held)))

    return HeldOut(look, embed(held))


def _embed() -> Callable[[Tensor], Features]:
    from probscene.inference.features.pretrained import EfficientNetLite  # torchvision takes seconds to import

    embed = EfficientNetLite().embed
    return lambda images: embed(images).double().numpy()


def _renders(run: "RunFolder", model: SceneModel, guide: Guide, number: int) -> Tensor:
    observer = Observer(model, run.record["threads"])
    starts = range(0, number, RENDERED_AT_ONCE)
    parts = [observer.labelled(sample(model, guide, min(RENDERED_AT_ONCE, number - i))).image for i in starts]
    return torch.cat(parts)


def _quantiles(u: Tensor) -> list[float]:
    """Empty where nothing is read."""
    return np.quantile(u.numpy(), QUANTILES).tolist() if len(u) else []


def _distance(one: Tensor, other: Tensor) -> float | None:
    """None where nothing is read in one of them."""
    return float(wasserstein_distance(one.numpy(), other.numpy())) if len(one) and len(other) else None
