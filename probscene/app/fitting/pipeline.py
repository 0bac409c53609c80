"""The stages of a fit: from a model and unlabelled images to a learnt guide.

The feature network on prior renders, features of the target images, the guide's pretraining and the learning of
structure, of parameters, and of structure once more (``learnt``). Each goes on after an interruption to the same
result. Labels play no part, but for a handful that a feature network may be given.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor, nn

from probscene.dataset import ImageFolder, Images
from probscene.device import CPU, chosen_device
from probscene.errors import DataError, ProbsceneError, RunError
from probscene.inference.features.base import Detections, EmbedsTarget, FeatureNet, Placeable, embed_all
from probscene.inference.statistics.energy import MIN_IMAGES, check_features
from probscene.inference.training import Training, batch_seed
from probscene.policy import Policy
from probscene.sampling import seed_everything
from probscene.threads import threads

from ..files import write_json, write_text
from ..labels.partial_labels import PartialLabels, PartlyLabelledImages
from ..progress import Display, Progress
from ..workers.cluster import Cluster
from .cache import NetworkCache
from .outcome import conclude, feature_mask, give_up
from .parameter_stage import READER, learn_parameters
from .plugins import inner
from .rendered_features import RENDERED_AT_ONCE, RenderedFeatures
from .run import RunFolder
from .scene_features import fingerprint
from .store import OTHER, TIMING, Checkpointer, load_state, state_of, timing
from .structure_stage import FIRST, REFINEMENT, learn_structure, refine_structure

STAGES = (
    "reading", "likeness", "looking", "features", "readings", "target", "pretraining", "structure", "parameters",
    "refinement", "outcome",
)  # fmt: skip
"""Of ``progress.STAGES``, in their order."""


class Begun(NamedTuple):
    """A run that can be carried out.

    Attributes:
        run: its folder.
        images: of the target; None where the fit is finished, or where they are opened when they are asked for.
        labels: of some of the images.
        detections: of the images, by somebody's detector.
        net: its feature network, untrained, where it was built already.
    """

    run: RunFolder
    images: Images | None = None
    labels: PartialLabels | None = None
    detections: Detections | None = None
    net: FeatureNet | None = None


@dataclass(frozen=True)
class Execution:
    """How a fit is computed. Nothing of it but ``threads`` and ``device`` changes a result.

    Args:
        threads: of torch; as ``OMP_NUM_THREADS`` says, else all cores, where None. Another number rounds differently.
        cluster: the address of a Ray cluster whose nodes render scenes and read them while structure is learnt, see
            ``Cluster``. They have to see the run's folder by the same path.
        cache: whether trained feature networks are taken from the user's cache folder and kept there; or another
            folder.
        progress: show it, on stderr.
        device: of networks: ``"cpu"``, ``"cuda"``, ``"cuda:1"``, ``"mps"``, or ``"auto"``, see ``chosen_device``; the
            CPU where None, or the device that a resumed run was computed on last. Programs and rendering stay on the
            CPU, as do the networks of a cluster's nodes. Another device rounds differently.
    """

    threads: int | None = None
    cluster: str | None = None
    cache: Path | str | bool = True
    progress: bool = True
    device: str | None = None

    def device_for(self, run: RunFolder) -> torch.device:
        """Where the run's networks compute.

        Raises:
            ProbsceneError: see ``chosen_device``.
        """
        before = run.record.get("devices") or [str(CPU)]
        return chosen_device(before[-1] if self.device is None else self.device)


def carry_out(
    begun: Begun,
    show: Display,
    cache: Path | str | bool = True,
    cluster: Cluster | None = None,
    device: torch.device = CPU,
) -> Policy:
    """Finish a fit: take the stages that it lacks. ``timing.json`` in the run's folder then holds the seconds that each
    stage has taken, over all sittings that were not killed, and as ``other`` those that no stage has: together they are
    the whole.

    Args:
        cache: see ``Execution``.
        cluster: of which all nodes render scenes and read them while structure is learnt.
        device: of networks; the run's record lists those that it was computed on.

    Raises:
        DataError: the target cannot be used: see ``check_target`` and ``check_features``.
        RunError: it is not the one that the run was begun with.
        ProbsceneError: something in the fit is no longer finite; the last checkpoint stays.
    """
    run, before = begun.run, timing(begun.run)
    if run.is_finished:
        return run.guide
    if cluster is not None and run.objects:
        raise ProbsceneError(
            f"expected no cluster for a fit with parts in memory alone ({', '.join(run.objects)}); put model and parts "
            "in files, which nodes can open."
        )
    try:
        return _take_stages(begun, show, cache, cluster, device)
    finally:
        now = {stage: show.seconds.get(stage, 0.0) for stage in STAGES}
        now[OTHER] = show.elapsed - sum(show.seconds.values())
        spent = {stage: before.get(stage, 0.0) + seconds for stage, seconds in now.items()}
        write_json(run.path / TIMING, {stage: seconds for stage, seconds in spent.items() if seconds})


def _record_device(run: RunFolder, device: torch.device, say: Callable[[str], None]) -> None:
    """Add the device to the run's, and say so where it is another."""
    devices = run.record.setdefault("devices", [str(CPU)])
    if devices and devices[-1] != str(device):
        say(
            f"Note: this run was computed on {devices[-1]} so far and continues on {device}, which rounds differently; "
            "its bytes are those of neither alone."
        )
    if not devices or devices[-1] != str(device):
        devices.append(str(device))
        write_json(run.path / "run.json", run.record)


