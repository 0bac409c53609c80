"""``probscene fit``: from a model and a folder of unlabelled images to a run folder.

Four stages: the feature network on prior renders, features of the target images, the guide's pretraining, and the
learning of structure. Each goes on after an interruption to the same result. Only the images are read; labels play no
part.
"""

import dataclasses
import hashlib
import json
import os
import time
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

import probscene
from probscene.app.files import write_text
from probscene.app.loading import load_model, renderer_for
from probscene.app.run import Run
from probscene.batch import RenderBatch
from probscene.dataset import ImageFolder, grey
from probscene.derivation import Derivation
from probscene.errors import DataError, RunError
from probscene.inference.count_net import CountNet
from probscene.inference.count_training import CountTraining
from probscene.inference.features import Examples, FeatureNet, class_table, embed_all, examples
from probscene.inference.grouping import group_of
from probscene.inference.latent import Guide
from probscene.inference.learn import Learner
from probscene.inference.objective import ScoreFunction
from probscene.inference.presence_net import PresenceNet, PresenceTraining
from probscene.inference.presets import TRAINED, Preset
from probscene.inference.pretrain import pretrain
from probscene.inference.projection import Projected, discriminant, self_share
from probscene.inference.resume import batch_seed
from probscene.inference.two_sample import NEEDED, check_features
from probscene.model import SceneModel
from probscene.sampling import Scenes, realise, sample, seed_everything

Progress = Callable[[str, int, int, str], None]
"""Called with the stage, what of it is done, of how much, and a note such as the loss."""

SAVE_EVERY = 5.0  # seconds between checkpoints: what an interruption can cost
RENDERED_AT_ONCE = 64  # images in memory


def create(
    model: str, target: Path, out: Path, preset: Preset, seed: int, skip_bad: bool = False, threads: int | None = None
) -> Run:
    """A new run folder for a fit; the model is checked first, so that a wrong one leaves no folder behind.

    Args:
        threads: of torch; all that this process may use where None. Another number rounds differently, so it is
            recorded.

    Raises:
        ProbsceneError: see ``load_model`` and ``Run.create``.
    """
    loaded = load_model(model)
    if preset.features not in TRAINED:
        feature_net(preset, loaded)
    record = {
        "version": probscene.__version__,
        "target": str(Path(target).resolve()),
        "skip_bad": skip_bad,
        "seed": seed,
        "threads": threads or len(os.sched_getaffinity(0)),
        "preset": dataclasses.asdict(preset),
        "guide": preset.guide_settings(),
    }
    return Run.create(out, model, record)


def fit(run: Run, progress: Progress, target: ImageFolder | None = None) -> Guide:
    """Finish a run: take the stages that it lacks.

    Args:
        target: the run's target images, where they are open already.

    Raises:
        DataError: the target folder cannot be used: see ``check_target`` and ``check_features``.
        RunError: it is not the one that the run was begun with.
        ProbsceneError: something in the fit is no longer finite; the last checkpoint stays.
    """
    if (run.path / "guide.safetensors").is_file():
        return run.guide()
    preset, model, threads = Preset.of(run.record["preset"]), run.model, run.record["threads"]
    view = View(model, threads)
    torch.set_num_threads(threads)
    net = _feature_net(run, preset, view, progress)
    real = _real_features(run, net, model, progress, target)
    torch.set_num_threads(1)  # the guide's tensors are tiny: a second thread only waits
    guide = _learn(run, preset, model, view.observe(net, preset.candidates), real, progress)
    run.save("guide", guide.state_dict())
    (run.path / "guide-checkpoint.safetensors").unlink(missing_ok=True)
    return guide


class View:
    """A model seen through its renderer: labelled prior renders to train on, and features of scenes."""

    def __init__(self, model: SceneModel, threads: int):
        self.model, self.threads = model, threads
        self.render = renderer_for(model, threads)
        self.classes = class_table(model.grammar.kinds, model.classes)

    def draw(self, num: int) -> Examples:
        """``num`` labelled renders of the prior."""
        scenes = sample(self.model, self.model.prior, num)
        groups, grammar = self.model.groups, self.model.grammar
        by = ()
        if groups is not None:
            by = (group_of(scenes.derivation.kind, scenes.derivation.parent, grammar.kind(groups.kind)), groups.along)
        drawn = examples(self.render(scenes.drawing), self.classes, *by)
        return drawn._replace(image=self._as_read(drawn.image))

    def observe(self, net: FeatureNet, candidates: int = 1) -> Callable[[Scenes], Tensor]:
        """Render and embed, a few images at a time.

        Args:
            candidates: parameters are drawn so many times for each structure, and the drawing in which the least
                visible object shows most is kept: what covers an object says nothing about its structure.
        """

        def features(scenes: Scenes) -> Tensor:
            torch.set_num_threads(self.threads)
            starts = range(0, len(scenes.drawing), RENDERED_AT_ONCE)
            images = (self._clearest(scenes, slice(i, i + RENDERED_AT_ONCE), candidates) for i in starts)
            parts = [net.embed(self._as_read(some)) for some in images]
            torch.set_num_threads(1)
            return torch.cat(parts)

        return features

    def _as_read(self, images: Tensor) -> Tensor:
        """Renders ``(N, 3, H, W)`` as ``ImageFolder`` would read them from files, ``(N, channels, H, W)``."""
        return grey(images) if self.model.channels == 1 else images

    def _clearest(self, scenes: Scenes, rows: slice, candidates: int) -> Tensor:
        """Images ``(N, 3, H, W)``, each of the drawing that covers least of its least visible object."""
        batch, derivation = self.render(scenes.drawing[rows]), scenes.derivation[rows]
        image, best = batch.image, _least_visible(batch, derivation)
        for _ in range(candidates - 1):
            again = (best < 1).nonzero().flatten()  # nothing is clearer than what is whole
            if not len(again):
                break
            some = derivation[again]
            batch = self.render(realise(self.model, some).drawing)
            least = _least_visible(batch, some)
            better = least > best[again]
            image[again[better]], best[again[better]] = batch.image[better], least[better]
        return image


