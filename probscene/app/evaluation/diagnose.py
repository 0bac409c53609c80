"""Can a run be trusted? Its scenes, the prior's and the target's images through its own network, judged without labels.

Structure is judged by scenes that are drawn and looked at as the fit has looked at them, layout and looks by half as
many images as ``generate`` writes them (``judging.looked``). For another domain it is asked what stands out in images,
by EfficientNet-Lite: counts of a strange image may be quite ordinary, and objects may stand where no scene has them. It
is not asked where the features were suited to the target's images and say what can be read in them: those are another
domain, and were read as such.

Axis letters: N scenes, L images, D features.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from probscene.dataset import Images
from probscene.errors import DataError, ProbsceneError
from probscene.inference.features.base import Examples, FeatureNet
from probscene.inference.statistics.trust import Trust, trust
from probscene.inference.statistics.two_sample import NEEDED
from probscene.policy import Policy
from probscene.sampling import sample
from probscene.threads import threads

from ..chunks import CHUNK, chunk_randomness
from ..fitting.outcome import compared
from ..fitting.pipeline import Progress
from ..fitting.rendered_features import RenderedFeatures
from ..fitting.run import RunFolder
from ..fitting.scene_features import features_in, kept_features, own_net
from ..pictures import Pixels, pixels, shrunk
from . import sizes as size_figures
from . import source_features as looked
from .advice import label
from .components import VerdictComponents, aspects
from .evaluate import Evaluation
from .label_agreement import Agreement, agreement
from .sizes import Sizes, given_boxes, sizes, with_sizes

SCENES = 1000  # of the guide, and as many of the prior, whoever judges: a run has one verdict
SHOWN = 8  # images in each picture
THUMB = 128  # pixels


@dataclass(frozen=True, eq=False)
class FitDiagnostics:
    """A verdict and what it was made from.

    Attributes:
        trust: the verdict on structure and its figures; None where there is none.
        absent: why there is none.
        real_unmatched: the real images farthest from any generated scene, indices of the target's images.
        generated_unmatched: the generated scenes farthest from any real image, ``(H, W, 3)``.
        names: the files of ``real_unmatched``.
        agreement: with the labels, where there are such.
        walls: what the model is too narrow for, one sentence, where that is known.
        usable: which classes can be read, in a sentence, where the features say so.
        aspects: structure, layout and looks; None where there is no verdict.
        basis: the images, their folder, whether the run was fitted to them, and the scenes of each side.
        sizes: of the objects of each class of which boxes were given.
    """

    trust: Trust | None
    absent: str = ""
    real_unmatched: tuple[int, ...] = ()
    generated_unmatched: tuple[Pixels, ...] = ()
    names: tuple[str, ...] = ()
    agreement: Agreement | None = None
    walls: str = ""
    usable: str = ""
    aspects: VerdictComponents | None = None
    basis: dict[str, Any] = field(default_factory=dict)
    sizes: dict[str, Sizes] = field(default_factory=dict)

    def record(self) -> dict[str, Any]:
        """For JSON."""
        if self.trust is None or self.aspects is None:
            return {"verdict": None, "because": self.absent}
        more: dict[str, Any] = {"basis": self.basis, "unlike_images": list(self.names)}
        more |= {"usable": self.usable} if self.usable else {}
        more |= {"sizes": size_figures.record(self.sizes)} if self.sizes else {}
        if self.agreement is not None:
            more["labels"] = self.agreement.record(self.trust.verdict)
        parts = self.aspects.record()
        parts = parts if self.agreement is None else self.agreement.corrected(parts)
        return self.trust.record() | parts | more


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
        num: scenes of the guide, and as many of the prior; ``SCENES`` where None.
        evaluation: with labels, what to hold the verdict against.

    Raises:
        ProbsceneError: fewer scenes than a verdict needs.
        RunError: see ``RunFolder.guide`` and ``own_net``.
    """
    num = SCENES if num is None else num
    if num < NEEDED:
        raise ProbsceneError(f"expected at least {NEEDED} scenes to judge by, got {num}; or 0 for no verdict.")
    from probscene.inference.features.pretrained import EfficientNetLite  # torchvision takes seconds to import

    if run.readings and set(run.unread) == set(run.model.classes) - set(run.model.stuff):
        return FitDiagnostics(None, usable(run))
    if len(target) < NEEDED:
        return FitDiagnostics(
            None, f"expected at least {NEEDED} real images for a verdict, got {len(target)} in {target.path}."
        )
    preset, model, net = run.preset, run.model, own_net(run)
    policies = (run.guide, model.pretraining_policy)
    own = kept_features(run, target) is not None
    boxes = None if evaluation is None else evaluation.boxes
    boxes = given_boxes(run, target) if boxes is None and own else boxes
    images = min(looked.IMAGES, num // 2)
    total = 2 * CHUNK * -(-num // CHUNK) + len(target) + looked.number_of(run, target, images)
    total += 0 if boxes is None else 2 * size_figures.SCENES
    done = 0

    def each(more: int) -> None:
        nonlocal done
        done += more
        progress("judging", done, total, "")

    each(0)
    eyes = [_Eyes(net, each, keep) for keep in (True, False)]
    draws = [1 if policy.suits else preset.draws_per_structure for policy in policies]
    scenes = [_features(run, *each_of, num, seed) for each_of in zip(policies, eyes, draws, strict=True)]
    real = _real(run, target, net, each)
    seen = looked.look(run, target, net, EfficientNetLite(), each, images, seed)
    rendered = np.concatenate([seen[name].places for name in (looked.LEARNT, looked.PRIOR)])
    which = compared(net)
    which = torch.ones(real.shape[1], dtype=torch.bool) if which is None else which
    try:
        found = trust(
            scenes[0][:, which].numpy(),
            real[:, which].numpy(),
            scenes[1][:, which].numpy(),
            tuple(name for name, some in zip(net.names, which.tolist(), strict=True) if some),
            resolution=run.features.resolution,
            places=None if run.readings else (seen[looked.TARGET].places, rendered),
            seed=seed,
            pretrained=run.features.pretrained,
        )
    except DataError as error:
        return FitDiagnostics(None, str(error))
    real_unmatched = tuple(int(i) for i in found.figures.real_unmatched.worst[:SHOWN])
    generated_unmatched = tuple(eyes[0].thumbs[i] for i in found.figures.generated_unmatched.worst[:SHOWN])
    names = tuple(target.paths[i].name for i in real_unmatched)
    uses_labels = None
    if evaluation is not None and "truth" in evaluation.sources:
        sources = evaluation.sources
        uses_labels = agreement(sources["learnt"], sources["truth"], evaluation.classes, label(run))
    walls = "" if evaluation is None else evaluation.walls
    features = {looked.LEARNT: scenes[0], looked.PRIOR: scenes[1], looked.TARGET: real}
    found_sizes = {} if boxes is None else sizes(run, boxes, each, seed)
    parts = with_sizes(aspects(run, found, features, seen, seed), found_sizes)
    basis = {"images": len(target), "folder": str(target.path), "fitted_to": own, "scenes": num}
    shown = real_unmatched, generated_unmatched, names
    return FitDiagnostics(found, "", *shown, uses_labels, walls, usable(run), parts, basis, found_sizes)


def usable(run: RunFolder) -> str:
    """Which classes can be used, in a sentence; empty where the features do not say so."""
    classes = run.readings.get("classes", {})
    things = [name for name in run.model.classes if name not in run.model.stuff]
    good = ", ".join(name for name in things if name in classes and name not in run.unread)
    bad = ", ".join(name for name in things if name in run.unread)
    if not classes or not bad:
        return f"All classes can be read in the target's images: {good}." if good else ""
    cannot = f"{bad} cannot be read in the target's images and keep the prior: label ten of them (probscene label)."
    return f"Can be used: {good}; {cannot}" if good else f"No class can be used: {cannot}"


class _Eyes:
    """A run's network that keeps small pictures of what it was shown."""

    def __init__(self, net: FeatureNet, each, keep: bool):
        self.net, self.each, self.keep = net, each, keep
        self.names, self.thumbs = net.names, []
        if hasattr(net, "embed_from_labels"):
            self.embed_from_labels = self._embed_drawn
            self.uses_labels = not keep and getattr(net, "uses_labels", False)

    def embed(self, images: Tensor) -> Tensor:
        self._look(images)
        return self.net.embed(images)

    def _embed_drawn(self, drawn: Examples) -> Tensor:
        self._look(drawn.image)
        return self.net.embed_from_labels(drawn)  # pyright: ignore[reportAttributeAccessIssue]: asked for before

    def _look(self, images: Tensor) -> None:
        if self.keep:
            self.thumbs += [shrunk(image, THUMB).copy() for image in pixels(images)]
        self.each(len(images))


def _features(run: RunFolder, policy: Policy, net: FeatureNet, draws_per_structure: int, num: int, seed: int) -> Tensor:
    """``(num, D)`` features of scenes, seen as the fit has seen them; the same for the same seed."""
    view = RenderedFeatures(run.model, run.record["threads"])
    observe, parts = view.observe(net, draws_per_structure), []
    for chunk in range(-(-num // CHUNK)):
        with threads(1), chunk_randomness(seed, chunk):
            parts.append(observe(sample(run.model, policy, CHUNK, density=False)))
    return torch.cat(parts)[:num]


def _real(run: RunFolder, target: Images, net: FeatureNet, each) -> Tensor:
    """The features that the fit kept where the images are the fit's, else new ones."""
    kept = kept_features(run, target)
    if kept is None:
        return features_in(run, target, net, each)
    each(len(target))
    return kept
