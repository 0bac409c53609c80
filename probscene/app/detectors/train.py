"""Train a detector on what a run generates and then on labelled photographs, and keep it; see ``train``.

detector.json, detector.safetensors    the detector, see ``folder``
training.json, checkpoint.pt           while it is trained: its settings, and how far it is
generated/                             while it is trained: what it is shown of the run
sources/, sources.json                 while it is trained: which source of the run trains the best detector
"""

import hashlib
import json
import math
import pickle
import shutil
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, cast

import safetensors.torch
import torch
from rich.console import Console
from torchvision.models.detection.fcos import FCOS

from probscene.dataset import range_of
from probscene.decoding import read_rgb
from probscene.device import chosen_device, device_of
from probscene.errors import DataError, ProbsceneError, RunError
from probscene.model import SceneModel
from probscene.threads import threads

from ..arguments import BoxMargin, checked_box_margin, checked_seed, positive
from ..chunks import chunk_randomness
from ..datasets.coco import check_margin_classes
from ..datasets.generate import DatasetOptions, generate, generate_scenes
from ..files import make_folder, write_json, write_whole
from ..fitting.pipeline import open_target
from ..fitting.run import GENERATED_SOURCES, RunFolder, is_run
from ..labels.naming import composed
from ..loading import assets_record, load_model
from ..modules import file_digest, module_digests
from ..progress import Display, Progress, silent
from ..trial.begun_photographs import check_not_cut_out, model_file
from ..trial.detector import Recipe, build, fingerprint
from ..trial.jobs import stages_of
from ..trial.margins import looser
from ..trial.plan import check_apart, split
from ..trial.sets import Example, LabelledSet, digest_of
from ..trial.training import Checkpoint, Checkpoints
from ..trial.training import train as train_stages
from ..trial.trial import SIDE_MULTIPLE, TrainingBudget, check_same, read_labelled, recipe_of, size_for
from ..versions import versions_record
from .export import check_can_export, export
from .folder import FORMAT, ONNX, RECORD, SETTINGS, WEIGHTS, TrainedDetector
from .scores import record_of
from .source_comparison import DetectorBudget, compare_sources

CHECKPOINT, GENERATED, COMPARED = "checkpoint.pt", "generated", "sources.json"
CHECKPOINT_SECONDS = 30.0  # between two


@dataclass(frozen=True, kw_only=True)
class TrainOptions:
    """What a detector is trained on, and how.

    Args:
        generate: images of the run's.
        test: labelled photographs to test it on.
        hold_out: so many of the labelled photographs, by the seed, are for testing.
        classes: those that it learns; the model's where None.
        detector: ``"efficientnet"``, or ``"maskrcnn=FILE"`` with torchvision's weights.
        budget: how it is trained; it knows no ``warm_start``.
        size: height and width at which images come, multiples of 32; about 192 and 256 where None.
        min_visible: objects of which a smaller fraction is visible have no label in generated images.
        box_margin: pixels by which boxes are wider there on each side, see ``DatasetOptions``.
        seed: of the images, of which are held out, of the start and the order.
        value_range: of photographs of 16 bits, see ``ImageFolder``; the run's, else what is found, where None.
        source: of a run, what is generated, of ``GENERATED_SOURCES``; where None, the one that trains the best detector
            by a comparison, see ``source_comparison``, or what was learnt, where sources cannot be compared.
        onnx: write it as ONNX, too, see ``detectors.export``.
    """

    generate: int = 600
    test: Path | str | None = None
    hold_out: int | None = None
    classes: Iterable[str] | None = None
    detector: str = "efficientnet"
    budget: TrainingBudget = TrainingBudget()
    size: tuple[int, int] | None = None
    min_visible: float = 0.2
    box_margin: BoxMargin = 0
    seed: int = 0
    value_range: Sequence[float] | None = None
    source: str | None = None
    onnx: bool = False

    def check(self) -> Recipe:
        """Check what can be checked without the images.

        Raises:
            ProbsceneError: a setting that makes no sense.
            MachineError: a package for ONNX is not installed.
        """
        recipe = recipe_of(self.detector, self.budget)
        chosen_device(self.budget.device)
        checked_seed(self.seed)
        positive(self.generate, "images to generate")
        if self.budget.warm_start:
            raise ProbsceneError("expected a budget without warm_start, which is a trial's, got one with it.")
        if self.size is not None and any(side < SIDE_MULTIPLE or side % SIDE_MULTIPLE for side in self.size):
            raise ProbsceneError(f"expected a size of multiples of {SIDE_MULTIPLE}, got {self.size[1]}x{self.size[0]}.")
        if self.hold_out is not None and self.test is not None:
            raise ProbsceneError("expected photographs to test on from --hold-out or from --test, got both; give one.")
        if self.source is not None and self.source not in GENERATED_SOURCES:
            expected = ", ".join(GENERATED_SOURCES)
            raise ProbsceneError(f"expected a source of a run among {expected}, got {self.source!r}.")
        if self.onnx:
            check_can_export(self.detector)
        return recipe


