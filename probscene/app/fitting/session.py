"""A fit as a person runs it: begun or taken up again, shown, and timed.

``timing.json`` in the run folder holds the seconds that each stage has taken, over all sittings that were not killed.
"""

import dataclasses
import json
import os
from pathlib import Path
from typing import Any

from probscene.checks import check
from probscene.dataset import ImageFolder
from probscene.errors import ModelError, RunError
from probscene.model import SceneModel

from ..files import write_json
from ..loading import lasting_reference, load_model
from ..progress import Display
from . import fit
from .presets import TRAINED, Preset
from .run import Run

TIMING = "timing.json"
STAGES = ("reading", "features", "target", "pretraining", "structure")


def checked_model(reference: str, assets: Path | None = None) -> SceneModel:
    """A model without faults, drawn with a folder of assets where one is named.

    Raises:
        ModelError: it does not load, or ``check`` finds faults.
    """
    model = load_model(reference, assets)
    faults = check(model).faults
    if faults:
        raise ModelError(f"Expected a model without faults, actual {reference}: {' '.join(faults)}")
    return model


def begin(
    model: str,
    target: Path,
    out: Path,
    preset: Preset,
    seed: int,
    skip_bad: bool,
    threads: int | None,
    show: Display,
    assets: Path | None = None,
) -> tuple[Run, ImageFolder]:
    """A new run; nothing is written before the model, the folder and every image in it are found to be good.

    Raises:
        ProbsceneError: see ``checked_model``, ``ImageFolder`` and ``Run.create``.
    """
    Run.check_free(out)
    loaded = checked_model(model, assets)
    images = open_images(target, loaded, skip_bad, show)
    fit.check_target(images)
    return fit.create(model, target, out, preset, seed, skip_bad, threads, assets), images


def resume(
    out: Path,
    show: Display,
    model: str | None = None,
    target: Path | None = None,
    preset: Preset | None = None,
    assets: Path | None = None,
    **settings: Any,
) -> tuple[Run, ImageFolder | None]:
    """A run that was begun, and its images; no images where the fit is finished.

    Args:
        model, target, preset, assets, settings: what the run must have been begun with, where it is not None; the
            settings are ``seed``, ``skip_bad`` and ``threads``.

    Raises:
        RunError: there is no run, or it was begun with something else.
        DataError: see ``ImageFolder``.
    """
    run = Run.open(out)
    given = {
        "model": None if model is None else lasting_reference(model),
        "target": None if target is None else str(target.resolve()),
        "assets_folder": None if assets is None else os.path.abspath(assets),
        **settings,
    }
    given = {key: value for key, value in given.items() if value is not None}
    before = {key: run.record.get(key) for key in given}
    if preset is not None:  # field by field, so that the message names the one that differs
        given |= dataclasses.asdict(preset)
        before |= dataclasses.asdict(Preset.of(run.record["preset"]))
    for key, value in given.items():
        if value != before[key]:
            raise RunError(
                f"Expected the {key} that the run in {out} was begun with ({before[key]}), actual {value}; leave it "
                "out with --resume, or begin another run."
            )
    if is_finished(run):
        return run, None
    return run, open_images(Path(run.record["target"]), run.model, run.record["skip_bad"], show)


def carry_out(run: Run, target: ImageFolder | None, show: Display) -> None:
    """Finish the fit; the time is kept even where it is interrupted.

    Raises:
        ProbsceneError: see ``fit.fit``.
    """
    before = timing(run)
    features = run.record["preset"]["features"]
    if features != "count":
        show.units["features"] = "epochs" if features in TRAINED else "structures"
    try:
        fit.fit(run, show, target)
    finally:
        spent = {stage: before.get(stage, 0.0) + show.seconds.get(stage, 0.0) for stage in STAGES}
        write_json(run.path / TIMING, {stage: seconds for stage, seconds in spent.items() if seconds})


def is_finished(run: Run) -> bool:
    """Whether the guide is learnt."""
    return (run.path / "guide.safetensors").is_file()


def timing(run: Run) -> dict[str, float]:
    """Seconds by stage, as far as they are known."""
    try:
        return json.loads((run.path / TIMING).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}


def open_images(path: Path, model: SceneModel, skip_bad: bool, show: Display) -> ImageFolder:
    """A folder of images as a model reads them; what a person should know about it is said.

    Raises:
        DataError: see ``ImageFolder``.
    """
    images = ImageFolder(path, model.canvas, model.channels, skip_bad, show.stage("reading"))
    for note in images.notes:
        show.say(f"Note: {note}")
    return images
