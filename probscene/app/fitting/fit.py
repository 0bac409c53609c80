"""``probscene fit``: from a model and a folder of unlabelled images to a run folder.

Four stages: the feature network on prior renders, features of the target images, the guide's pretraining, and the
learning of structure. Each goes on after an interruption to the same result. Only the images are read; labels play no
part.
"""

import dataclasses
import json
import os
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path

import torch
from torch import Tensor

import probscene
from probscene.dataset import ImageFolder
from probscene.errors import DataError, RunError
from probscene.inference.divergence import Blockwise, Divergence
from probscene.inference.features.base import FeatureNet, embed_all
from probscene.inference.features.counting.training import CountTraining
from probscene.inference.features.presence import PresenceNet, PresenceTraining
from probscene.inference.features.projection import Projected, discriminant, self_share
from probscene.inference.guides.base import Guide
from probscene.inference.judging.two_sample import NEEDED, check_features
from probscene.inference.learn import Trainer
from probscene.inference.objective import ScoreFunction
from probscene.inference.pretrain import pretrain
from probscene.inference.training import batch_seed
from probscene.model import SceneModel
from probscene.sampling import Scenes, run_program, sample, seed_everything

from ..files import write_text
from ..loading import load_model
from .checkpoints import Keeper
from .observer import RENDERED_AT_ONCE, Observer, feature_net
from .presets import COUNT_ON_PRETRAINED, TRAINED, Preset
from .run import Run
from .scene_features import fingerprint

Progress = Callable[[str, int, int, str], None]
"""Called with the stage, what of it is done, of how much, and a note such as the loss."""


def create(
    model: str,
    target: Path,
    out: Path,
    preset: Preset,
    seed: int,
    skip_bad: bool = False,
    threads: int | None = None,
    assets: Path | None = None,
) -> Run:
    """A new run folder for a fit; the model is checked first, so that a wrong one leaves no folder behind.

    Args:
        threads: of torch; all that this process may use where None. Another number rounds differently, so it is
            recorded.
        assets: a folder that the model is drawn with.

    Raises:
        ProbsceneError: see ``load_model`` and ``Run.create``.
    """
    loaded = load_model(model, assets)
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
    return Run.create(out, model, record, assets)


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
    view = Observer(model, threads)
    torch.set_num_threads(threads)
    images = cache(lambda: open_target(run, progress) if target is None else target)
    net = _feature_net(run, preset, view, progress, images)
    real = _real_features(run, net, progress, images)
    torch.set_num_threads(1)  # the guide's tensors are tiny: a second thread only waits
    divergence = preset.divergence()
    if preset.features == COUNT_ON_PRETRAINED:
        joint = dataclasses.replace(preset, marginal_variance=None).divergence()
        divergence = Blockwise(net.blocks, (divergence, None, joint))
    guide = _learn(run, preset, model, view.observe(net, preset.draws_per_structure), divergence, real, progress)
    run.save("guide", guide.state_dict())
    (run.path / "guide-checkpoint.safetensors").unlink(missing_ok=True)
    return guide


def _feature_net(
    run: Run, preset: Preset, view: Observer, progress: Progress, target: Callable[[], ImageFolder]
) -> FeatureNet:
    seed_everything(batch_seed(run.record["seed"], 0))
    net = feature_net(preset, view.model)
    tensors = run.load("features")
    if tensors is not None:
        net.load_state_dict(tensors)
    elif isinstance(net, Projected):
        _project(run, preset, view, net, progress)
    else:
        _train(run, preset, view, net, progress, target)
    return net.eval()


def _project(run: Run, preset: Preset, view: Observer, net: Projected, progress: Progress) -> None:
    """Two renders of each of some structures, in a minute or so; what is interrupted begins again."""
    seed_everything(batch_seed(run.record["seed"], 1))
    model, observe, parts = view.model, view.observe(net.pretrained), []
    policy = model.pretraining_policy
    for first in range(0, preset.pairs, RENDERED_AT_ONCE):
        progress("features", first, preset.pairs, "")
        scenes = sample(model, policy, min(RENDERED_AT_ONCE, preset.pairs - first))
        parts.append((observe(scenes), observe(run_program(model, scenes.derivation))))
    one, other = (torch.cat(part) for part in zip(*parts, strict=True))
    net.projection = discriminant(one, other, preset.directions, preset.num_scenes)
    share = self_share(net.projection(other[: preset.num_scenes]))
    ratio = net.ratio.tolist()
    note = f"variance over noise {ratio[0]:.1f} to {ratio[-1]:.1f}, own kernel's share {share:.2f}"
    progress("features", preset.pairs, preset.pairs, note)
    line = json.dumps({"stage": "projection", "ratio": ratio, "self_share": share})
    write_text(run.path / "log.jsonl", f"{line}\n")
    run.save("features", net.state_dict())


