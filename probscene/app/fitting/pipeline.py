"""The stages of a fit: from a model and unlabelled images to a learnt guide.

The feature network on prior renders, features of the target images, the guide's pretraining and the learning of
structure, of parameters, and of structure once more (``learnt``). Each goes on after an interruption to the same
result. Labels play no part, but for a handful that a feature network may be given.
"""

import json
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path

import torch
from torch import Tensor, nn

from probscene.dataset import ImageFolder, Images
from probscene.errors import DataError, ProbsceneError, RunError
from probscene.inference.features.base import FeatureNet, embed_all
from probscene.inference.statistics.energy import MIN_IMAGES, check_features
from probscene.inference.training import Training, batch_seed
from probscene.policy import Policy
from probscene.sampling import seed_everything
from probscene.threads import threads

from ..files import write_text
from ..labels.partial_labels import PartialLabels, PartlyLabelled
from ..progress import Progress
from ..workers.cluster import Cluster
from .cache import NetworkCache
from .outcome import compared, conclude, give_up
from .parameter_stage import READER, learn_parameters
from .plugins import inner
from .rendered_features import RENDERED_AT_ONCE, RenderedFeatures
from .run import RunFolder
from .scene_features import fingerprint
from .store import Checkpointer, load_state, state_of
from .structure_stage import AGAIN, FIRST, learn_structure, learn_structure_again

Say = Callable[[str], None]
"""Told a sentence that a person should know."""


def fit(
    run: RunFolder,
    progress: Progress,
    target: Images | None = None,
    cache_in: Path | None = None,
    use_cache: bool = True,
    say: Say | None = None,
    labels: PartialLabels | None = None,
    cluster: Cluster | None = None,
) -> Policy:
    """Finish a run: take the stages that it lacks.

    Args:
        target: the run's target images, where they are open already.
        cache_in: the folder in which trained feature networks are kept; the user's cache where None.
        use_cache: whether to look there at all.
        say: is told where a network came from there.
        labels: of some of the target's images, for features that take them.
        cluster: of which all nodes render scenes and read them while structure is learnt. They have to see the run's
            folder by the same path.

    Raises:
        DataError: the target cannot be used: see ``check_target`` and ``check_features``.
        RunError: it is not the one that the run was begun with.
        ProbsceneError: something in the fit is no longer finite; the last checkpoint stays.
    """
    if run.is_finished:
        return run.guide
    if cluster is not None and run.objects:
        raise ProbsceneError(
            f"expected no cluster for a fit with parts in memory alone ({', '.join(run.objects)}); put model and parts "
            "in files, which nodes can open."
        )
    images = cache(lambda: open_target(run, progress) if target is None else target)
    observer = RenderedFeatures(run.model, run.record["threads"])
    with threads(run.record["threads"]):
        net = _Network(run, observer, progress, images, labels)
        net.finish(cache_in, use_cache, say or (lambda text: None))
        run.keep_network(net.net)
        real = _real_features(run, net.net, progress, images)
    which = compared(net.net)
    with threads(1):  # the guide's tensors are tiny: a second thread only waits
        if which is not None and not which.any():
            said = give_up(run)
        else:
            guide = learn_structure(run, observer, net.net, real, progress, cluster)
            if "parameters" in run.preset.learn:
                with threads(run.record["threads"]):
                    learn_parameters(run, observer, net.net, guide, images, progress, say or (lambda text: None))
                learn_structure_again(run, net.net, real, guide, images, progress, cluster)
            said = conclude(run, observer, net.net, real[: len(images())], guide, progress)
    for name in (f"{FIRST}-checkpoint", f"{AGAIN}-checkpoint", READER):
        (run.path / f"{name}.safetensors").unlink(missing_ok=True)
    if said and say is not None:
        say(said)
    return run.guide


