"""A fit from its beginning to its end: begun or taken up again, and timed.

``timing.json`` in the run folder holds the seconds that each stage has taken, over all sittings that were not killed,
and as ``other`` those that no stage has: together they are the whole.
"""

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import probscene
from probscene.dataset import Images
from probscene.decoding import checked_range
from probscene.errors import ModelError, ProbsceneError, RunError
from probscene.inference.features.base import Features
from probscene.inference.training import batch_seed
from probscene.model import SceneModel
from probscene.sampling import seed_everything
from probscene.threads import default_threads

from ..checking.generator_check import cost
from ..checking.model_check import QUICK, check_model
from ..files import write_json
from ..labels.partial_labels import PartialLabels, labels_record, read_partial_labels
from ..loading import drawn_with, folder_digest, lasting_reference, load_model, split_reference
from ..modules import file_digest, module_digests
from ..neighbours import neighbours
from ..progress import Display
from ..targets import Target, lasting_target, open_images, say_notes
from ..workers.cluster import Cluster
from .pipeline import check_target, fit, open_target
from .plugins import Plugins, in_memory, is_file_part, part_file
from .preset import Preset
from .presets import takers_of_labels
from .run import RunFolder
from .scene_features import DOMAIN_SHIFT_SHARE, domain_shift
from .store import OTHER, TIMING, check_free, timing

BEFORE = ("reading", "likeness", "looking", "features", "readings", "target", "pretraining")
STAGES = (*BEFORE, "structure", "parameters", "structure-again", "outcome")


def checked_model(model: str | SceneModel, assets: Path | None = None) -> SceneModel:
    """A model without faults, drawn with a folder of assets where one is named.

    Raises:
        ModelError: it does not load, or ``check_model`` finds faults.
    """
    loaded = model if isinstance(model, SceneModel) else load_model(model, assets)
    if faults := check_model(loaded, *QUICK).faults:
        name = loaded.name if isinstance(model, SceneModel) else model
        raise ModelError(f"expected a model without faults, got {name}: {' '.join(faults)}")
    return loaded


def begin(
    model: str | SceneModel,
    target: Target,
    out: Path,
    preset: Preset,
    seed: int,
    skip_bad: bool,
    threads: int | None,
    show: Display,
    assets: Path | None = None,
    parts: Plugins | None = None,
    make: type[RunFolder] = RunFolder,
    labels: Path | None = None,
    photographs: Preset | None = None,
    value_range: Sequence[float] | None = None,
) -> tuple[RunFolder, Images]:
    """A new run; nothing is written before the model, the target and every image in it are found to be good.

    Args:
        threads: of torch; see ``default_threads`` where None. Another number rounds differently, so it is recorded.
        assets: a folder that the model is drawn with.
        parts: what the user brought as objects.
        make: the class of the run.
        labels: of some of the target's images, see ``read_partial_labels``.
        photographs: the preset to take instead where there are labels, or the target looks unlike renders.
        value_range: of images of 16 bits, see ``ImageFolder``.

    Raises:
        ProbsceneError: a number of threads that is not positive, labels for features that take none; see also
            ``checked_model``, ``open_images``, ``check_target``, ``read_partial_labels`` and ``RunFolder.create``.
    """
    if threads is not None and threads < 1:
        raise ProbsceneError(f"expected a positive number of threads, got {threads}.")
    check_free(out)
    loaded = checked_model(model, assets)
    images = open_images(target, loaded, skip_bad, show, value_range)
    check_target(images)
    if photographs is not None:
        preset = _suited(preset, photographs, loaded, images, labels is not None, show)
    if told := cost(loaded, preset.images):
        show.say(told)
    files = {part_file(word) for word in (preset.features, preset.objective, preset.guide) if is_file_part(word)}
    record = {
        "version": probscene.__version__,
        "target": lasting_target(target),
        "target_sha256": images.fingerprint,
        "skip_bad": skip_bad,
        "seed": seed,
        "threads": threads or default_threads(),
        "preset": dataclasses.asdict(preset),
        "guide": preset.guide_settings(),
    }
    if images.value_range is not None:
        record["value_range"] = list(images.value_range)
    if files:
        files |= {each for file in files for each in neighbours(file).values()}
        record["parts"] = {str(file): file_digest(file) for file in sorted(files)}
    # Built before the folder is, so that a wrong one leaves none behind.
    run = make(out, record, loaded, parts)
    few = None
    if labels is not None:
        record["labels"] = labels_record(labels)
        check_takes_labels(run.features)
        few = read_partial_labels(labels, loaded, images)
        say_notes(few.notes, show)
    seed_everything(batch_seed(seed, 0))
    net = run.build_network()
    if is_file_part(preset.guide) or (parts is not None and parts.guide is not None):
        run.new_guide()
    run = make.create(out, model, record, assets, loaded, parts)
    run.built, run.few = net, few
    return run, images