def _take_stages(
    begun: Begun, show: Display, cache_in: Path | str | bool, cluster: Cluster | None, device: torch.device
) -> Policy:
    run = begun.run
    _record_device(run, device, show.say)
    images = cache(lambda: open_target(run, show) if begun.images is None else begun.images)
    observer = RenderedFeatures(run.model, run.record["threads"])
    with threads(run.record["threads"]):
        net = _Network(begun, observer, show, images, device)
        net.finish(cache_in)
        run.keep_network(net.net)
        real = _real_features(run, net.net, show, images)
    which = feature_mask(net.net)
    with threads(1):  # the guide's tensors are tiny: a second thread only waits
        if which is not None and not which.any():
            message = give_up(run)
        else:
            guide = learn_structure(run, observer, net.net, real, show, cluster, device)
            if run.config.parameters is not None:
                with threads(run.record["threads"]):
                    learn_parameters(run, observer, net.net, guide, images, show, show.say, device)
                refine_structure(run, net.net, real, guide, images, show, cluster, device)
            message = conclude(run, observer, net.net, real[: len(images())], guide, begun.labels, show)
    for name in (f"{FIRST}-checkpoint", f"{REFINEMENT}-checkpoint", READER):
        (run.path / f"{name}.safetensors").unlink(missing_ok=True)
    if message:
        show.say(message)
    return run.guide


class _Network:
    """The run's feature network on its way to being trained."""

    def __init__(
        self,
        begun: Begun,
        observer: RenderedFeatures,
        show: Display,
        target: Callable[[], Images],
        device: torch.device,
    ):
        self.run, self.observer, self.progress, self.say, self.target = begun.run, observer, show, show.say, target
        self.photographs = cache(lambda: PartlyLabelledImages(target(), begun.labels, begun.detections))
        seed_everything(batch_seed(self.run.record["seed"], 0))
        self.net = self.run.build_network() if begun.net is None else begun.net
        module = inner(self.net)
        if isinstance(module, Placeable):
            module.place(device)

    def finish(self, cache_in: Path | str | bool) -> None:
        """Load it from the run or from the cache, else train it."""
        run, net = self.run, self.net
        tensors = run.read_tensors("features")
        if tensors is not None:
            load_state(net, tensors)
            self._check_taught()
            return
        training = run.features.training(inner(net), self.observer, self.photographs, run.record["seed"])
        if training is not None:
            self._finish(training, cache_in)
        _ready(net)
        found = run.features.adapt(inner(net), self.photographs, partial(self.progress, "readings"))
        if found:
            run.write_readings(found)
            for name, line in found.get("classes", {}).items():
                self.say(f"{name}: {line['because']}.")
        run.write_tensors("features", state_of(net))
        (run.path / "features-checkpoint.safetensors").unlink(missing_ok=True)

    def _finish(self, training: Training, cache_in: Path | str | bool) -> None:
        """Load what was trained before from the cache, else train."""
        run, net = self.run, self.net
        taught = run.features.target_fingerprint(inner(net))
        folder = None if isinstance(cache_in, bool) else Path(cache_in)
        kept = NetworkCache(run, inner(net), folder, taught) if cache_in is not False else None
        cached = None if kept is None else kept.load()
        if cached is not None and kept is not None:
            write_text(run.path / "log.jsonl", "".join(f"{line}\n" for line in cached.lines))
            load_state(net, cached.tensors)
            self.say(f"The feature network was trained before; it is in {kept.file}.")
        else:
            lines = self._train(training)
            if kept is not None:
                kept.save(state_of(net), lines)

    def _train(self, training: Training) -> list[str]:
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
            self.say(f"The network is right in {summary['accuracy']:.0%}; the paper demands {summary['demanded']:.0%}.")
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
    """Of every image, ``(L, D)``, then of its further crops, kept apart: a verdict is about L images."""
    images = target()
    cached = run.read_tensors("real")
    if cached is not None:
        if not torch.equal(fingerprint(images), cached["fingerprint"]):
            raise _others(images)
        return torch.cat([cached["features"], *([cached["views"]] if "views" in cached else [])])
    views, done = run.config.num_crops, 0

    def each(number: int) -> None:
        nonlocal done
        done += number
        progress("target", done, views * len(images), "")

    check_target(images)
    if isinstance(net, EmbedsTarget):
        features, others = net.embed_target(images.fingerprint), []
    else:
        features, *others = (
            embed_all(net, images.batches(RENDERED_AT_ONCE, view), each, real=True) for view in range(views)
        )
    which = feature_mask(net)
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