class _Network:
    """The run's feature network on its way to being trained."""

    def __init__(
        self,
        run: RunFolder,
        observer: RenderedFeatures,
        progress: Progress,
        target: Callable[[], Images],
        labels: PartialLabels | None,
    ):
        self.run, self.observer, self.progress, self.target = run, observer, progress, target
        self.photographs = cache(lambda: PartlyLabelled(target(), labels))
        seed_everything(batch_seed(run.record["seed"], 0))
        self.net = run.build_network() if run.built is None else run.built
        run.built = None

    def finish(self, folder: Path | None, use_cache: bool, say: Say) -> None:
        """Load it from the run or from the cache, else train it."""
        run, net = self.run, self.net
        tensors = run.read_tensors("features")
        if tensors is not None:
            load_state(net, tensors)
            self._check_taught()
            return
        training = run.features.training(inner(net), self.observer, self.photographs, run.record["seed"])
        if training is not None:
            self._finish(training, folder, use_cache, say)
        _ready(net)
        found = run.features.adapt(inner(net), self.photographs, partial(self.progress, "readings"))
        if found:
            run.write_readings(found)
            for name, line in found.get("classes", {}).items():
                say(f"{name}: {line['because']}.")
        run.write_tensors("features", state_of(net))
        (run.path / "features-checkpoint.safetensors").unlink(missing_ok=True)

    def _finish(self, training: Training, folder: Path | None, use_cache: bool, say: Say) -> None:
        """Load what was trained before from the cache, else train."""
        run, net = self.run, self.net
        taught = run.features.target_fingerprint(inner(net))
        kept = NetworkCache(run, inner(net), folder, taught) if use_cache else None
        cached = None if kept is None else kept.load()
        if cached is not None and kept is not None:
            write_text(run.path / "log.jsonl", "".join(f"{line}\n" for line in cached.lines))
            load_state(net, cached.tensors)
            say(f"The feature network was trained before; it is in {kept.file}.")
        else:
            lines = self._train(training, say)
            if kept is not None:
                kept.save(state_of(net), lines)

    def _train(self, training: Training, say: Say) -> list[str]:
        keep = Checkpointer(self.run, "features", training)
        self._check_taught()

        def each(training: Training, line: dict[str, float]) -> None:
            if "images" in line:
                self.progress("looking", int(line["images"]), int(line["of"]), "")
                return
            line = {name: value.item() if isinstance(value, Tensor) else value for name, value in line.items()}
            note = ", ".join(f"{name} {value:.3f}" for name, value in line.items())
            keep({"stage": "features", "step": training.done, **line} if "loss" in line else None)
            self.progress("features", training.done, training.total, note, training.unit)

        training.run(each)
        summary = training.summary()
        if summary:
            keep.lines.append(json.dumps(summary))
        if summary.get("accuracy", 1.0) < summary.get("demanded", 0.0):
            say(f"The network is right in {summary['accuracy']:.0%}; the paper demands {summary['demanded']:.0%}.")
        keep.finish()
        return keep.lines

    def _check_taught(self) -> None:
        """See that a network that taught itself on images did so on those of the run, begun anew or going on."""
        target_fingerprint = self.run.features.target_fingerprint(inner(self.net))
        if target_fingerprint and self.target().fingerprint != target_fingerprint:
            raise _others(self.target())


def _ready(net: FeatureNet) -> None:
    """A module is used in the mode in which no answer depends on a batch."""
    module = inner(net)
    if isinstance(module, nn.Module):
        module.eval()


def _real_features(run: RunFolder, net: FeatureNet, progress: Progress, target: Callable[[], Images]) -> Tensor:
    """Of every image, ``(L, D)``, then of the preset's further views, kept apart: a verdict is about L images."""
    images = target()
    cached = run.read_tensors("real")
    if cached is not None:
        if not torch.equal(fingerprint(images), cached["fingerprint"]):
            raise _others(images)
        return torch.cat([cached["features"], *([cached["views"]] if "views" in cached else [])])
    views, done = run.preset.views, 0

    def each(number: int) -> None:
        nonlocal done
        done += number
        progress("target", done, views * len(images), "")

    check_target(images)
    features, *others = (
        embed_all(net, images.batches(RENDERED_AT_ONCE, view), each, real=True) for view in range(views)
    )
    which = compared(net)
    if which is None or which.any():
        check_features(features)
    kept = {"features": features, "fingerprint": fingerprint(images)}
    run.write_tensors("real", kept | ({"views": torch.cat(others)} if others else {}))
    return torch.cat([features, *others])


def _others(target: Images) -> RunError:
    return RunError(
        f"expected the target images in {target.path} as they were when the run began, got others; put them back, "
        "or begin a new run."
    )


def check_target(target: Images) -> None:
    """See that a density of features can be estimated from the images.

    Raises:
        DataError: too few, or all the same.
    """
    if len(target) < MIN_IMAGES:
        raise DataError(
            f"expected at least {MIN_IMAGES} images in {target.path}, from which the distribution of their features is "
            f"estimated, got {len(target)}; add images."
        )
    if target.distinct == 1:
        raise DataError(
            f"expected images that differ in {target.path}, got {len(target)} that are all the same; a distribution "
            "cannot be learnt from one image."
        )


def open_target(run: RunFolder, progress: Progress) -> Images:
    """The run's target images.

    Raises:
        RunError: they were in memory alone.
        DataError: see ``ImageFolder``.
    """
    model, target = run.model, run.record["target"]
    if target is None:
        raise RunError(
            f"expected the images that the run in {run.path} was begun with, got none: they were in memory. Give "
            "them again: as the target of the command, or from Python, probscene.fit(..., resume=True) for a fit."
        )
    return ImageFolder(
        target if isinstance(target, list) else Path(target),
        model.canvas,
        model.channels,
        run.record["skip_bad"],
        lambda done, total: progress("reading", done, total, ""),
        run.record.get("value_range"),
    )
