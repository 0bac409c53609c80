"""``probscene evaluate``: which structures are learnt, beside the prior's, the truth's and what the network sees.

Sources of counts: ``prior`` and ``learnt`` are sampled structures; ``truth`` is a ``counts.csv`` of the target's
images; ``estimate`` is what the run's feature network counts in them, rounded. The last is no truth: the network learnt
on prior renders alone and errs where objects crowd, but it is there without a single label.

Axis letters: N scenes, L images, C classes.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

import probscene
from probscene.app.fit import RENDERED_AT_ONCE, Progress, feature_net
from probscene.app.labels import Counts, class_counts
from probscene.app.provenance import chunk_randomness
from probscene.app.run import Run
from probscene.dataset import ImageFolder
from probscene.derive import derive_complete
from probscene.errors import ProbsceneError, RunError
from probscene.inference.features import embed_all
from probscene.inference.metrics import (
    Histogram,
    histogram,
    histogram_interval,
    pooled_shares,
    pooled_shares_interval,
    total_variation,
    wasserstein,
)
from probscene.inference.presets import Preset
from probscene.model import SceneModel
from probscene.policy import Policy

SAMPLED_AT_ONCE = 500


@dataclass(frozen=True, eq=False)
class Source:
    """Counts of one source.

    Attributes:
        counts: ``(N, C)`` int64.
        total: ``(N,)`` int64 objects of all classes; an estimate's is rounded by itself.
    """

    counts: Counts
    total: Counts

    @staticmethod
    def of(counts: Counts) -> "Source":
        return Source(counts, counts.sum(1))

    def number(self) -> Histogram:
        """Shares of scenes with 0, 1, 2, ... objects."""
        return histogram_interval(self.total)

    def classes(self) -> Histogram:
        """Shares of the classes among all objects, ``(C,)``."""
        return pooled_shares_interval(self.counts)


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Counts by source; see the module.

    Attributes:
        run: the run.
        target: path of the target's images.
        classes: the C names.
        sources: ``prior``, ``learnt``, then ``truth`` and ``estimate`` where they are known.
    """

    run: Run
    target: Path
    classes: tuple[str, ...]
    sources: dict[str, Source]

    def distance(self, a: str, b: str) -> dict[str, Any]:
        """How far source ``a`` is from ``b``: total variation of the number of objects and of the pooled class shares,
        Wasserstein-1 of the number in objects an image, and the total variation of each class's own counts. Shares of
        a source without objects are not compared: None."""
        one, other = self.sources[a], self.sources[b]
        number = histogram(one.total), histogram(other.total)
        shares = pooled_shares(one.counts), pooled_shares(other.counts)
        each = {
            name: total_variation(histogram(one.counts[:, c]), histogram(other.counts[:, c]))
            for c, name in enumerate(self.classes)
        }
        return {
            "number": total_variation(*number),
            "number_wasserstein": wasserstein(*number),
            "classes": total_variation(*shares) if shares[0].any() and shares[1].any() else None,
            "each_class": each,
        }

    def distances(self) -> dict[str, dict[str, dict[str, Any]]]:
        """From prior and learnt to the truth and to the estimate, where there are such."""
        known = [name for name in ("truth", "estimate") if name in self.sources]
        return {b: {a: self.distance(a, b) for a in ("prior", "learnt")} for b in known}

    def record(self) -> dict[str, Any]:
        """Everything, for JSON."""
        return {
            "version": probscene.__version__,
            "run": str(self.run.path),
            "guide_sha256": self.run.guide_hash(),
            "model": self.run.record["model"],
            "target": str(self.target),
            "classes": list(self.classes),
            "distances": self.distances(),
            "sources": {name: self._source(source) for name, source in self.sources.items()},
        }

    def _source(self, source: Source) -> dict[str, Any]:
        return {
            "scenes": len(source.total),
            "mean_number": float(source.total.mean()),
            "number": _plain(source.number()),
            "classes": _plain(source.classes()),
            "each_class": {name: histogram(source.counts[:, c]).tolist() for c, name in enumerate(self.classes)},
        }


def evaluate(
    run: Run, target: ImageFolder | None, truth: Counts | None, progress: Progress, num: int = 10000, seed: int = 0
) -> Evaluation:
    """Sample structures of the prior and of the guide and count, beside the truth and the network's estimate.

    Args:
        target: its images; without them there is only the run's own record of what the network saw.
        truth: ``(L, C)`` counts of the target's images.
        num: structures a source.

    Raises:
        ProbsceneError: a number that is not positive.
        RunError: the fit is not finished.
    """
    if num < 1:
        raise ProbsceneError(f"Expected a positive number of scenes, actual {num}.")
    model, guide = run.model, run.guide()
    done = 0

    def each(scenes):
        nonlocal done
        done += scenes
        progress("counting", done, 2 * num, "")

    sources = {
        name: Source.of(structure_counts(model, policy, num, seed, each))
        for name, policy in (("prior", model.prior), ("learnt", guide))
    }
    if truth is not None:
        sources["truth"] = Source.of(truth)
    estimate = network_counts(run, target, progress)
    if estimate is not None:
        sources["estimate"] = estimate
    path = Path(run.record["target"]) if target is None else target.path
    return Evaluation(run, path, model.classes, sources)


def structure_counts(
    model: SceneModel, policy: Policy, num: int, seed: int, each: Callable[[int], None] | None = None
) -> Counts:
    """Class counts ``(num, C)`` of structures that a policy derives; nothing is rendered."""
    torch.set_num_threads(1)  # the guide's tensors are tiny
    parts = []
    for number, first in enumerate(range(0, num, SAMPLED_AT_ONCE)):
        size = min(SAMPLED_AT_ONCE, num - first)
        with chunk_randomness(seed, number):
            derivation, _ = derive_complete(model.grammar, policy, size, model.max_steps)
        parts.append(class_counts(model, derivation))
        if each is not None:
            each(size)
    return np.concatenate(parts)


def network_counts(run: Run, target: ImageFolder | None, progress: Progress) -> Source | None:
    """What the run's feature network counts in the target's images, rounded; None where it does not count.

    The features that the fit kept are taken where the images are the fit's, else the images are embedded anew.
    """
    preset, model = Preset.of(run.record["preset"]), run.model
    if preset.features != "count":
        return None
    kept = run.load("real")
    if target is None or (kept is not None and bytes(kept["fingerprint"].tolist()).hex() == target.fingerprint):
        features = None if kept is None else kept["features"]
    else:
        features = _embedded(run, preset, target, progress)
    if features is None:
        return None
    rounded = features.round().clamp(min=0).long().numpy()
    C = len(model.classes)
    return Source(rounded[:, :C], rounded[:, C])


def _embedded(run: Run, preset: Preset, target: ImageFolder, progress: Progress) -> torch.Tensor:
    net, tensors, done = feature_net(preset, run.model), run.load("features"), 0
    if tensors is None:
        raise RunError(f"Expected the feature network in {run.path}, actual none; go on with --resume.")
    net.load_state_dict(tensors)

    def each(images):
        nonlocal done
        done += images
        progress("target", done, len(target), "")

    torch.set_num_threads(run.record["threads"])
    return embed_all(net.eval(), target.batches(RENDERED_AT_ONCE), each)


def _plain(found: Histogram) -> dict[str, list[float]]:
    return {key: value.tolist() for key, value in found._asdict().items()}