def resume(
    out: Path,
    show: Display,
    model: str | SceneModel | None = None,
    target: Target | None = None,
    preset: Preset | None = None,
    assets: Path | None = None,
    parts: Plugins | None = None,
    make: type[RunFolder] = RunFolder,
    labels: Path | None = None,
    photographs: Preset | None = None,
    **settings: Any,
) -> tuple[RunFolder, Images | None]:
    """A run that was begun, and its images; no images where the fit is finished.

    Args:
        model, target, preset, assets, settings: what the run must have been begun with, where it is not None; the
            settings are ``seed``, ``skip_bad``, ``threads`` and ``value_range``. A model and images in memory are taken
            as they are; files may lie elsewhere by now, as may a folder of assets, and the run then knows them by their
            new place.
        parts: what the user brought as objects.
        make: the class of the run.
        labels: those that it was begun with, where they are not None; they, too, may lie elsewhere.
        photographs: another preset that it may have been begun with, see ``begin``.

    Raises:
        RunError: there is no run, or it was begun with something else, or its labels have changed.
        DataError: see ``ImageFolder`` and ``read_partial_labels``.
    """
    run = make.at(out, model if isinstance(model, SceneModel) else None, parts)
    before = dict(run.record)
    images = _relocate(run, model, target, assets, labels, show)
    given = {
        "model": in_memory(model.name) if isinstance(model, SceneModel) else model and lasting_reference(model),
        "target": None if target is None else lasting_target(target) or "images in memory",
        "assets_folder": None if assets is None else os.path.abspath(assets),
        "labels": None if labels is None else str(Path(labels).resolve()),
        **settings,
    }
    if given.get("value_range") is not None:
        given["value_range"] = list(checked_range(given["value_range"]))
    given = {key: value for key, value in given.items() if value is not None}
    begun = {**run.record, "labels": run.record.get("labels", {}).get("path")}
    known = {key: begun.get(key) for key in given}
    if "target" in known:
        known["target"] = known["target"] or "images in memory"
    if photographs is not None and preset is not None and run.preset.features == photographs.features:
        preset = photographs
    if preset is not None:  # field by field, so that the message names the one that differs
        unread = run.preset.unread()  # another version may have other defaults of these
        given |= {key: value for key, value in dataclasses.asdict(preset).items() if key not in unread}
        known |= dataclasses.asdict(run.preset)
    for key, value in given.items():
        if value != known[key]:
            raise RunError(
                f"expected the {key} that the run in {out} was begun with ({known[key]}), got {value}; leave it "
                "out with --resume, or begin another run."
            )
    if run.record != before:
        write_json(run.path / "run.json", run.record)
    if run.is_finished:
        return run, None
    if images is None and run.record["target"] is None and target is not None:
        images = open_images(target, run.model, run.record["skip_bad"], show, run.record.get("value_range"))
    elif images is None:
        if isinstance(place := run.record["target"], str) and not Path(place).exists():
            raise RunError(
                f"expected the images of the run in {out} in {place}, got nothing there; where they lie elsewhere "
                "by now, name that folder with --target."
            )
        images = open_target(run, show)
        say_notes(images.notes, show)
    run.few = _same_labels(run, images)
    return run, images


