"""What is a set worth? One detector, from one start and with one budget, is trained on each of several sets and tested
on labelled real images; see ``trial``.

    trial.json     what the trial is bound to
    sets/          what was generated of a run
    trainings/     what each detector found in the test images
    results.json, table.txt, results.png
"""

import hashlib
import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from probscene.dataset import range_of
from probscene.device import CPU, chosen_device
from probscene.errors import DataError, ProbsceneError, RunError

from ..arguments import BoxMargin, checked_box_margin, checked_seed, positive
from ..datasets.coco import check_margin_classes
from ..datasets.generate import DatasetOptions, generate, generate_scenes
from ..files import make_folder, write_json, write_text
from ..fitting.run import GENERATED_SOURCES, RunFolder
from ..progress import Progress, silent
from .begun_photographs import check_not_cut_out, model_file
from .detector import RECIPES, Recipe, checked, fingerprint
from .jobs import Job
from .margins import looser
from .pictures import draw
from .plan import REAL, Plan, Row, baselines_of, check, list_of, only, plan, split
from .results import Results, score
from .sets import LabelledSet, digest_of, read_set
from .tables import text

FORMAT = 1
DEFAULT_AREA = 256 * 192  # pixels of an image where no size is given
SIDE_MULTIPLE = 32  # of an image's height and width
DEFAULT_NUMBERS = (10, 20, 50, None)  # of labelled photographs; None for all


class TrainingBudget(NamedTuple):
    """How each detector is trained; by the detector's recipe where None, see ``detector.RECIPES``.

    Attributes:
        iterations: steps of the optimiser.
        batch_size: images a step.
        learning_rate: of Adam, at its highest.
        finetune_fraction: the share of the images that the last of several stages is shown.
        warm_start: every row starts from the detector of the row before, as in the paper, at half the learning rate and
            then at a tenth.
        device: where, see ``chosen_device``; another rounds differently.
    """

    iterations: int | None = None
    batch_size: int | None = None
    learning_rate: float | None = None
    finetune_fraction: float = 0.5
    warm_start: bool = False
    device: str = "cpu"

    def device_record(self) -> dict[str, str]:
        """The device, where it is not the CPU: detectors of two devices do not belong together."""
        device = chosen_device(self.device)
        return {} if device == CPU else {"device": str(device)}


@dataclass(frozen=True)
class GeneratedSets:
    """Sets that are generated of a run.

    Args:
        run: the fit, or its folder.
        sources: of ``GENERATED_SOURCES``; those that are a copy of another are left out.
        number: images of each.
        min_visible: objects of which a smaller fraction is visible have no label.
        box_margin: pixels by which boxes are wider on each side, see ``DatasetOptions``.
    """

    run: RunFolder | Path | str
    sources: tuple[str, ...] = ("prior", "start", "learnt")
    number: int = 600
    min_visible: float = 0.2
    box_margin: BoxMargin = 0

    @cached_property
    def opened(self) -> RunFolder:
        """The run."""
        return RunFolder.at(Path(self.run)) if isinstance(self.run, Path | str) else self.run