def _least_visible(batch: RenderBatch, derivation: Derivation) -> Tensor:
    """``(N,)`` visible fraction of the least visible object; what has others on it is meant to be covered."""
    parent = derivation.parent[:, : batch.kind.shape[1]]  # the program's own derivation has as many nodes as it needs
    carries = torch.zeros(len(parent), parent.shape[1] + 1, dtype=torch.bool)
    carries.scatter_(1, parent.where(parent >= 0, parent.shape[1]), True)
    return batch.visible.where((batch.kind >= 0) & ~carries[:, :-1], 1.0).amin(1)


def feature_net(preset: Preset, model: SceneModel) -> CountNet | PresenceNet | Projected:
    """The feature network of a preset, untrained, or pretrained with an empty projection.

    Raises:
        DataError: see ``Inception``.
    """
    if preset.features == "presence":
        return PresenceNet(model.classes)
    if preset.features != "count":
        from probscene.inference.pretrained import pretrained  # torchvision takes seconds to import

        net, file = pretrained(preset.features), preset.features.partition("=")[2]
        digest = hashlib.sha256(Path(file).read_bytes()).digest() if file else bytes(32)
        return Projected(net, preset.directions, digest)
    return CountNet(model.classes, model.channels, model.canvas, preset.width, preset.blocks, model.groups)


def _feature_net(run: Run, preset: Preset, view: View, progress: Progress) -> CountNet | PresenceNet | Projected:
    seed_everything(batch_seed(run.record["seed"], 0))
    net = feature_net(preset, view.model)
    tensors = run.load("features")
    if tensors is not None:
        net.load_state_dict(tensors)
    elif isinstance(net, Projected):
        _project(run, preset, view, net, progress)
    else:
        _train(run, preset, view, net, progress)
    return net.eval()


def _project(run: Run, preset: Preset, view: View, net: Projected, progress: Progress) -> None:
    """Two renders of each of some structures, in a minute or so; what is interrupted begins again."""
    seed_everything(batch_seed(run.record["seed"], 1))
    model, observe, parts = view.model, view.observe(net.pretrained), []
    policy = model.prior if model.pretraining is None else model.pretraining
    for first in range(0, preset.pairs, RENDERED_AT_ONCE):
        progress("features", first, preset.pairs, "")
        scenes = sample(model, policy, min(RENDERED_AT_ONCE, preset.pairs - first))
        parts.append((observe(scenes), observe(realise(model, scenes.derivation))))
    one, other = (torch.cat(part) for part in zip(*parts, strict=True))
    net.projection = discriminant(one, other, preset.directions, preset.num_scenes)
    share = self_share(net.projection(other[: preset.num_scenes]))
    ratio = net.ratio.tolist()
    note = f"variance over noise {ratio[0]:.1f} to {ratio[-1]:.1f}, own kernel's share {share:.2f}"
    progress("features", preset.pairs, preset.pairs, note)
    line = json.dumps({"stage": "projection", "ratio": ratio, "self_share": share})
    write_text(run.path / "log.jsonl", f"{line}\n")
    run.save("features", net.state_dict())


def _train(run: Run, preset: Preset, view: View, net: CountNet | PresenceNet, progress: Progress) -> None:
    seed = batch_seed(run.record["seed"], 1)
    if isinstance(net, PresenceNet):
        training = PresenceTraining(net, view.draw, preset.presence_images, preset.presence_epochs, seed=seed)
        steps = preset.presence_epochs
    else:
        training = CountTraining(net, view.draw, preset.count, seed=seed)
        steps = preset.count.steps
    keep = Keeper(run, "features", training)

    def each(training, loss):
        keep({"stage": "features", "step": training.done, "loss": loss})
        progress("features", training.done, steps, f"loss {loss:.3f}")

    progress("features", training.done, steps, "")
    training.run(each)
    keep.finish()
    run.save("features", net.state_dict())
    keep.forget()


