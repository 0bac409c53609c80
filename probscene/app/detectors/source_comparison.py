"""Which of a run's sources trains the best detector for its photographs; no label is needed.

A fit can bring whole images nearer to photographs, and what it generates can train a worse detector: detectors gain by
many objects and by looks that vary. So a small detector is trained on each source, all from one initialisation and with
one budget. It counts the objects in photographs of the run's target, and its counts are compared with those that the
run's feature network reads in the same photographs:

    agreement = mean over classes of the correlation of both, by image, at the score from which on it is largest

Axis letters: L photographs, C classes, T scores.
"""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from probscene.dataset import Images
from probscene.device import chosen_device
from probscene.threads import threads

from ..chunks import chunk_randomness
from ..datasets.generate import DatasetOptions, generate_scenes
from ..evaluation.estimate import class_counts, counted_classes
from ..files import make_folder, write_json
from ..fitting.run import GENERATED_SOURCES, RunFolder
from ..fitting.scene_features import kept_features
from ..labels.naming import composed
from ..pictures import pixels
from ..progress import Progress
from ..trial.detector import RECIPES, Recipe, build
from ..trial.sets import read_set
from ..trial.training import Stage, detect_in, train
from ..trial.trial import size_for

MAX_PHOTOGRAPHS = 300
SCORES = np.linspace(0.05, 0.9, 35)
MIN_SD = 0.05  # objects, of what is read of a class: with less, all photographs read alike
FIRST = ("learnt", "prior")  # others are tested only where the prior is better than what was learnt
NUM_IMAGES = 300  # that ``compare_and_keep`` generates for each detector
MIN_VISIBLE = 0.2  # of a labelled object there
SEEDS = 2  # detectors there of each source
RESULT = "agreement.json"

Array = NDArray[np.float64]


class DetectorBudget(NamedTuple):
    """How the detectors of a test are trained.

    Attributes:
        detector: see ``trial.detector.build``.
        recipe: of each.
        size: height and width at which images come.
        images: generated for each.
        dataset: how they are labelled.
        seed: of the images, the first initialisation and its order.
        seeds: detectors of each source.
        device: where, see ``chosen_device``.
    """

    detector: str
    recipe: Recipe
    size: tuple[int, int]
    images: int
    dataset: DatasetOptions
    seed: int
    seeds: int = 1
    device: str = "cpu"


class SourceComparison(NamedTuple):
    """What was found.

    Attributes:
        source: the best of those that were compared, in the mean over seeds.
        agreement: by source, of each seed, -1 to 1.
        classes: that were compared.
        photographs: how many.
    """

    source: str
    agreement: dict[str, list[float]]
    classes: tuple[str, ...]
    photographs: int

    def is_better(self, source: str, other: str) -> bool:
        """Whether one source that was compared agrees better than another, with every seed."""
        both = self.agreement.get(source, []), self.agreement.get(other, [])
        return bool(both[0]) and all(a > b for a, b in zip(*both, strict=True))

    def record(self) -> dict[str, Any]:
        """For JSON."""
        return {**self._asdict(), "classes": list(self.classes)}

    def __str__(self) -> str:
        figures = ", ".join(f"{name} {np.mean(values):.3f}" for name, values in self.agreement.items())
        return (
            f"Detectors that were trained on each source count {', '.join(self.classes)} in {self.photographs} "
            f"photographs. Correlation with what the fit reads there: {figures}. Best: {self.source}."
        )


def compare_sources(
    run: RunFolder, images: Images, budget: DetectorBudget, into: Path, show: Progress
) -> SourceComparison | None:
    """Compare a run's sources; None where there is nothing to choose from, or nothing that photographs can be read by.

    Args:
        images: of the run's target.
        into: a folder for what is made, deleted at the end; the same call goes on after an interruption.

    Raises:
        RunError: see ``RunFolder.guide``.
        MachineError: the disk is full.
    """
    sources = [name for name in GENERATED_SOURCES if name in run.generated_sources() and name != "start"]
    reading = _reading(run, images)
    if run.guide is run.model.prior or reading is None:
        return None
    classes, rows, read = reading
    make_folder(into)
    file, agreement = into / RESULT, dict[str, list[float]]()
    if file.is_file():
        agreement = json.loads(file.read_text(encoding="utf-8"))
    each, wanted, shown = budget.recipe.num_images + len(rows), len(FIRST), 0

    def more(number: int) -> None:
        nonlocal shown
        shown += number
        show("training", shown, each * wanted * budget.seeds)

    for source in (*FIRST, *(name for name in sources if name not in FIRST)):
        if source not in FIRST and np.mean(agreement["learnt"]) >= np.mean(agreement["prior"]):
            break
        wanted = len(FIRST) if source in FIRST else len(sources)
        done = agreement.setdefault(source, [])
        more(each * len(done))
        for seed in range(budget.seed + len(done), budget.seed + budget.seeds):
            count, found = _trained(run, source, budget._replace(seed=seed), into / f"{source}-{seed}", more), []
            for row in rows:
                found.append(count(pixels(images.load(row)[None])[0], classes))
                more(1)
            done.append(count_agreement(np.stack(found, 1), read))
            write_json(file, agreement)
    shutil.rmtree(into)
    best = max(agreement, key=lambda name: np.mean(agreement[name]))
    return SourceComparison(best, agreement, classes, len(rows))