@dataclass(frozen=True, kw_only=True)
class TrialOptions:
    """What a trial compares, and how.

    Args:
        hold_out: so many of the labelled real images, by the seed, are for testing, the others are ``real``.
        real: labelled photographs to train on.
        numbers: of them, with a row each, None for all; (10, 20, 50, all), as far as there are, where not given.
        generated: what is generated of a run.
        classes: those that the trial is about; else all, which are then the same in all sets.
        detector: ``"efficientnet"``, or ``"maskrcnn=FILE"`` with torchvision's weights.
        budget: how each is trained.
        size: height and width at which images come, multiples of 32.
        seeds: trainings of each row.
        seed: of the trial: the split, the choices of photographs, the detectors' initialisation, the bootstrap.
        baselines: rows that the others are compared with; the first where there is none.
        resamples: of the bootstrap.
        value_range: of photographs of 16 bits, see ``ImageFolder``; the run's, else what is found in all of them, where
            None.
    """

    hold_out: int | None = None
    real: Path | str | None = None
    numbers: Iterable[int | None] | None = None
    generated: GeneratedSets | None = None
    classes: Iterable[str] | None = None
    detector: str = "efficientnet"
    budget: TrainingBudget = TrainingBudget()
    size: tuple[int, int] | None = None
    seeds: int = 5
    seed: int = 0
    baselines: Iterable[str] = ()
    resamples: int = 1000
    value_range: Sequence[float] | None = None

    def check(self) -> None:
        """Check what can be checked without the images.

        Raises:
            ProbsceneError: a setting that makes no sense.
        """
        checked_seed(self.seed)
        positive(self.seeds, "seeds")
        positive(self.resamples, "resamples")
        if self.size is not None and any(side < SIDE_MULTIPLE or side % SIDE_MULTIPLE for side in self.size):
            raise ProbsceneError(f"expected a size of multiples of {SIDE_MULTIPLE}, got {self.size[1]}x{self.size[0]}.")
        if self.hold_out is not None and self.real is not None:
            raise ProbsceneError("expected photographs to train on from --hold-out or from --real, got both; give one.")


def trial(
    test: Path,
    out: Path,
    sets: Mapping[str, str | Path],
    options: TrialOptions = TrialOptions(),
    *,
    workers: int = 1,
    show: Progress = silent,
    callback: Callable[[str], None] = lambda message: None,
) -> Results:
    """Train, test, compare; the same call goes on after an interruption. Nothing is trained before all is checked.

    Args:
        test: labelled real images, see ``sets``; ``FOLDER@LIST`` for some of them.
        sets: what each row's detector is shown, see ``plan``.
        workers: processes; the results do not depend on their number.
        callback: called with notes on the sets, before anything is trained.

    Raises:
        ProbsceneError: a setting that makes no sense.
        DataError: a set that cannot be used; test images among those that are trained on, or that a run's pictures were
            cut out of.
        RunError: the folder holds a trial of other settings.
        MachineError: the disk is full, or a worker was killed.
    """
    recipe, budget, generated = recipe_of(options.detector, options.budget), options.budget, options.generated
    device = chosen_device(budget.device)
    options.check()
    positive(workers, "workers")
    tested, photographs = _photographs(test, options, show)
    names, same = tested.classes, options.classes is None
    known = [] if generated is None else list(_sources(generated))
    if photographs is not None:
        known.insert(0, REAL)
        there = len(photographs.examples)
        usual = [n for n in DEFAULT_NUMBERS if n is None or n < there]
        wanted = usual if options.numbers is None else list(options.numbers)
    else:
        wanted = list(options.numbers or ())
        if wanted:
            raise ProbsceneError("expected --hold-out N or --real PATH for --real-numbers, got neither.")
    planned = plan(sets, known, wanted)
    bases = baselines_of(planned, options.baselines)
    loaded = {} if photographs is None else {REAL: photographs}
    loaded |= {key: read_labelled(path, names, show, same) for key, path in planned.paths.items()}
    for note in dict.fromkeys(note for found in (tested, *loaded.values()) for note in found.notes):
        callback(f"Note: {note}")
    check(planned, loaded, tested, set(known) - {REAL})
    if generated is not None:
        _check_classes(generated, names, same)
        check_margin_classes(generated.opened.model, checked_box_margin(generated.box_margin))
        if (file := model_file(generated.opened)) is not None:
            check_not_cut_out(file, tested)
    size = options.size or size_for(example.size for example in tested.examples)
    seed, seeds, value_range = options.seed, options.seeds, options.value_range
    shared = {
        "format": FORMAT, "classes": list(names), "detector": fingerprint(options.detector),
        "recipe": [recipe.num_images, *recipe[1:]], "last": budget.finetune_fraction, "chain": budget.warm_start,
        "size": list(size), "seed": seed, "test": digest_of(tested), **budget.device_record(),
    }  # fmt: skip
    if value_range is None and generated is not None:
        value_range = generated.opened.record.get("value_range")
    files = dict.fromkeys(example.path for found in (tested, *loaded.values()) for example in found.examples)
    used, notes = range_of(list(files), value_range)
    if used is not None:
        shared["value_range"] = list(used)
    _bind(out, shared)
    for note in notes:
        callback(f"Note: {note}")
    if generated is not None:
        for key, path in _generate(generated, out / "sets", seed, workers, show).items():
            loaded[key] = read_labelled(path, names, show)
        check(planned, loaded, tested, set())
        margin = checked_box_margin(generated.box_margin)
        if photographs is not None and (note := looser(photographs, loaded[known[-1]], margin, used)):
            callback(note)
    rows = {
        row.name: tuple(tuple((loaded[p.source], p) for p in stage) for stage in row.stages) for row in planned.rows
    }
    digests = _digests(planned, loaded, shared)
    job = Job(
        out,
        options.detector,
        recipe,
        size,
        names,
        rows,
        digests,
        tested.examples,
        seeds,
        seed,
        budget.finetune_fraction,
        budget.warm_start,
        used,
        device,
    )
    for row in planned.rows:
        for s in range(seeds):
            job.is_done(row.name, s)
    write_json(out / "trial.json", {**shared, "rows": {row.name: row.record() for row in planned.rows}})
    job.run(workers, lambda done, total: show("training", done, total))
    there = 0 if photographs is None else len(photographs.examples)
    found = score(
        job, tested, planned.rows, there, bases, options.resamples, lambda done, total: show("scoring", done, total)
    )
    write_json(out / "results.json", found.record() | {"settings": {**shared, "resamples": options.resamples}})
    write_text(out / "table.txt", text(found))
    draw(found, out / "results.png")
    return found