def train(
    source: RunFolder | SceneModel | Path | str,
    real: Path | None,
    labels: Path | None,
    out: Path,
    options: TrainOptions = TrainOptions(),
    *,
    workers: int = 1,
    show: Progress = silent,
    callback: Callable[[str], None] = lambda message: None,
) -> TrainedDetector:
    """Train a detector, first on generated images, then on labelled photographs where there are some; the same call
    goes on after an interruption, to the same bytes, and does nothing where the detector is there.

    Args:
        source: a run or its folder, for what it has learnt; or a model, for its prior.
        real: a folder of photographs, some of which ``labels`` are of; without ``labels``, a labelled set, see
            ``sets``.
        labels: of photographs, with boxes; without ``real``, a labelled set.
        out: the folder to write.
        workers: processes that generate a run's images; the bytes do not depend on their number.
        callback: called with notes on the photographs, before anything is trained.

    Raises:
        ProbsceneError: a setting that makes no sense.
        DataError: photographs that cannot be used; test images among those that it learns, or that the model's pictures
            were cut out of; ``out`` holds other files.
        RunError: ``out`` holds a detector of other settings; see also ``RunFolder.guide``.
        MachineError: the disk is full, a worker was killed, or a package for ONNX is not installed.
    """
    recipe, seed = options.check(), options.seed
    positive(workers, "workers")
    origin = _origin(source)
    model = origin.model
    if origin.run is None and options.source is not None:
        raise ProbsceneError(
            f"expected a run for the source {options.source!r}, got model {model.name!r}; leave it out."
        )
    names = tuple(sorted(map(composed, options.classes or model.classes)))
    if unknown := sorted(set(names) - {composed(name) for name in model.classes}):
        raise DataError(
            f"expected classes of model {model.name!r} ({', '.join(model.classes)}), got {', '.join(unknown)}; name "
            "some of its own by --classes."
        )
    check_margin_classes(model, checked_box_margin(options.box_margin))
    photographs, tested = _photographs(real, labels, names, options, show)
    given = [found for found in (photographs, tested) if found is not None]
    for note in dict.fromkeys(note for found in given for note in found.notes):
        callback(f"Note: {note}")
    if tested is not None:
        if photographs is not None:
            check_apart("photographs", photographs, tested)
        if origin.file is not None:
            check_not_cut_out(origin.file, tested)
    files = dict.fromkeys(example.path for found in given for example in found.examples)
    recorded = None if origin.run is None else origin.run.record.get("value_range")
    used, notes = range_of(list(files), options.value_range or recorded)
    sizes = [example.size for found in given for example in found.examples] or [model.canvas]
    size = options.size or size_for(sizes)
    settings = {
        "format": FORMAT, "detector": fingerprint(options.detector), "classes": list(names),
        "size": list(size), "recipe": recipe._asdict(),
        "finetune_fraction": options.budget.finetune_fraction, "seed": seed,
        "value_range": None if used is None else list(used), **options.budget.device_record(),
        "generated": {
            **origin.record, "source": options.source, "images": options.generate, "min_visible": options.min_visible,
            "box_margin": checked_box_margin(options.box_margin),
        },
        "photographs_sha256": None if photographs is None else digest_of(photographs),
        "held_out_sha256": None if tested is None else digest_of(tested),
    }  # fmt: skip
    if photographs is not None:
        settings["averages_weights"] = True  # earlier versions did not
    if not _bind(out, settings):
        for note in notes:
            callback(f"Note: {note}")
        budget = DetectorBudget(
            options.detector,
            recipe._replace(iterations=math.ceil(recipe.iterations / 2)),
            size,
            math.ceil(options.generate / 2),
            DatasetOptions(min_visible=options.min_visible, box_margin=options.box_margin),
            seed,
            device=options.budget.device,
        )
        chosen, compared = _chosen(origin, options.source, budget, out, show, callback)
        _generate(origin, chosen, out / GENERATED, options, workers, show)
        made = read_labelled(out / GENERATED, names, show)
        if tested is not None:
            check_apart(GENERATED, made, tested)
        margin = checked_box_margin(options.box_margin)
        if photographs is not None and (note := looser(photographs, made, margin, used)):
            callback(note)
        job = _Job(out, settings, options, recipe, made, photographs, tested, size, used)
        found = {"source": chosen, "sources": compared}
        write_json(out / RECORD, job.run(show) | found)  # last: with it the detector is there
    for name in (SETTINGS, CHECKPOINT, COMPARED):
        (out / name).unlink(missing_ok=True)
    if (out / GENERATED).is_dir():
        shutil.rmtree(out / GENERATED)
    trained = TrainedDetector.at(out, options.budget.device)
    if options.onnx and not (out / ONNX).is_file():
        with threads(1):
            export(cast(FCOS, TrainedDetector.at(out).network), trained.size, out / ONNX)
    return trained