def compare_and_keep(
    run: RunFolder, images: Images, show: Progress, say: Callable[[str], None], device: str = "cpu"
) -> SourceComparison | None:
    """Compare a run's sources, keep what was found for ``train``, and give learnt parameters back where detectors are
    better with the prior's.

    Args:
        images: of the run's target.
        say: is told what was found.
        device: of the detectors, see ``chosen_device``.

    Raises:
        RunError: see ``RunFolder.guide``.
        MachineError: the disk is full.
    """
    recipe = RECIPES["efficientnet"]
    recipe = recipe._replace(iterations=recipe.iterations // 2)
    dataset = DatasetOptions(min_visible=MIN_VISIBLE)
    budget = DetectorBudget(
        "efficientnet", recipe, size_for([run.model.canvas]), NUM_IMAGES, dataset, run.record["seed"], SEEDS, device
    )
    found = compare_sources(run, images, budget, run.path / "sources", show)
    if found is None:
        say("Sources are not compared by detectors: nothing was learnt, or nothing can be read in the photographs.")
        return None
    say(str(found))
    if found.is_better("structure", "learnt"):
        run.give_back_parameters("detectors count better when they are trained on scenes with the prior's")
        say("All sites keep the prior, as detectors count better with it.")
        found = found._replace(source="learnt" if found.source == "structure" else found.source)
    run.write_sources(found.record())
    return found


def count_agreement(found: NDArray[np.int64], read: Array) -> float:
    """The mean over classes of the largest correlation over scores.

    Args:
        found: ``(T, L, C)`` counts from each score on.
        read: ``(L, C)``, not the same for all photographs.
    """
    x, y = found - found.mean(1, keepdims=True), read - read.mean(0)
    norm = np.sqrt(np.square(x).sum(1) * np.square(y).sum(0))
    correlation = np.where(norm > 0, (x * y).sum(1) / np.maximum(norm, 1e-12), 0.0)
    return float(correlation.max(0).mean())


def _reading(run: RunFolder, images: Images) -> tuple[tuple[str, ...], list[int], Array] | None:
    """The classes that can be read, the numbers of some photographs, and what is read in them ``(L, C)``."""
    features = kept_features(run, images)
    counts = None if features is None else class_counts(run.model, run.feature_names, features)
    if counts is None:
        return None
    names = counted_classes(run.model, run.feature_names)
    varies = counts.std(0) >= MIN_SD
    used = [c for c, name in enumerate(names) if varies[c] and name not in (*run.unread, *run.model.stuff)]
    if not used:
        return None
    rows = np.linspace(0, len(images) - 1, min(MAX_PHOTOGRAPHS, len(images))).round().astype(int).tolist()
    return tuple(names[c] for c in used), rows, counts[rows][:, used].double().numpy()


def _trained(
    run: RunFolder, source: str, budget: DetectorBudget, into: Path, more: Callable[[int], None]
) -> Callable[[NDArray[np.uint8], tuple[str, ...]], NDArray[np.int64]]:
    """A detector that was trained on a source: of an image ``(H, W, 3)`` the counts ``(T, C)`` of some classes."""
    generate_scenes(run.model, run.policy(source), budget.images, into, budget.seed, "coco", options=budget.dataset)
    made, recipe = read_set(into), budget.recipe
    with threads(1), chunk_randomness(budget.seed, 0):
        network = build(budget.detector, len(made.classes), budget.size).to(chosen_device(budget.device))
        stage = Stage((made.examples,), recipe.num_images)
        train(network, [stage], recipe, budget.size, (budget.seed, 0), more)

    def count(image: NDArray[np.uint8], classes: tuple[str, ...]) -> NDArray[np.int64]:
        with threads(1):
            found = detect_in(network, image, budget.size, recipe.first_label)
        seen = found.scores >= SCORES[:, None]
        return np.stack([(seen & (found.classes == made.classes.index(composed(name)))).sum(1) for name in classes], 1)

    return count