def carry_out(
    run: RunFolder,
    target: Images | None,
    show: Display,
    cache: Path | None = None,
    use_cache: bool = True,
    cluster: Cluster | None = None,
) -> None:
    """Finish the fit; the time is kept even where it is interrupted.

    Args:
        cache, use_cache, cluster: see ``fit.fit``.

    Raises:
        ProbsceneError: see ``fit.fit``.
    """
    before = timing(run)
    try:
        fit(run, show, target, cache, use_cache, show.say, run.few, cluster)
    finally:
        now = {stage: show.seconds.get(stage, 0.0) for stage in STAGES}
        now[OTHER] = show.elapsed - sum(show.seconds.values())
        spent = {stage: before.get(stage, 0.0) + seconds for stage, seconds in now.items()}
        write_json(run.path / TIMING, {stage: seconds for stage, seconds in spent.items() if seconds})


def _suited(
    preset: Preset, photographs: Preset, model: SceneModel, images: Images, labelled: bool, show: Display
) -> Preset:
    """The preset for renders or that for photographs; which, and why, is said where it is the latter."""
    if labelled:
        return photographs
    share = domain_shift(model, images, show.stage("likeness"))
    if share < DOMAIN_SHIFT_SHARE:
        return preset
    show.say(
        f"Note: the target's images look unlike the model's renders ({share:.0%} of them like none), so features "
        f"that count in photographs are taken; --features {preset.features} keeps the others, --features "
        f"{photographs.features} says so from the start."
    )
    return photographs


def check_takes_labels(features: Features) -> None:
    """See that features can make use of labels.

    Raises:
        ProbsceneError: they cannot.
    """
    if not features.takes_labels:
        able = " or ".join(f"--features {name}" for name in takers_of_labels())
        raise ProbsceneError(
            f"expected features that labels can calibrate, got {features.name!r}, which take none; "
            f"{f'add {able}, or ' if able else ''}leave out the labels."
        )


def _relocate(
    run: RunFolder,
    model: str | SceneModel | None,
    target: Target | None,
    assets: Path | None,
    labels: Path | None,
    show: Display,
) -> Images | None:
    """Let a run's record name the model's file, its folder of assets, the images and the labels where they lie now, if
    what is given has the same bytes as what the run was begun with.

    Returns:
        The images, where they had to be opened for that.
    """
    record = run.record
    if isinstance(model, str) and lasting_reference(model) != record["model"]:
        (file, names), (_, begun) = split_reference(model), split_reference(record["model"])
        if names != begun or not Path(file).is_file() or file_digest(Path(file)) != record["model_sha256"]:
            return None
        if module_digests(Path(file)) != record.get("modules", {}):
            return None
        record["model"] = lasting_reference(model)
    if assets is not None and folder_digest(os.path.abspath(assets)) == record.get("assets_sha256"):
        record["assets_folder"] = os.path.abspath(assets)
        record["assets"] = drawn_with(run.model)
    if labels is not None and "labels" in record:
        found = labels_record(labels)
        if found["sha256"] == record["labels"]["sha256"]:
            record["labels"] = found
    place = None if target is None else lasting_target(target)
    if target is None or place is None or place == record["target"] or "target_sha256" not in record:
        return None
    images = open_images(target, run.model, record["skip_bad"], show, record.get("value_range"))
    if images.fingerprint == record["target_sha256"]:
        record["target"] = place
    return images


def _same_labels(run: RunFolder, images: Images) -> PartialLabels | None:
    """The labels that a run was begun with."""
    kept = run.record.get("labels")
    if kept is None:
        return None
    path = Path(kept["path"])
    if labels_record(path) != kept:
        raise RunError(
            f"expected the labels in {path} as they were when the run in {run.path} was begun, got others; put them "
            "back, or begin a new run."
        )
    return read_partial_labels(path, run.model, images)