def recipe_of(choice: str, budget: TrainingBudget) -> Recipe:
    """What a detector is trained with.

    Raises:
        ProbsceneError: a budget that makes no sense; see also ``checked``.
    """
    if not 0 < budget.finetune_fraction < 1:
        raise ProbsceneError(f"expected a fine-tuning fraction between 0 and 1, got {budget.finetune_fraction}.")
    recipe = RECIPES[checked(choice)]
    given = budget._asdict()
    own = ("iterations", "batch_size", "learning_rate")
    recipe = recipe._replace(**{key: given[key] for key in own if given[key] is not None})
    positive(recipe.iterations, "iterations")
    positive(recipe.batch_size, "images a step")
    if not (recipe.learning_rate > 0 and math.isfinite(recipe.learning_rate)):
        raise ProbsceneError(f"expected a positive learning rate, got {recipe.learning_rate}.")
    return recipe


def read_labelled(
    path: Path,
    classes: Iterable[str] | None,
    show: Progress,
    same: bool = False,
    photographs: Path | None = None,
) -> LabelledSet:
    """``read_set``, of ``PATH@LIST`` some of it."""
    folder, names = list_of(path)
    found = read_set(folder, classes, lambda done, total: show("labels", done, total), same, photographs)
    return found if names is None else only(found, names)


def _photographs(test: Path, options: TrialOptions, show: Progress) -> tuple[LabelledSet, LabelledSet | None]:
    """What is tested on, and the photographs to train on, if there are any."""
    tested = read_labelled(test, options.classes, show)
    real = None if options.real is None else Path(options.real)
    if options.hold_out is not None:
        photographs, tested = split(tested, options.hold_out, options.seed)
    else:
        photographs = None if real is None else read_labelled(real, tested.classes, show, options.classes is None)
    labelled = {int(c) for e in tested.examples for c in e.classes[e.real]}
    lacking = [name for number, name in enumerate(tested.classes) if number not in labelled]
    if lacking:
        raise DataError(
            f"expected test images in {test} with objects of every class, got none of {', '.join(lacking)}; name "
            "the classes that there are by --classes, or test on more images."
        )
    return tested, photographs


def _sources(generated: GeneratedSets) -> tuple[str, ...]:
    """Those that are asked for and are no copy of another."""
    unknown = set(generated.sources) - set(GENERATED_SOURCES)
    if unknown or not generated.sources:
        expected, actual = ", ".join(GENERATED_SOURCES), ", ".join(sorted(unknown)) or "none"
        raise ProbsceneError(f"expected sources of a run among {expected}, got {actual}.")
    different = generated.opened.generated_sources()
    return tuple(name for name in dict.fromkeys(generated.sources) if name in different)


