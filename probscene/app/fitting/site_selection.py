"""Learnt parameters, judged by images that nothing was learnt from.

Axis letters: L images, C H W.
"""

import hashlib
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.stats import wasserstein_distance
from torch import Tensor

from probscene.inference.guides.base import Guide
from probscene.inference.parameters.checkpoint_selection import HeldOutSet, uninformative_sites
from probscene.inference.parameters.guide import ParameterGuide
from probscene.inference.parameters.learning import ParameterLearning
from probscene.inference.parameters.tilting.learning import TiltingLearning
from probscene.inference.statistics.energy import CONFIDENCE, BootstrapTest, Features, bootstrap_test
from probscene.inference.training import batch_seed
from probscene.model import SceneModel
from probscene.sampling import sample, seed_everything

from .image_level import ImageLevelTraining
from .rendered_features import RENDERED_AT_ONCE, RenderedFeatures
from .run import RunFolder

QUANTILES = np.linspace(0, 1, 21)
LEAST_MOVED = 0.1  # of u; readings of little skill are off by as much in renders that merely resemble the target


class SiteSelection(NamedTuple):
    """For JSON.

    Attributes:
        distances: ``kept``, ``"learnt"`` or ``"prior"``, and the energy distances of renders with learnt parameters
            and with the prior's from the images. The guide passes sites of which what is read in its renders is surely
            farther from what is read in the images; where renders are no nearer, or the schedule says so, all of which
            it is not surely nearer. Unless the schedule says so, none is passed without which renders are surely
            farther. Where they are surely farther all the same, all are passed but those that bring them nearer alone.
            With the others the guide is kept, unless its renders are surely farther then.
        because: by learnt site that keeps its prior whatever else is learnt, why; see ``reset_low_skill_sites``.
        sites: by learnt site, what is read of u with the prior's parameters, with the learnt ones, and in the images:
            21 quantiles of each, and Wasserstein-1 distances from the images; the floor is that of their two halves.
    """

    distances: dict[str, Any]
    because: dict[str, str]
    sites: dict[str, dict[str, Any]]


def select_sites(
    run: RunFolder,
    guide: Guide,
    learning: ParameterLearning | ImageLevelTraining,
    held: Tensor,
    more: Callable[[], Tensor],
) -> SiteSelection:
    """By images ``held (L, C, H, W)`` and as many renders of each; their looks are EfficientNet's pooled features.
    Which sites are learnt takes ``more`` of them to tell, see ``prior_site_selector`` and ``reset_low_skill_sites``."""
    learnt = learning.guide
    if learnt is None:
        return SiteSelection({"kept": "prior"}, {}, {})
    judge = learning.best.held if isinstance(learning, ParameterLearning) and learning.best is not None else None
    look, images = _embed(), {"target": held}
    real = look(held) if judge is None else judge.real

    def drawn(name: str, model: SceneModel) -> Features:
        images[name] = _renders_of(run, model, guide, len(held), name)
        return look(images[name])

    of_prior = drawn("prior", run.model)

    def compared() -> BootstrapTest:
        return bootstrap_test(drawn("learnt", learnt.with_parameters(run.model)), of_prior, real)

    test = compared()
    kept, because = "learnt" if test.distance < test.baseline_distance else "prior", dict[str, str]()
    if isinstance(learning, ParameterLearning) and isinstance(learnt, ParameterGuide):
        well = frozenset(
            learning.select_prior_sites(learning, True) if learning.prior_sites is None else learning.prior_sites
        )
        badly = frozenset[str]()
        if learning.calibrated.low_skill_sites:
            seed_everything(batch_seed(run.record["seed"], 6, 4))
            badly, because = reset_low_skill_sites(learning, more(), well)
        learnt.prior_sites = well | badly
        if learnt.prior_sites:
            test = compared()
        if test.significant and judge is not None:
            learnt.prior_sites = uninformative_sites(learnt, judge) | because.keys()
            test = compared()
        kept = "prior" if test.significant or len(learnt.prior_sites) == len(learnt.sites) else "learnt"
        if kept == "prior":
            learnt.prior_sites = frozenset()
    if isinstance(learning, TiltingLearning) and not learning.learnt:
        kept = "prior"
    distances = {"kept": kept, "learnt": test.distance, "prior": test.baseline_distance}
    if not isinstance(learning, ParameterLearning):  # which reads nothing
        return SiteSelection(distances, {}, {})
    seed_everything(batch_seed(run.record["seed"], 6, 2))
    readings = {name: learning.calibrated.readings(some) for name, some in images.items()}
    halves = [learning.calibrated.readings(held[i::2]) for i in (0, 1)]
    sites = {}
    for site in learning.learnt:
        each = {name: _quantiles(found[site.name]) for name, found in readings.items()}
        away = {
            name: _distance(readings[name][site.name], readings["target"][site.name]) for name in ("prior", "learnt")
        }
        sites[site.name] = each | {"distance": away | {"floor": _distance(*(half[site.name] for half in halves))}}
    return SiteSelection(distances, because, sites)


