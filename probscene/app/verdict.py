"""Can a run be trusted? Its scenes, the prior's and the target's images through its own network, judged without labels.

Scenes are drawn and looked at as the fit has looked at them. For another domain the images' looks are asked, by
EfficientNet-Lite: counts of a strange image may be quite ordinary. Axis letters: N scenes, L images, D features.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from probscene.app.agreement import Agreement, agreement
from probscene.app.evaluate import Evaluation
from probscene.app.fit import Progress
from probscene.app.preview import Pixels, pixels, shrunk
from probscene.app.provenance import CHUNK, chunk_randomness
from probscene.app.run import Run
from probscene.app.seen import features_in, kept_features, own_net, threads
from probscene.app.view import View
from probscene.dataset import ImageFolder
from probscene.errors import DataError, ProbsceneError
from probscene.inference.features import FeatureNet
from probscene.inference.presets import Preset
from probscene.inference.trust import Trust, trust
from probscene.inference.two_sample import NEEDED
from probscene.policy import Policy
from probscene.sampling import sample

SCENES = 1000  # of the guide, and as many of the prior
LOOKS = 32  # images of each source that are compared by their looks, twice as many of the target's
SHOWN = 8  # images in each picture
THUMB = 128  # pixels
COUNT = 0.5  # of a count: what differs by less is the same


@dataclass(frozen=True, eq=False)
class Judged:
    """A verdict and what it was made from.

    Attributes:
        trust: the verdict and its figures; None where there is none.
        absent: why there is none.
        unlike: the real images farthest from any generated scene, indices of the target's images.
        strange: the generated scenes farthest from any real image, ``(H, W, 3)``.
        names: the files of ``unlike``.
        agreement: with the labels, where there are such.
    """

    trust: Trust | None
    absent: str = ""
    unlike: tuple[int, ...] = ()
    strange: tuple[Pixels, ...] = ()
    names: tuple[str, ...] = ()
    agreement: Agreement | None = None

    def record(self) -> dict[str, Any]:
        """For JSON."""
        if self.trust is None:
            return {"verdict": None, "because": self.absent}
        more = {"unlike_images": list(self.names)}
        if self.agreement is not None:
            more["labels"] = self.agreement.record(self.trust.verdict)
        return self.trust.record() | more


def judge(
    run: Run,
    target: ImageFolder,
    progress: Progress,
    num: int = SCENES,
    evaluation: Evaluation | None = None,
    seed: int = 0,
) -> Judged:
    """Judge a finished run by a folder of real images.

    Args:
        num: scenes of the guide, and as many of the prior.
        evaluation: with labels, what to hold the verdict against.

    Raises:
        ProbsceneError: fewer scenes than a verdict needs.
        RunError: see ``Run.guide`` and ``own_net``.
    """
    if num < NEEDED:
        raise ProbsceneError(f"Expected at least {NEEDED} scenes to judge by, actual {num}; or 0 for no verdict.")
    from probscene.inference.pretrained import EfficientNetLite  # torchvision takes seconds to import

    if len(target) < NEEDED:
        return Judged(
            None, f"Expected at least {NEEDED} real images for a verdict, actual {len(target)} in {target.path}."
        )
    preset, model, net, looks = Preset.of(run.record["preset"]), run.model, own_net(run), EfficientNetLite()
    policies = (run.guide(), model.pretraining_policy)
    done, total = 0, 2 * CHUNK * -(-num // CHUNK) + len(target)

    def each(images: int) -> None:
        nonlocal done
        done += images
        progress("judging", done, total, "")

    eyes = [_Eyes(net, looks, each, keep) for keep in (True, False)]
    scenes = [
        _features(run, policy, eye, preset.candidates, num, seed) for policy, eye in zip(policies, eyes, strict=True)
    ]
    real = _real(run, target, net, each)
    with threads(run.record["threads"]):
        spread = np.linspace(0, len(target) - 1, min(2 * LOOKS, len(target))).astype(int)
        seen = looks.embed(torch.stack([target.load(i) for i in spread]))
    try:
        found = trust(
            scenes[0].numpy(),
            real.numpy(),
            scenes[1].numpy(),
            tuple(net.names),
            resolution=COUNT if preset.features == "count" else 0.0,
            looks=(seen.numpy(), torch.cat([look for eye in eyes for look in eye.looks]).numpy()),
            seed=seed,
        )
    except DataError as error:
        return Judged(None, str(error))
    unlike = tuple(int(i) for i in found.figures.unlike.worst[:SHOWN])
    strange = tuple(eyes[0].thumbs[i] for i in found.figures.strange.worst[:SHOWN])
    names = tuple(target.paths[i].name for i in unlike)
    by_labels = None
    if evaluation is not None and "truth" in evaluation.sources:
        by_labels = agreement(*(evaluation.sources[name] for name in ("learnt", "truth")), evaluation.classes)
    return Judged(found, "", unlike, strange, names, by_labels)


class _Eyes:
    """A run's network that keeps small pictures of what it was shown, and the looks of the first few."""

    def __init__(self, net: FeatureNet, appearance: FeatureNet, each, keep: bool):
        self.net, self.appearance, self.each, self.keep = net, appearance, each, keep
        self.names, self.thumbs, self.looks, self.looked = net.names, [], [], 0

    def embed(self, images: Tensor) -> Tensor:
        if self.keep:
            self.thumbs += [shrunk(image, THUMB).copy() for image in pixels(images)]
        some = images[: max(0, LOOKS - self.looked)]
        if len(some):
            self.looks.append(self.appearance.embed(some))
            self.looked += len(some)
        self.each(len(images))
        return self.net.embed(images)


def _features(run: Run, policy: Policy, net: FeatureNet, candidates: int, num: int, seed: int) -> Tensor:
    """``(num, D)`` features of scenes, seen as the fit has seen them; the same for the same seed."""
    view = View(run.model, run.record["threads"])
    observe, parts = view.observe(net, candidates), []
    for chunk in range(-(-num // CHUNK)):
        with threads(1), chunk_randomness(seed, chunk):
            parts.append(observe(sample(run.model, policy, CHUNK)))
    return torch.cat(parts)[:num]


def _real(run: Run, target: ImageFolder, net: FeatureNet, each) -> Tensor:
    """The features that the fit kept where the images are the fit's, else new ones."""
    kept = kept_features(run, target)
    if kept is None:
        return features_in(run, target, net, each)
    each(len(target))
    return kept