class _Origin(NamedTuple):
    """What generates images: a model, where it was fitted the run, the model's file, and what stands for all that."""

    model: SceneModel
    run: RunFolder | None
    file: Path | None
    record: dict[str, Any]


def _origin(source: RunFolder | SceneModel | Path | str) -> _Origin:
    if isinstance(source, SceneModel):
        return _Origin(source, None, None, {"model": source.name})
    if isinstance(source, RunFolder) or is_run(str(source)) or Path(source).is_dir():
        run = source if isinstance(source, RunFolder) else RunFolder.at(Path(source))
        run.check_finished()
        return _Origin(run.model, run, model_file(run), {"model": run.model.name, "guide": run.guide_hash()})
    model, file = load_model(str(source)), model_file(str(source))
    record: dict[str, Any] = {"model": model.name, "assets_sha256": assets_record(model, None).get("assets_sha256")}
    if file is not None:
        record |= {"model_sha256": file_digest(file), "modules": module_digests(file)}
    return _Origin(model, None, file, record)


def _photographs(
    real: Path | None, labels: Path | None, names: tuple[str, ...], options: TrainOptions, show: Progress
) -> tuple[LabelledSet | None, LabelledSet | None]:
    """Those to train on and those to test on, as far as there are."""
    same = options.classes is None
    whole = labels if labels is not None else real
    photographs = tested = None
    if whole is not None:
        folder = None if labels is None else real
        photographs = read_labelled(whole, names, show, same, folder)
    if options.test is not None:
        tested = read_labelled(Path(options.test), names, show, same)
    elif options.hold_out is not None:
        if photographs is None:
            raise ProbsceneError("expected labelled photographs, --real or --labels, for --hold-out, got none.")
        photographs, tested = split(photographs, options.hold_out, options.seed)
    return photographs, tested


def _bind(out: Path, settings: dict[str, Any]) -> bool:
    """Make the folder ready, or see that it is one of the same settings; whether the detector is there."""
    make_folder(out)
    for name in (RECORD, SETTINGS):
        if (out / name).is_file():
            check_same(out / name, settings, f"the detector in {out}")
            return name == RECORD
    others = sorted(entry.name for entry in out.iterdir() if not entry.name.startswith("."))
    if others:
        raise DataError(
            f"expected a new or empty folder for the detector, got {out} with {', '.join(others[:5])} in it; name "
            "another."
        )
    write_json(out / SETTINGS, settings)
    return False


def _chosen(
    origin: _Origin,
    source: str | None,
    budget: DetectorBudget,
    out: Path,
    show: Progress,
    callback: Callable[[str], None],
) -> tuple[str | None, dict[str, Any] | None]:
    """The source of a run that is generated, and what was found where several were compared."""
    run, file = origin.run, out / COMPARED
    if run is None or source is not None:
        return source, None
    if file.is_file():
        found = json.loads(file.read_text(encoding="utf-8"))
    elif not (found := run.sources):
        try:
            images = None if run.read_tensors("real") is None else open_target(run, Display(Console(quiet=True)))
        except (DataError, RunError) as error:
            callback(f"Note: sources of the run are not compared, as its target cannot be read: {error}")
            images = None
        compared = None if images is None else compare_sources(run, images, budget, out / "sources", show)
        if compared is None:
            return "learnt", None
        callback(str(compared))
        found = compared.record()
    write_json(file, found)
    return found["source"], found


