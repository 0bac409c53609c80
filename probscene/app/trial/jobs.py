"""The trainings of a trial: each is one file of what its detector finds in the test images, whole or absent.

    trainings/ROW-SEED.safetensors     boxes, classes, scores and images of all detections
    trainings/ROW-SEED.weights         where rows start from the one before, until the next is trained

Rows are trained seed by seed, so that the first seed of all is there first.
"""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import safetensors.torch
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import load_file, save_file

from probscene.device import CPU
from probscene.errors import RunError
from probscene.threads import threads

from ..chunks import chunk_randomness
from ..files import make_folder, write_whole
from ..workers.processes import spread
from .detector import Recipe, build
from .plan import Part, chosen
from .sets import Example, LabelledSet
from .training import Detections, Stage, detect, train

WARM_START_RATES = (1.0, 0.5, 0.1)  # of the first row, the second, and those after it, in the paper's supplement
FINETUNE_RATE = 0.5  # of a row's later stages


class Job(NamedTuple):
    """All that a process needs to train any of a trial's detectors.

    Attributes:
        out: the trial's folder.
        choice: the detector, see ``detector.build``.
        size: height and width at which images come.
        rows: by name, what is shown: stages of parts.
        digests: by row, what its trainings depend on.
        finetune_fraction: the share of the images that the last of several stages is shown.
        warm_start: every row starts from the detector of the row before.
        value_range: of images of 16 bits, see ``decoding.read_rgb``.
        device: where detectors are trained and detect.
    """

    out: Path
    choice: str
    recipe: Recipe
    size: tuple[int, int]
    classes: tuple[str, ...]
    rows: dict[str, tuple[tuple[tuple[LabelledSet, Part], ...], ...]]
    digests: dict[str, str]
    test: tuple[Example, ...]
    seeds: int
    seed: int
    finetune_fraction: float
    warm_start: bool
    value_range: tuple[float, float] | None = None
    device: torch.device = CPU

    def run(self, workers: int, progress: Callable[[int, int], None]) -> None:
        """Do what is missing; ``progress`` is called with the number of images shown, and of all.

        Raises:
            ProbsceneError: a loss that is not finite.
            MachineError: the disk is full, or a worker was killed.
        """
        make_folder(self.out / "trainings")
        budget, names = self.recipe.num_images, tuple(self.rows)
        total = budget * len(names) * self.seeds
        there = sum(self.is_done(name, s) for name in names for s in range(self.seeds))
        done = budget * there
        progress(done, total)

        def shown(number: int) -> None:
            nonlocal done
            done += number
            progress(done, total)

        width = 1 if self.warm_start else len(names)
        tasks = [task for task in range(width * self.seeds) if self._missing(task)]
        if workers == 1:
            with threads(1):
                for task in tasks:
                    self.work(task, shown)
        elif tasks:
            lacking = {task: len(self._missing(task)) for task in tasks}
            spread(_worker, (self,), workers, tasks, lambda task: shown(budget * lacking[task]))

    def work(self, task: int, shown: Callable[[int], None] = lambda number: None) -> int:
        """Train one detector, or where rows start from the one before all rows for a seed; returns the task."""
        names = tuple(self.rows)
        for name in self._missing(task):
            row, s = names.index(name), self._seed_of(task)
            # The same start and order for all rows, whatever was drawn before.
            with chunk_randomness(self.seed, s):
                detector = build(self.choice, len(self.classes), self.size).to(self.device)
                rate = 1.0
                if self.warm_start:
                    rate = WARM_START_RATES[min(row, len(WARM_START_RATES) - 1)]
                    if row:
                        before = self._weights(names[row - 1], s)
                        detector.load_state_dict(safetensors.torch.load_file(before))
                stages = self.stages(name, s, rate)
                train(detector, stages, self.recipe, self.size, (self.seed, s), shown, self.value_range)
            like = self.size, self.recipe.first_label, self.value_range
            found = [detect(detector, example.path, *like) for example in self.test]
            if self.warm_start and row + 1 < len(names):
                state = {key: value.cpu().contiguous() for key, value in detector.state_dict().items()}
                write_whole(self._weights(name, s), partial(safetensors.torch.save_file, state))
            write_whole(self._file(name, s), partial(_save, found, {"settings": self.digests[name]}))
            if self.warm_start and row:
                self._weights(names[row - 1], s).unlink(missing_ok=True)
        return task

    def stages(self, name: str, seed: int, rate: float = 1.0) -> list[Stage]:
        """What a row's detector is shown for a seed."""
        parts = [
            tuple(chosen(found, part, seed + 1000 * self.seed) for found, part in stage) for stage in self.rows[name]
        ]
        return stages_of(parts, self.recipe.num_images, self.finetune_fraction, rate)

    def detections(self, name: str, seed: int) -> list[Detections]:
        """What a finished training's detector found, by test image."""
        tensors = load_file(self._file(name, seed))
        of = tensors["images"]
        return [
            Detections(*(tensors[key][of == i] for key in ("boxes", "classes", "scores")))
            for i in range(len(self.test))
        ]

    def is_done(self, name: str, seed: int) -> bool:
        """Whether a training is finished.

        Raises:
            RunError: one of other settings is.
        """
        file = self._file(name, seed)
        if not file.is_file():
            return False
        try:
            with safe_open(file, "np") as opened:
                before = (opened.metadata() or {}).get("settings")
        except SafetensorError:
            return False
        if before != self.digests[name]:
            raise RunError(
                f"expected the set {name!r} as {file} was trained on, got another; rename the set, or name another "
                "folder."
            )
        return True

    def _missing(self, task: int) -> list[str]:
        names, s = tuple(self.rows), self._seed_of(task)
        own = names if self.warm_start else (names[task % len(names)],)
        return [name for name in own if not self.is_done(name, s)]

    def _seed_of(self, task: int) -> int:
        return task if self.warm_start else task // len(self.rows)

    def _file(self, name: str, seed: int) -> Path:
        return self.out / "trainings" / f"{name}-{seed}.safetensors"

    def _weights(self, name: str, seed: int) -> Path:
        return self.out / "trainings" / f"{name}-{seed}.weights"


def stages_of(
    parts: Sequence[tuple[tuple[Example, ...], ...]], num_images: int, finetune_fraction: float, rate: float = 1.0
) -> list[Stage]:
    """Stages, one after the other, that show so many images in all.

    Args:
        parts: of each stage, see ``Stage``.
        finetune_fraction: the share of the images that the last of several stages is shown.
        rate: of the first, a factor of the recipe's; later ones have ``FINETUNE_RATE`` times that, and average weights.
    """
    last = round(finetune_fraction * num_images) if len(parts) > 1 else num_images
    before = [(num_images - last) // max(1, len(parts) - 1)] * (len(parts) - 1)
    if before:
        before[0] += num_images - last - sum(before)
    return [
        Stage(part, number, rate * (FINETUNE_RATE if i else 1.0), averages_weights=i > 0)
        for i, (part, number) in enumerate(zip(parts, [*before, last], strict=True))
    ]


def _save(found: list[Detections], metadata: dict[str, str], path: Path) -> None:
    images = np.concatenate([np.full(len(each.scores), i, np.int64) for i, each in enumerate(found)])
    arrays: dict[str, NDArray] = {"images": images}
    for key in Detections._fields:
        arrays[key] = np.ascontiguousarray(np.concatenate([getattr(each, key) for each in found]))
    save_file(arrays, path, metadata)


def _worker(job: Job) -> Callable[[int], int]:
    return job.work