def prior_site_selector(
    run: RunFolder, guide: Guide, held: Callable[[bool], Tensor], sure: bool
) -> Callable[[ParameterLearning, bool], frozenset[str]]:
    """What names sites that keep their prior, of those that are read well, as ``select_sites`` will have it: after each
    training of the guide, and for good before the others are learnt, which is done from renders that look like the
    target.

    Args:
        held: images by which it is told, ``(L, C, H, W)`` uint8; with True many, for good and where one has to be sure.
        sure: keep only sites that are surely nearer, see ``ParameterSchedule``.
    """
    look = _embed()
    known: dict[bytes, frozenset[str]] = {}

    @cache
    def constant(many: bool) -> dict[str, Tensor]:
        """Images of the target and of the prior, which stay as they are."""
        images = {"target": held(many)}
        return images | {"prior": _renders_of(run, run.model, guide, len(images["target"]), "prior")}

    @cache
    def of_prior() -> Features:
        return look(constant(False)["prior"])

    def named(learning: ParameterLearning, many: bool) -> frozenset[str]:
        assert learning.guide is not None and learning.best is not None
        images = constant(many)
        learnt = _renders_of(run, learning.guide.with_parameters(run.model), guide, len(images["target"]), "learnt")
        read = learning.site_rows(images | {"learnt": learnt})
        names = sites_to_reset(learning, read, True)
        if sure or not names:  # what is passed where one is not careful is a part of it
            return names
        judge = learning.best.held
        looks = judge.looks(learning.guide, frozenset())
        test = bootstrap_test(looks, of_prior(), judge.real)
        if test.distance < test.baseline_distance:
            names = sites_to_reset(learning, read, False)
        return redundant_resets(learning.guide, judge, looks, names)

    def settled(learning: ParameterLearning, last: bool) -> frozenset[str]:
        assert learning.guide is not None
        if last and sure:
            return named(learning, True)
        now = _digest(learning.guide.net.state_dict(), learning.calibrated.state())
        if now not in known:
            known[now] = named(learning, False)
        return known[now]

    return settled


def redundant_resets(
    guide: ParameterGuide, judge: HeldOutSet, looks: Features, names: frozenset[str]
) -> frozenset[str]:
    """Of some sites those without which renders are not surely farther from held-out images than with all, which have
    ``looks``: what is read of an object and of its sibling before hardly shows that a row is even, which whole images
    do."""
    without = {name: judge.looks(guide, frozenset((name,))) for name in sorted(names)}
    return frozenset(
        name for name, found in without.items() if not bootstrap_test(found, looks, judge.real).significant
    )


def sites_to_reset(
    learning: ParameterLearning, read: dict[str, dict[str, tuple[Tensor, Tensor]]], careful: bool
) -> frozenset[str]:
    """Sites that keep their prior, of those that are read well, by what is read in learnt renders, in the prior's and
    in the target: those of which learnt renders are surely farther from the target; where one is careful, all of
    which they are not surely nearer, as there is nothing to be learnt of them, or it was not. They keep to the chance
    of a mistake together that one comparison has: with thirty of them, three would be nearer by chance.

    Args:
        read: of ``"learnt"``, ``"prior"`` and ``"target"``, see ``ParameterLearning.site_rows``.
    """
    clear = {name: of for name, of in read.items() if name not in learning.calibrated.low_skill_sites}
    chance = (1 - CONFIDENCE) / max(1, len(clear))

    def passes(of: dict[str, tuple[Tensor, Tensor]]) -> bool:
        if careful:
            return _share(of, "prior", "learnt") < 1 - chance
        return _share(of, "learnt", "prior") >= CONFIDENCE

    return frozenset(name for name, of in clear.items() if passes(of))