def _generate(
    origin: _Origin, source: str | None, into: Path, options: TrainOptions, workers: int, show: Progress
) -> None:
    labelled = DatasetOptions(min_visible=options.min_visible, box_margin=options.box_margin)

    def progress(done: int, total: int) -> None:
        show("generating", done, total)

    if origin.run is None or source != "learnt":
        policy = origin.model.prior if origin.run is None else origin.run.policy(source or "learnt")
        generate_scenes(origin.model, policy, options.generate, into, options.seed, "coco", progress, labelled)
    else:
        w = 1 if origin.run.objects else workers
        generate(origin.run, options.generate, into, options.seed, w, "coco", progress, labelled)


class _Job(NamedTuple):
    out: Path
    settings: dict[str, Any]
    options: TrainOptions
    recipe: Recipe
    made: LabelledSet
    photographs: LabelledSet | None
    tested: LabelledSet | None
    size: tuple[int, int]
    value_range: tuple[float, float] | None

    def run(self, show: Progress) -> dict[str, Any]:
        """Train, write the weights, and test; what is to be the folder's record."""
        seed, tested, size = self.options.seed, self.tested, self.size
        parts = [found.examples for found in (self.made, self.photographs) if found is not None]
        stages = stages_of([(part,) for part in parts], self.recipe.num_images, self.options.budget.finetune_fraction)
        shown = 0

        def more(number: int) -> None:
            nonlocal shown
            shown += number
            show("detector", shown, self.recipe.num_images)

        # The start and the order of a trial's first seed.
        with threads(1), chunk_randomness(seed, 0):
            network = build(self.options.detector, len(self.made.classes), size)
            network.to(chosen_device(self.options.budget.device))
            kept = Checkpoints(self._checkpoint(), self._keeper())
            train_stages(network, stages, self.recipe, size, (seed, 0), more, self.value_range, kept)
        state = {key: value.cpu().contiguous() for key, value in network.state_dict().items()}
        write_whole(self.out / WEIGHTS, lambda temporary: safetensors.torch.save_file(state, temporary))
        record = {
            **self.settings,
            **versions_record(),
            "device": str(device_of(network)),
            "generated_sha256": digest_of(self.made),
            "photographs": _named(self.photographs),
            "held_out": _named(tested),
            "weights_sha256": hashlib.sha256((self.out / WEIGHTS).read_bytes()).hexdigest(),
            "scores": None,
        }
        if tested is not None:
            trained, found = TrainedDetector(self.out, record, self.options.budget.device), []
            with threads(1):
                for number, example in enumerate(tested.examples, 1):
                    found.append(trained(read_rgb(example.path, self.value_range)))
                    show("detecting", number, len(tested.examples))
            record["scores"] = record_of(tested, found, seed)
        return record

    def _checkpoint(self) -> Checkpoint | None:
        file = self.out / CHECKPOINT
        if not file.is_file():
            return None
        try:
            return Checkpoint(**torch.load(file, map_location="cpu", weights_only=True))
        except (RuntimeError, ValueError, TypeError, EOFError, pickle.UnpicklingError) as error:
            raise RunError(f"expected a checkpoint in {file}, got a damaged file; delete it to begin anew.") from error

    def _keeper(self) -> Callable[[Callable[[], Checkpoint]], None]:
        """Writes a checkpoint when the last one is old enough."""
        last = time.monotonic()

        def keep(checkpoint: Callable[[], Checkpoint]) -> None:
            nonlocal last
            if time.monotonic() - last >= CHECKPOINT_SECONDS:
                state = checkpoint()._asdict()
                write_whole(self.out / CHECKPOINT, lambda temporary: torch.save(state, temporary))
                last = time.monotonic()

        return keep


def _named(found: LabelledSet | None) -> list[dict[str, str]]:
    examples: tuple[Example, ...] = () if found is None else found.examples
    return [{"name": example.path.name, "digest": example.digest} for example in examples]