def _train(
    run: Run, preset: Preset, view: Observer, net: FeatureNet, progress: Progress, target: Callable[[], ImageFolder]
) -> None:
    seed = batch_seed(run.record["seed"], 1)
    if preset.features == COUNT_ON_PRETRAINED:
        from probscene.inference.features.counting.pretrained_training import (
            PretrainedCountTraining,  # torchvision takes seconds
        )

        # Of the prior's few cars a head learns that there are few: in photographs it must read many.
        draw = partial(view.draw_twice, policy=view.model.pretraining_policy)
        photographs = None
        if preset.photographs:
            photographs = _photographs(target(), preset.photographs)
            net.taught_by.copy_(fingerprint(target()))
        training = PretrainedCountTraining(
            net, draw, preset.pairs, preset.head_epochs, preset.num_scenes, seed=seed, photographs=photographs
        )
        steps = preset.head_epochs + (photographs is not None)
    elif isinstance(net, PresenceNet):
        training = PresenceTraining(net, view.draw, preset.presence_images, preset.presence_epochs, seed=seed)
        steps = preset.presence_epochs
    else:
        seed_everything(batch_seed(run.record["seed"], 4))
        net.fit_to(view.object_size())
        training = CountTraining(net, view.draw, preset.count, seed=seed)
        steps = preset.count.steps
        torch.set_num_threads(1)  # its images are drawn on another core meanwhile
    keep = Keeper(run, "features", training)
    _check_taught(net, target)

    def each(training, loss):
        keep({"stage": "features", "step": training.done, "loss": loss})
        progress("features", training.done, steps, f"loss {loss:.3f}")

    if preset.features == COUNT_ON_PRETRAINED:
        found = training.run(each, lambda done, total: progress("looking", done, total, ""))
        seen = {name: [x if x == x else None for x in part.tolist()] for name, part in found._asdict().items()}
        keep.lines.append(json.dumps({"stage": "counts", **seen}))
    else:
        progress("features", training.done, steps, "")
        training.run(each)
    torch.set_num_threads(run.record["threads"])
    keep.finish()
    run.save("features", net.state_dict())
    keep.forget()


def _photographs(target: ImageFolder, most: int) -> Tensor:
    """Images of the target, ``(L, C, H, W)`` uint8, evenly spread over the folder."""
    check_target(target)
    number = min(most, len(target))
    return torch.stack([target.load(i * len(target) // number) for i in range(number)])


def _real_features(run: Run, net: FeatureNet, progress: Progress, target: Callable[[], ImageFolder]) -> Tensor:
    """Of every image, ``(L, D)``, then of the preset's further views, kept apart: a verdict is about L images."""
    _check_taught(net, target)
    target = target()
    cached = run.load("real")
    if cached is not None:
        _check_same(target, cached["fingerprint"])
        return torch.cat([cached["features"], *([cached["views"]] if "views" in cached else [])])
    views, done = Preset.of(run.record["preset"]).views, 0

    def each(images):
        nonlocal done
        done += images
        progress("target", done, views * len(target), "")

    check_target(target)
    features, *others = (embed_all(net, target.batches(RENDERED_AT_ONCE, view), each) for view in range(views))
    check_features(features)
    kept = {"features": features, "fingerprint": fingerprint(target)}
    run.save("real", kept | ({"views": torch.cat(others)} if others else {}))
    return torch.cat([features, *others])


def _check_same(target: ImageFolder, kept: Tensor) -> None:
    if not torch.equal(fingerprint(target), kept):
        raise RunError(
            f"Expected the target images in {target.path} as they were when the run began, actual others; put them "
            "back, or begin a new run."
        )


def _check_taught(net: FeatureNet, target: Callable[[], ImageFolder]) -> None:
    """See that a network that taught itself on images did so on those of the run, begun anew or going on."""
    taught_by = dict(net.named_buffers()).get("taught_by")
    if taught_by is not None and taught_by.any():
        _check_same(target(), taught_by)


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
    run: Run,
    preset: Preset,
    model: SceneModel,
    observe: Callable[[Scenes], Tensor],
    divergence: Divergence,
    real: Tensor,
    progress: Progress,
) -> Guide:
    seed = run.record["seed"]
    seed_everything(batch_seed(seed, 2))
    guide = run.new_guide()
    objective = ScoreFunction(
        observe,
        divergence,
        baseline=preset.baseline,
        updates=preset.updates,
        scale=preset.scale,
        strata=guide.strata,
        incompletion_weight=preset.incompletion_weight,
        prior=model.pretraining_policy,
        prior_kl_weight=preset.prior_kl_weight,
    )
    learner = Trainer(
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
            model.pretraining_policy,
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