def _check_classes(generated: GeneratedSets, classes: tuple[str, ...], same: bool) -> None:
    there = set(generated.opened.model.classes)
    if set(classes) - there or (same and there - set(classes)):
        raise DataError(
            f"expected model {generated.opened.model.name!r} to have the classes of the test images "
            f"({', '.join(classes)}), got {', '.join(generated.opened.model.classes)}; rename its classes or those of "
            "the labels, or name the classes that both have by --classes."
        )


def _generate(generated: GeneratedSets, into: Path, seed: int, workers: int, show: Progress) -> dict[str, Path]:
    """Write what is generated of a run, as far as it is not there; by source its folder."""
    run, number = generated.opened, positive(generated.number, "images to generate")
    options = DatasetOptions(min_visible=generated.min_visible, box_margin=generated.box_margin)
    folders = {}
    for source in _sources(generated):
        folders[source] = into / source

        def callback(done: int, total: int) -> None:
            show("generating", done, total)

        if source == "learnt":
            w = 1 if run.objects else workers
            generate(run, number, into / source, seed, w, "coco", callback, options)
        else:
            generate_scenes(run.model, run.policy(source), number, into / source, seed, "coco", callback, options)
    return folders


def size_for(sizes: Iterable[tuple[int, int]]) -> tuple[int, int]:
    """Of ``DEFAULT_AREA``, in the shape of images by their heights and widths."""
    shape = float(np.median([width / height for height, width in sizes]))
    sides = math.sqrt(DEFAULT_AREA / shape), math.sqrt(DEFAULT_AREA * shape)
    height, width = (max(SIDE_MULTIPLE, SIDE_MULTIPLE * round(side / SIDE_MULTIPLE)) for side in sides)
    return height, width


def _digests(planned: Plan, loaded: Mapping[str, LabelledSet], shared: Mapping[str, Any]) -> dict[str, str]:
    """By row, of what its trainings depend on; where rows start from the one before also of those before it."""
    of_source = {name: digest_of(found) for name, found in loaded.items()}

    def one(row: Row) -> str:
        stages = [[(of_source[part.source], part.number) for part in stage] for stage in row.stages]
        averages = ["weights averaged"] * (len(stages) > 1)  # earlier versions did not
        return hashlib.sha256(repr((stages, shared, *averages)).encode()).hexdigest()

    digests: dict[str, str] = {}
    for row in planned.rows:
        before = "".join(digests.values()) if shared["chain"] else ""
        digests[row.name] = hashlib.sha256((before + one(row)).encode()).hexdigest()[:32]
    return digests


def check_same(record: Path, settings: Mapping[str, Any], what: str, more: str = "") -> None:
    """See that settings are those in a file.

    Args:
        what: was begun with them, and
        more: a last sentence, for messages.

    Raises:
        RunError: they are not, or the file is damaged.
    """
    try:
        before = json.loads(record.read_text(encoding="utf-8"))
    except ValueError as error:
        raise RunError(f"expected settings in {record}, got a damaged file; name another folder.") from error
    differing = [key for key in settings if before.get(key) != settings[key]]
    if differing:
        was, now = (", ".join(f"{key} {str(s.get(key))[:60]}" for key in differing) for s in (before, settings))
        raise RunError(
            f"expected the settings that {what} was begun with ({was}), got {now}; give the same, or name another "
            f"folder.{more}"
        )


def _bind(out: Path, shared: dict[str, Any]) -> None:
    """Make the folder ready, or see that it holds a trial of the same settings."""
    record = out / "trial.json"
    make_folder(out)
    if record.is_file():
        check_same(record, shared, f"the trial in {out}", " Sets and seeds can be added.")
        return
    others = sorted(entry.name for entry in out.iterdir() if not entry.name.startswith("."))
    if others:
        raise DataError(f"expected a new or empty folder for the trial, got {out} with {', '.join(others[:5])} in it.")
    write_json(record, {**shared, "rows": {}})