def _real_features(
    run: Run, net: FeatureNet, model: SceneModel, progress: Progress, target: ImageFolder | None
) -> Tensor:
    if target is None:
        target = open_target(run, progress)
    cached = run.load("real")
    if cached is not None:
        if bytes(cached["fingerprint"].tolist()).hex() != target.fingerprint:
            raise RunError(
                f"Expected the target images in {target.path} as they were when the run began, actual others; put them "
                "back, or begin a new run."
            )
        return cached["features"]
    done = 0

    def each(images):
        nonlocal done
        done += images
        progress("target", done, len(target), "")

    check_target(target)
    features = embed_all(net, target.batches(RENDERED_AT_ONCE), each)
    check_features(features)
    fingerprint = torch.tensor(list(bytes.fromhex(target.fingerprint)), dtype=torch.uint8)
    run.save("real", {"features": features, "fingerprint": fingerprint})
    return features


def check_target(target: ImageFolder) -> None:
    """See that a density of features can be estimated from the images.

    Raises:
        DataError: too few, or all the same.
    """
    if len(target) < NEEDED:
        raise DataError(
            f"Expected at least {NEEDED} images in {target.path}, from which the distribution of their features is "
            f"estimated, actual {len(target)}; add images."
        )
    if target.distinct == 1:
        raise DataError(
            f"Expected images that differ in {target.path}, actual {len(target)} that are all the same; a distribution "
            "cannot be learnt from one image."
        )


def open_target(run: Run, progress: Progress) -> ImageFolder:
    """The run's target images.

    Raises:
        DataError: see ``ImageFolder``.
    """
    model = run.model
    return ImageFolder(
        run.record["target"],
        model.canvas,
        model.channels,
        run.record["skip_bad"],
        lambda done, total: progress("reading", done, total, ""),
    )


def _learn(
    run: Run, preset: Preset, model: SceneModel, observe: Callable[[Scenes], Tensor], real: Tensor, progress: Progress
) -> Guide:
    seed = run.record["seed"]
    seed_everything(batch_seed(seed, 2))
    guide = run.new_guide()
    objective = ScoreFunction(
        observe, preset.divergence(), baseline=preset.baseline, updates=preset.updates, scale=preset.scale
    )
    learner = Learner(
        model,
        guide,
        objective,
        real,
        preset.batches,
        preset.num_scenes,
        preset.num_real,
        preset.learning_rate,
        preset.cosine,
        seed=batch_seed(seed, 3),
    )
    keep = Keeper(run, "guide", learner)
    if learner.done == 0:
        epochs = preset.pretrain_epochs
        pretrain(
            guide,
            model.prior if model.pretraining is None else model.pretraining,
            preset.pretrain_derivations,
            epochs,
            learning_rate=preset.pretrain_rate,
            progress=lambda epoch, loss: progress("pretraining", epoch + 1, epochs, f"{loss:.2f} nats a scene"),
        )

    def each(learner, diagnostics):
        keep({"stage": "structure", **diagnostics})
        progress("structure", learner.done, preset.batches, f"cost {diagnostics['cost']:.3f}")

    learner.run(each)
    keep.finish()
    return guide


class Keeper:
    """Checkpoints of one training, at most every ``SAVE_EVERY`` seconds, with the lines of the log that belong to them.

    The log is written before the checkpoint, and lines past the checkpoint are dropped when a run goes on.
    """

    def __init__(self, run: Run, name: str, training):
        self.run, self.name, self.training = run, f"{name}-checkpoint", training
        self.log = run.path / "log.jsonl"
        self.lines = self.log.read_text(encoding="utf-8").splitlines() if self.log.exists() else []
        self.saved = time.monotonic()
        tensors = run.load(self.name)
        if tensors is not None:
            training.restore(tensors)
        stage = {"features": "features", "guide": "structure"}[name]
        self.lines = [line for line in self.lines if not self._is_past(json.loads(line), stage)]

    def __call__(self, line: dict[str, float | str]) -> None:
        self.lines.append(json.dumps(line))
        if time.monotonic() - self.saved > SAVE_EVERY:
            self._save()
            self.saved = time.monotonic()

    def finish(self) -> None:
        """Write the log to its end."""
        write_text(self.log, "".join(f"{line}\n" for line in self.lines))

    def forget(self) -> None:
        """Delete the checkpoint of a finished training."""
        (self.run.path / f"{self.name}.safetensors").unlink(missing_ok=True)

    def _save(self) -> None:
        self.finish()
        self.run.save(self.name, self.training.state())

    def _is_past(self, line: dict, stage: str) -> bool:
        return line["stage"] == stage and line.get("step", line.get("batch")) > self.training.done