@torch.no_grad()
def reset_low_skill_sites(
    learning: ParameterLearning, images: Tensor, kept: frozenset[str]
) -> tuple[frozenset[str], dict[str, str]]:
    """Sites that keep their prior, of those that are read with little skill; and why, of those among them that have no
    chance: they cannot be read in scenes like the target's, or are sites of scenes and differ by less than
    ``LEAST_MOVED`` (Wasserstein-1) from their prior.

    What is read of such a site is mostly what other sites make of it. So renders with it are compared with renders that
    have the same but its prior; and first it is seen which have a chance at all, as those that are learnt wrongly would
    be in the way of the others.

    Args:
        images: of the target, ``(L, C, H, W)`` uint8; nothing was learnt from them.
        kept: sites that are read well and keep their prior.
    """
    unclear = learning.calibrated.low_skill_sites
    without = learning.guide_scenes(kept | unclear)
    because = {
        name: f"in renders that look like the target {share:.0%} of its variance can be read"
        for name, share in learning.calibrated.unidentifiable_sites(without).items()
    }
    learnt = learning.guide_scenes(kept)
    for site, *u in zip(learning.scene_sites, without.overall.unbind(1), learnt.overall.unbind(1), strict=True):
        moved = _distance(*(some[~some.isnan()] for some in u)) or 0.0
        if site.name in unclear - because.keys() and moved < LEAST_MOVED:
            because[site.name] = f"it would be {moved:.2f} of u from its prior, no farther than it may be misread"
    renders = {"without": without.drawn.image, "learnt": learnt.drawn.image}
    read = learning.site_rows(renders | {"target": images})
    likely = [
        name for name in sorted(unclear - because.keys()) if _share(read[name], "without", "learnt") >= CONFIDENCE
    ]
    others, chance = unclear - set(likely), (1 - CONFIDENCE) / max(1, len(likely))
    if not likely:
        return others, because
    renders = {name: learning.guide_scenes(kept | others | {name}).drawn.image for name in likely}
    renders["learnt"] = learning.guide_scenes(kept | others).drawn.image
    read = learning.site_rows(renders | {"target": images})
    return others | {name for name in likely if _share(read[name], name, "learnt") < 1 - chance}, because


def _share(of: dict[str, tuple[Tensor, Tensor]], far: str, near: str) -> float:
    """Of bootstraps, in how many some rows are nearer to the target's than others are; 0 where they are not."""
    sources = [of[name] for name in (far, near, "target")]
    one, other, target = (rows.double().numpy() for rows, _ in sources)
    images = tuple(image.numpy() for _, image in sources)
    if not min(map(len, (one, other, target))):
        return 0.0
    test = bootstrap_test(one, other, target, images=(images[0], images[1], images[2]))
    return test.probability if test.distance > test.baseline_distance else 0.0


def _renders_of(run: RunFolder, model: SceneModel, guide: Guide, number: int, name: str) -> Tensor:
    """Renders with learnt parameters, or with the prior's."""
    seed_everything(batch_seed(run.record["seed"], 6, int(name == "prior")))
    return _renders(run, model, guide, number)


def held_out(run: RunFolder, guide: Guide, held: Tensor) -> HeldOutSet:
    """What judges guides while they are trained, by the same images and features. It remembers the latest weights'."""
    embed = _embed()
    of, known = b"", dict[frozenset[str], Features]()

    def look(learnt: ParameterGuide) -> Features:
        nonlocal of, known
        now = _digest(learnt.net.state_dict())
        if now != of:
            of, known = now, {}
        if learnt.prior_sites not in known:
            seed_everything(batch_seed(run.record["seed"], 6, 3))
            known[learnt.prior_sites] = embed(_renders(run, learnt.with_parameters(run.model), guide, len(held)))
        return known[learnt.prior_sites]

    return HeldOutSet(look, embed(held))


def _digest(*states: dict[str, Tensor]) -> bytes:
    """Of networks' states: other tensors have another one."""
    digest = hashlib.sha256()
    for state in states:
        for name, tensor in state.items():
            digest.update(name.encode() + tensor.numpy().tobytes())
    return digest.digest()


def _embed() -> Callable[[Tensor], Features]:
    from probscene.inference.features.pretrained import EfficientNetLite  # torchvision takes seconds to import

    embed = EfficientNetLite().embed
    return lambda images: embed(images).double().numpy()


def _renders(run: RunFolder, model: SceneModel, guide: Guide, number: int) -> Tensor:
    observer = RenderedFeatures(model, run.record["threads"])
    sizes = [min(RENDERED_AT_ONCE, number - i) for i in range(0, number, RENDERED_AT_ONCE)]
    return torch.cat([observer.labelled(sample(model, guide, size, density=False)).image for size in sizes])


def _quantiles(u: Tensor) -> list[float]:
    """Empty where nothing is read."""
    return np.quantile(u.numpy(), QUANTILES).tolist() if len(u) else []


def _distance(one: Tensor, other: Tensor) -> float | None:
    """None where nothing is read in one of them."""
    return float(wasserstein_distance(one.numpy(), other.numpy())) if len(one) and len(other) else None
