"""The beginning of a fit: a new run, or one that is taken up again. Nothing is learnt here."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from probscene.dataset import Images
from probscene.decoding import checked_range
from probscene.errors import DataError, ModelError, ProbsceneError, RunError
from probscene.inference.features.base import Features
from probscene.inference.features.detections.calibration import calibrate
from probscene.inference.features.detections.net import DETECTIONS
from probscene.inference.training import batch_seed
from probscene.model import SceneModel
from probscene.sampling import seed_everything
from probscene.threads import default_threads

from ..checking.generator_check import cost
from ..checking.model_check import QUICK, check_model
from ..files import write_json
from ..labels.detections import read_detections
from ..labels.partial_labels import PartialLabels, labels_record, read_partial_labels
from ..loading import drawn_with, folder_digest, lasting_reference, load_model, split_reference
from ..modules import file_digest, module_digests
from ..neighbours import neighbours
from ..progress import Display
from ..targets import TargetImages, lasting_target, open_images, say_notes
from ..versions import versions_record
from .config import Auto, FitConfig, takers_of_labels
from .pipeline import Begun, check_target, open_target
from .plugins import in_memory, is_file_part, part_file
from .run import RunFolder
from .scene_features import DOMAIN_SHIFT_SHARE, domain_shift
from .store import check_free


@dataclass(frozen=True)
class ModelFile:
    """A model by its name or file, drawn with a folder of assets.

    Args:
        reference: a built-in model's name, or a Python file; None for that of a run that is resumed.
        assets: of meshes or pictures, see ``load_model``.
    """

    reference: str | None
    assets: Path | None = None


@dataclass(frozen=True)
class FitRequest:
    """What a fit is asked to do; None where a run that is resumed knows it.

    Args:
        model: the scene model, or its file.
        target: the images.
        config: how to learn.
        seed: of everything random.
        labels: of some of the images, see ``read_partial_labels``.
        threads: of torch; see ``default_threads`` where None. Another number rounds differently, so it is recorded.
    """

    model: SceneModel | ModelFile | None = None
    target: TargetImages | None = None
    config: FitConfig | None = None
    seed: int | None = None
    labels: Path | None = None
    threads: int | None = None

    @property
    def readings(self) -> Path | None:
        """The file of detections in the images, where one is named."""
        return None if self.target is None or self.target.readings is None else Path(self.target.readings)

    @property
    def assets(self) -> Path | None:
        """The folder that the model is drawn with, where one is named."""
        return self.model.assets if isinstance(self.model, ModelFile) else None


def checked_model(model: SceneModel | ModelFile) -> SceneModel:
    """A model without faults.

    Raises:
        ModelError: it does not load, or ``check_model`` finds faults.
    """
    loaded = model if isinstance(model, SceneModel) else load_model(str(model.reference), model.assets)
    if faults := check_model(loaded, *QUICK).faults:
        name = loaded.name if isinstance(model, SceneModel) else model.reference
        raise ModelError(f"expected a model without faults, got {name}: {' '.join(faults)}")
    return loaded


def begin(request: FitRequest, out: Path, show: Display, make: type[RunFolder] = RunFolder) -> Begun:
    """A new run; nothing is written before the model, the target and every image in it are found to be good.

    Args:
        make: the class of the run.

    Raises:
        ProbsceneError: no model, target or configuration; a number of threads that is not positive; labels for features
            that take none; see also ``checked_model``, ``open_images``, ``check_target``, ``read_partial_labels`` and
            ``RunFolder.create``.
    """
    model, target, config = request.model, request.target, request.config
    nameless = model is None or (isinstance(model, ModelFile) and model.reference is None)
    if nameless or target is None or target.source is None or config is None:
        raise DataError(
            "expected a model and target images (MODEL and --target DIR), got one missing; only a run that is resumed "
            "goes without them."
        )
    if request.threads is not None and request.threads < 1:
        raise ProbsceneError(f"expected a positive number of threads, got {request.threads}.")
    check_free(out)
    plugins = config.plugins()
    assert model is not None
    loaded = checked_model(model)
    images = open_images(target.source, loaded, bool(target.skip_bad), show, target.value_range)
    check_target(images)
    if request.readings is not None:
        config = _with_readings(config)
    config = _chosen(config, loaded, images, request.labels is not None, show)
    if note := cost(loaded, config.images):
        show.say(note)
    record = {
        **versions_record(),
        "devices": [],
        "target": lasting_target(target.source),
        "target_sha256": images.fingerprint,
        "skip_bad": bool(target.skip_bad),
        "seed": request.seed or 0,
        "threads": request.threads or default_threads(),
        "config": config.to_record(),
    }
    if images.value_range is not None:
        record["value_range"] = list(images.value_range)
    if files := {part_file(word) for word in config.words().values() if is_file_part(word)}:
        files |= {prefixed for file in files for prefixed in neighbours(file).values()}
        record["parts"] = {str(file): file_digest(file) for file in sorted(files)}
    # Built before the folder is, so that a wrong one leaves none behind.
    run, labels, detections = make(out, record, loaded, plugins), None, None
    if request.readings is None and run.features.takes_readings:
        raise ProbsceneError(f"expected --readings FILE for features {run.features.name!r}, got none.")
    if request.readings is not None:
        record["readings"] = labels_record(request.readings)
        detections, notes = read_detections(request.readings, loaded, images)
        say_notes(notes, show)
    if request.labels is not None:
        record["labels"] = labels_record(request.labels)
        check_takes_labels(run.features)
        labels = read_partial_labels(request.labels, loaded, images)
        say_notes(labels.notes, show)
    if detections is not None:
        calibrate(detections, loaded.classes, labels)
    seed_everything(batch_seed(record["seed"], 0))
    net = run.build_network()
    if "guide" in config.words():
        run.new_guide()
    source = model.reference if isinstance(model, ModelFile) and model.reference else loaded
    return Begun(make.create(out, source, record, request.assets, loaded, plugins), images, labels, detections, net)


def resume(request: FitRequest, out: Path, show: Display, make: type[RunFolder] = RunFolder) -> Begun:
    """A run that was begun. What the request names must be what the run was begun with; files may lie elsewhere by now,
    as may a folder of assets, and the run then knows them by their new place. A model and images in memory are taken as
    they are.

    Args:
        make: the class of the run.

    Raises:
        RunError: there is no run, or it was begun with something else, or its labels have changed.
        DataError: see ``ImageFolder`` and ``read_partial_labels``.
    """
    model, plugins = request.model, None if request.config is None else request.config.plugins()
    run = make.at(out, model if isinstance(model, SceneModel) else None, plugins)
    before = dict(run.record)
    images = _relocate(run, request, show)
    given, known = _asked(request, run), _begun_with(run)
    for key, value in given.items():
        if value != known.get(key):
            raise RunError(
                f"expected the {key} that the run in {out} was begun with ({known.get(key)}), got {value}; leave it "
                "out with --resume, or begin another run."
            )
    if run.record != before:
        write_json(run.path / "run.json", run.record)
    if run.is_finished:
        return Begun(run)
    if images is None and run.record["target"] is None and request.target is not None:
        source, record = request.target.source, run.record
        images = open_images(source, run.model, record["skip_bad"], show, record.get("value_range"))
    elif images is None:
        if isinstance(place := run.record["target"], str) and not Path(place).exists():
            raise RunError(
                f"expected the images of the run in {out} in {place}, got nothing there; where they lie elsewhere by "
                "now, name that folder with --target."
            )
        images = open_target(run, show)
        say_notes(images.notes, show)
    detections = _same_file(run, "readings")
    found = None if detections is None else read_detections(detections, run.model, images).found
    return Begun(run, images, _same_labels(run, images), found)


def _asked(request: FitRequest, run: RunFolder) -> dict[str, Any]:
    """What a request names, as the record has it."""
    model, target = request.model, request.target
    found: dict[str, Any] = {
        "model": _lasting_model(model),
        "assets_folder": None if request.assets is None else os.path.abspath(request.assets),
        "labels": None if request.labels is None else str(Path(request.labels).resolve()),
        "readings": None if request.readings is None else str(Path(request.readings).resolve()),
        "seed": request.seed,
        "threads": request.threads,
    }
    if target is not None:
        found["target"] = None if target.source is None else lasting_target(target.source) or "images in memory"
        found["skip_bad"] = target.skip_bad
        if target.value_range is not None:
            found["value_range"] = list(checked_range(target.value_range))
    found = {key: value for key, value in found.items() if value is not None}
    if (config := request.config) is None:
        return found
    photographs = type(config.for_photographs().features) is type(run.config.features)
    return found | (config.for_photographs() if photographs else config.for_renders()).flat()


def _lasting_model(model: SceneModel | ModelFile | None) -> str | None:
    if isinstance(model, SceneModel):
        return in_memory(model.name)
    return None if model is None or model.reference is None else lasting_reference(model.reference)


def _begun_with(run: RunFolder) -> dict[str, Any]:
    record = {**run.record, **{key: run.record.get(key, {}).get("path") for key in ("labels", "readings")}}
    return record | {"target": record["target"] or "images in memory"} | run.config.flat()


def _with_readings(config: FitConfig) -> FitConfig:
    """The configuration of a fit to which detections are given."""
    if isinstance(config.features, Auto):
        return config.with_features(DETECTIONS)._set_again()
    if config.make_features().takes_readings:
        return config
    raise ProbsceneError(
        f"expected no other features with --readings, got --features {config.make_features().name}; leave one out."
    )


def _chosen(config: FitConfig, model: SceneModel, images: Images, labelled: bool, show: Display) -> FitConfig:
    """The configuration for renders or that for photographs; which, and why, is said where it is the latter."""
    if not isinstance(config.features, Auto) or labelled:
        return config.for_photographs()
    share = domain_shift(model, images, show.stage("likeness"))
    if share < DOMAIN_SHIFT_SHARE:
        return config.for_renders()
    photographs = config.for_photographs()
    show.say(
        f"Note: domain shift: {share:.0%} of the target's images look unlike any render of the model, so --features "
        f"{photographs.make_features().name}, for photographs, is used instead of {config.features.renders.name}. "
        "Give --features to choose."
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


def _relocate(run: RunFolder, request: FitRequest, show: Display) -> Images | None:
    """Let a run's record name the model's file, its folder of assets, the images and the labels where they lie now, if
    what is given has the same bytes as what the run was begun with.

    Returns:
        The images, where they had to be opened for that.
    """
    record, model, assets = run.record, request.model, request.assets
    if isinstance(model, ModelFile) and model.reference and lasting_reference(model.reference) != record["model"]:
        (file, names), (_, begun) = split_reference(model.reference), split_reference(record["model"])
        if names != begun or not Path(file).is_file() or file_digest(Path(file)) != record["model_sha256"]:
            return None
        if module_digests(Path(file)) != record.get("modules", {}):
            return None
        record["model"] = lasting_reference(model.reference)
    if assets is not None and folder_digest(os.path.abspath(assets)) == record.get("assets_sha256"):
        record["assets_folder"] = os.path.abspath(assets)
        record["assets"] = drawn_with(run.model)
    for key, path in (("labels", request.labels), ("readings", request.readings)):
        if path is not None and key in record and (found := labels_record(path))["sha256"] == record[key]["sha256"]:
            record[key] = found
    source = None if request.target is None else request.target.source
    place = None if source is None else lasting_target(source)
    if source is None or place is None or place == record["target"] or "target_sha256" not in record:
        return None
    images = open_images(source, run.model, record["skip_bad"], show, record.get("value_range"))
    if images.fingerprint == record["target_sha256"]:
        record["target"] = place
    return images


def _same_labels(run: RunFolder, images: Images) -> PartialLabels | None:
    """The labels that a run was begun with."""
    path = _same_file(run, "labels")
    return None if path is None else read_partial_labels(path, run.model, images)


def _same_file(run: RunFolder, key: str) -> Path | None:
    """The file of labels or readings that a run was begun with."""
    kept = run.record.get(key)
    if kept is None:
        return None
    path = Path(kept["path"])
    if labels_record(path) != kept:
        raise RunError(
            f"expected the {key} in {path} as they were when the run in {run.path} was begun, got others; put them "
            "back, or begin a new run."
        )
    return path
