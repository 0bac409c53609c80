"""Write a labelled dataset: images, COCO annotations and provenance.

    images/000000.png ...   grey where the model says that colour carries nothing, else RGB
    annotations.json        COCO
    provenance.jsonl        one line an image, from which it can be made again

Whatever interrupts the work, the same call goes on with the chunks that are missing; the bytes depend on the settings
alone, not on the interruptions, the number of workers or what else the process does.
"""

import json
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import NamedTuple

import cv2
import torch
from torch import Tensor

import probscene
from probscene.app import coco
from probscene.app.loading import renderer_for
from probscene.app.parts import LABELS, LINES, Parts
from probscene.app.provenance import CHUNK, as_written, chunk_randomness, provenance
from probscene.app.run import Run
from probscene.app.workers import spread
from probscene.errors import ProbsceneError
from probscene.model import SceneModel
from probscene.policy import Policy
from probscene.sampling import sample

FORMATS = ("coco", "images")
Progress = Callable[[int, int], None]


class Dataset(NamedTuple):
    """A finished dataset: its folder, and how many images this call made; 0 where it was finished before."""

    path: Path
    made: int


def generate(
    run: Run,
    num: int,
    out: Path,
    seed: int = 0,
    workers: int = 1,
    format: str = "coco",
    progress: Progress | None = None,
) -> Dataset:
    """Write ``num`` images of the learnt structures.

    Args:
        workers: processes. More than one are spawned: a script calls this under ``if __name__ == "__main__":``.
        format: ``"coco"``, or ``"images"`` for no ``annotations.json``.
        progress: called with the number of images there are and ``num``; first with what an interrupted call left.

    Raises:
        ProbsceneError: a number that is not positive, a negative seed, an unknown format.
        DataError: the folder holds other files, or a dataset of other settings.
        RunError: see ``Run.guide`` and ``Run.model``.
        MachineError: the disk is full, or a worker was killed; the same call goes on where it stopped.
    """
    if workers < 1:
        raise ProbsceneError(f"Expected a positive number of workers, actual {workers}.")
    job = _of_run(run.path, num, out, seed, format)
    if workers == 1:
        return job.run(job.each, progress)
    return job.run(partial(spread, _worker, (run.path, num, Path(out), seed, format), workers), progress)


def generate_scenes(
    model: SceneModel,
    policy: Policy,
    num: int,
    out: Path,
    seed: int = 0,
    format: str = "coco",
    progress: Progress | None = None,
) -> Dataset:
    """``generate`` from any model and structure policy, in this process.

    The folder's settings name the model and not the policy: write those of another policy to another folder.
    """
    job = Job(model, policy, num, out, seed, format)
    return job.run(job.each, progress)


def png(image: Tensor) -> bytes:
    """The bytes of a file for ``image (C, H, W)`` uint8, grey or RGB."""
    pixels = image.permute(1, 2, 0).numpy()
    if pixels.shape[2] == 3:
        pixels = cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR)
    return cv2.imencode(".png", pixels)[1].tobytes()


class Job:
    """A dataset to be written.

    Args:
        guide: SHA-256 of the policy's checkpoint, where it is a learnt one.

    Raises:
        ProbsceneError: a number that is not positive, a negative seed, an unknown format.
    """

    def __init__(
        self,
        model: SceneModel,
        policy: Policy,
        num: int,
        out: Path,
        seed: int = 0,
        format: str = "coco",
        guide: str | None = None,
    ):
        if num < 1:
            raise ProbsceneError(f"Expected a positive number of images, actual {num}.")
        if seed < 0:
            raise ProbsceneError(f"Expected a seed of 0 or more, actual {seed}.")
        if format not in FORMATS:
            raise ProbsceneError(f"Expected a format among {list(FORMATS)}, actual {format!r}.")
        self.model, self.policy, self.labelled = model, policy, format == "coco"
        self.origin = {"seed": seed, "model": model.name, "guide": guide, "version": probscene.__version__}
        self.parts = Parts(out, self.origin, num, self.labelled)
        self._renderer = renderer_for(model, threads=1)

    def run(self, work: Callable[[list[int], Callable[[int], None]], None], progress: Progress | None) -> Dataset:
        """Do what is missing by ``work(chunks, done)``, then write the labels."""
        parts, made = self.parts, 0
        chunks = parts.missing()
        before = parts.num - sum(map(parts.size, chunks))

        def done(chunk: int | None) -> None:
            nonlocal made
            made += 0 if chunk is None else parts.size(chunk)
            if progress is not None:
                progress(before + made, parts.num)

        done(None)
        work(chunks, done)
        found = (annotation for record in parts.records() for annotation in record["annotations"])
        provenance = (line for record in parts.records() for line in record["provenance"])
        lines = (json.dumps(line, ensure_ascii=False) + "\n" for line in provenance)
        labels = {LABELS: lambda path: coco.write(path, self.model, parts.num, parts.settings, found)}
        parts.finish({**(labels if self.labelled else {}), LINES: lambda path: _write_lines(path, lines)})
        return Dataset(parts.out, made)

    def each(self, chunks: list[int], done: Callable[[int], None]) -> None:
        """Make chunks one after the other."""
        for chunk in chunks:
            done(self.make(chunk))

    def make(self, chunk: int) -> int:
        """Draw, render and write a chunk; returns its number.

        Raises:
            MachineError: the disk is full.
        """
        first, size = chunk * CHUNK, self.parts.size(chunk)
        with _one_thread(), chunk_randomness(self.origin["seed"], chunk):
            scenes = sample(self.model, self.policy, CHUNK)
        batch = self._renderer(scenes.drawing[:size])
        record = {
            "annotations": coco.annotations(self.model, batch, first) if self.labelled else [],
            "provenance": provenance(self.model, scenes, first, self.origin)[:size],
        }
        self.parts.write(chunk, [png(image) for image in as_written(self.model, batch.image)], record)
        return chunk


def _of_run(run: Path, num: int, out: Path, seed: int, format: str) -> Job:
    opened = Run.open(run)
    return Job(opened.model, opened.guide(), num, out, seed, format, opened.guide_hash())


def _worker(*settings) -> Callable[[int], int]:
    """What a worker process does with a chunk's number."""
    return _of_run(*settings).make


@contextmanager
def _one_thread() -> Iterator[None]:
    """Sums of floats depend on how many threads share them."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _write_lines(path: Path, lines: Iterable[str]) -> None:
    with open(path, "w", encoding="utf-8") as file:
        file.writelines(lines)
