"""The diagnostics of a run: its scenes, the prior's and the target's images through its own network, without labels.

Structure is judged by scenes that are rendered and embedded as in the fit, layout and looks by half as many images as
``generate`` writes them (``source_features``). A domain shift is detected by EfficientNet-Lite's features of patches:
counts of an image from another domain may be quite ordinary, and objects may stand where no scene has them. It is not
tested where the features were adapted to the target's images and say what can be read in them: those are another
domain, and were read as such.

Axis letters: N scenes, L images, D features.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from probscene.dataset import Images
from probscene.errors import DataError, ProbsceneError
from probscene.inference.features.base import EmbedsLabels, Examples, FeatureNet, needs_images, objects_counted
from probscene.inference.statistics.energy import MIN_IMAGES
from probscene.inference.statistics.verdict import StructureVerdict, structure_verdict
from probscene.policy import Policy
from probscene.sampling import sample
from probscene.threads import threads

from ..chunks import CHUNK, chunk_randomness
from ..fitting.given_boxes import given_boxes
from ..fitting.outcome import feature_mask
from ..fitting.pipeline import Progress
from ..fitting.rendered_features import RenderedFeatures
from ..fitting.run import RunFolder
from ..fitting.scene_features import features_in, kept_features, own_net
from ..pictures import Pixels, pixels, shrunk
from . import sizes as size_figures
from . import source_features
from .components import VerdictComponents, verdict_components
from .evaluate import Evaluation
from .explain import label_images
from .label_agreement import Agreement, agreement
from .sizes import Sizes, sizes, with_sizes
from .source_features import LEARNT, PRIOR, TARGET

NUM_SCENES = 1000  # of the guide, and as many of the prior
NUM_EXAMPLES = 8  # images in each picture
THUMBNAIL_SIZE = 128  # pixels


@dataclass(frozen=True, eq=False)
class FitDiagnostics:
    """A verdict and what it was made from.

    Attributes:
        structure: the verdict on structure and its statistics; None where there is none.
        absent: why there is none.
        real_uncovered: the real images farthest from any generated scene, indices of the target's images.
        generated_uncovered: the generated scenes farthest from any real image, ``(H, W, 3)``.
        names: the files of ``real_uncovered``.
        agreement: with the labels, where there are such.
        prior_warning: what the model is too narrow for, one sentence, where that is known.
        usable: which classes can be read, in a sentence, where the features say so.
        components: structure, layout and looks; None where there is no verdict.
        basis: the images, their folder, whether the run was fitted to them, and the scenes of each side.
        sizes: of the objects of each class of which boxes were given.
    """

    structure: StructureVerdict | None
    absent: str = ""
    real_uncovered: tuple[int, ...] = ()
    generated_uncovered: tuple[Pixels, ...] = ()
    names: tuple[str, ...] = ()
    agreement: Agreement | None = None
    prior_warning: str = ""
    usable: str = ""
    components: VerdictComponents | None = None
    basis: dict[str, Any] = field(default_factory=dict)
    sizes: dict[str, Sizes] = field(default_factory=dict)

    def record(self) -> dict[str, Any]:
        """For JSON."""
        if self.structure is None or self.components is None:
            return {"verdict": None, "because": self.absent}
        more: dict[str, Any] = {"basis": self.basis, "unlike_images": list(self.names)}
        more |= {"usable": self.usable} if self.usable else {}
        more |= {"sizes": size_figures.record(self.sizes)} if self.sizes else {}
        if self.agreement is not None:
            more["labels"] = self.agreement.record(self.structure.verdict)
        parts = self.components.record()
        parts = parts if self.agreement is None else self.agreement.corrected(parts)
        return self.structure.record() | parts | more


def diagnose(
    run: RunFolder,
    target: Images,
    progress: Progress,
    num: int | None = None,
    evaluation: Evaluation | None = None,
    seed: int = 0,
) -> FitDiagnostics:
    """Judge a finished run by a folder of real images.

    Args:
        num: scenes of the guide, and as many of the prior; ``NUM_SCENES`` where None.
        evaluation: with labels, what to compare the verdict with.

    Raises:
        ProbsceneError: fewer scenes than a verdict needs.
        RunError: see ``RunFolder.guide`` and ``own_net``.
    """
    num = NUM_SCENES if num is None else num
    if num < MIN_IMAGES:
        raise ProbsceneError(f"expected at least {MIN_IMAGES} scenes to judge by, got {num}; or 0 for no verdict.")
    from probscene.inference.features.pretrained import EfficientNetLite  # torchvision takes seconds to import

    if run.readings and set(run.unread) == set(run.model.classes) - set(run.model.stuff):
        return FitDiagnostics(None, usable(run))
    if len(target) < MIN_IMAGES:
        return FitDiagnostics(
            None, f"expected at least {MIN_IMAGES} real images for a verdict, got {len(target)} in {target.path}."
        )
    training, model, net = run.config.structure, run.model, own_net(run)
    policies = (run.guide, model.pretraining_policy)
    own = kept_features(run, target) is not None
    boxes = None if evaluation is None else evaluation.boxes
    boxes = given_boxes(run, target) if boxes is None and own else boxes
    images = min(source_features.NUM_IMAGES, num // 2)
    total = 2 * CHUNK * -(-num // CHUNK) + len(target) + source_features.num_embedded(run, target, images)
    total += 0 if boxes is None else 2 * size_figures.NUM_SCENES
    done = 0

    def advance(more: int) -> None:
        nonlocal done
        done += more
        progress("judging", done, total, "")

    advance(0)
    made = _LabelThumbnailNet if isinstance(net, EmbedsLabels) else _ThumbnailNet
    nets = [made(net, advance, keep) for keep in (True, False)]
    draws = [1 if policy.with_parameters else training.draws_per_structure for policy in policies]
    scenes = [_features(run, *source, num, seed) for source in zip(policies, nets, draws, strict=True)]
    real = _real(run, target, net, advance)
    sources = source_features.embed_sources(run, target, net, EfficientNetLite(), advance, images, seed)
    rendered = np.concatenate([sources[name].patches for name in (LEARNT, PRIOR)])
    mask = feature_mask(net)
    mask = torch.ones(real.shape[1], dtype=torch.bool) if mask is None else mask
    generated, in_target, before = (
        objects_counted(net, features)[:, mask].numpy() for features in (scenes[0], real, scenes[1])
    )
    try:
        structure = structure_verdict(
            generated,
            in_target,
            before,
            tuple(name for name, kept in zip(net.names, mask.tolist(), strict=True) if kept),
            resolution=run.features.resolution,
            patches=None if run.readings else (sources[TARGET].patches, rendered),
            seed=seed,
        )
    except DataError as error:
        return FitDiagnostics(None, str(error))
    found = structure.statistics
    real_uncovered = tuple(int(i) for i in found.real_uncovered.worst[:NUM_EXAMPLES])
    names, label_agreement = tuple(target.paths[i].name for i in real_uncovered), None
    if evaluation is not None and "truth" in evaluation.sources:
        counts = evaluation.sources
        label_agreement = agreement(counts["learnt"], counts["truth"], evaluation.classes, label_images(run))
    features = {LEARNT: scenes[0], PRIOR: scenes[1], TARGET: real}
    box_sizes = {} if boxes is None else sizes(run, boxes, target, advance, seed)
    return FitDiagnostics(
        structure=structure,
        real_uncovered=real_uncovered,
        generated_uncovered=tuple(nets[0].thumbnails[i] for i in found.generated_uncovered.worst[:NUM_EXAMPLES]),
        names=names,
        agreement=label_agreement,
        prior_warning="" if evaluation is None else evaluation.prior_warning,
        usable=usable(run),
        components=with_sizes(verdict_components(run, structure, features, sources, seed), box_sizes),
        basis={"images": len(target), "folder": str(target.path), "fitted_to": own, "scenes": num},
        sizes=box_sizes,
    )


def usable(run: RunFolder) -> str:
    """Which classes can be used, in a sentence; empty where the features do not say so."""
    classes = run.readings.get("classes", {})
    things = [name for name in run.model.classes if name not in run.model.stuff]
    good = ", ".join(name for name in things if name in classes and name not in run.unread)
    bad = ", ".join(name for name in things if name in run.unread)
    if not classes or not bad:
        return f"All classes can be read in the target's images: {good}." if good else ""
    cannot = f"not readable in the target's images: {bad}, which keep the prior. Label ten images (probscene label)."
    return f"Usable: {good}; {cannot}" if good else f"No class is usable; {cannot}"


class _ThumbnailNet:
    """A run's network that keeps small pictures of the images that it embeds."""

    def __init__(self, net: FeatureNet, callback: Callable[[int], None], keep: bool):
        self.net, self.callback, self.keep = net, callback, keep
        self.names, self.thumbnails = net.names, []

    def embed(self, images: Tensor) -> Tensor:
        self._record(images)
        return self.net.embed(images)

    def _record(self, images: Tensor) -> None:
        if self.keep:
            self.thumbnails += [shrunk(image, THUMBNAIL_SIZE).copy() for image in pixels(images)]
        self.callback(len(images))


class _LabelThumbnailNet(_ThumbnailNet):
    """Of a network that embeds renders from their labels."""

    net: EmbedsLabels

    @property
    def uses_labels(self) -> bool:
        return not self.keep and not needs_images(self.net)

    def embed_from_labels(self, drawn: Examples) -> Tensor:
        self._record(drawn.image)
        return self.net.embed_from_labels(drawn)


def _features(run: RunFolder, policy: Policy, net: FeatureNet, draws_per_structure: int, num: int, seed: int) -> Tensor:
    """``(num, D)`` features of scenes, rendered as in the fit; the same for the same seed."""
    view = RenderedFeatures(run.model, run.record["threads"])
    observe, parts = view.observe(net, draws_per_structure), []
    for chunk in range(-(-num // CHUNK)):
        with threads(1), chunk_randomness(seed, chunk):
            parts.append(observe(sample(run.model, policy, CHUNK, density=False)))
    return torch.cat(parts)[:num]


def _real(run: RunFolder, target: Images, net: FeatureNet, callback: Callable[[int], None]) -> Tensor:
    """The features that the fit kept where the images are the fit's, else new ones."""
    kept = kept_features(run, target)
    if kept is None:
        return features_in(run, target, net, callback)
    callback(len(target))
    return kept
