"""Can a model's generator be relied on: are its bytes the same in fresh processes and another order, and what does an
image cost?"""

import time
from typing import NamedTuple

import torch

from probscene.batch import RenderBatch
from probscene.errors import ModelError
from probscene.generator import Command
from probscene.model import SceneModel
from probscene.renderers.generated import GeneratedRenderer
from probscene.renderers.generator.pool import close_pools
from probscene.sampling import sample
from probscene.threads import cores

from ..chunks import chunk_randomness
from ..fitting.preset import Preset
from ..fitting.presets import PRESETS

SCENES = 3
SLOW = 600.0  # seconds of drawing of which a fit says beforehand
HOUR, MINUTE = 3600.0, 60.0


class GeneratorReport(NamedTuple):
    """What drawing a few scenes twice has shown.

    Attributes:
        command: the generator, in a word.
        differs: what of the images and labels was not the same the second time.
        seconds: an image takes, drawn by one worker.
        workers: that draw at once.
        reproducible: what its ``Command`` says.
    """

    command: str
    differs: tuple[str, ...]
    seconds: float
    workers: int
    reproducible: bool

    @property
    def fault(self) -> str:
        """What to mend; empty for nothing."""
        if not self.differs or not self.reproducible:
            return ""
        return (
            f"Expected the generator {self.command} to draw a scene with the same bytes by fresh processes and in "
            f"another order, actual another {' and another '.join(self.differs)}; let all that is random in it come "
            "from scene.seed and keep nothing from scene to scene, or say so: Command(..., reproducible=False)."
        )

    def __str__(self) -> str:
        bytes_ = "the same bytes" if not self.differs else f"another {' and another '.join(self.differs)}"
        if self.differs and not self.reproducible:
            bytes_ += ", as its Command says; no image can be made again"
        each = [f"{name} {_told(self.seconds * preset.images / self.workers)}" for name, preset in _presets().items()]
        return (
            f"Generator {self.command}: {SCENES} scenes drawn twice, by fresh processes and in another order: "
            f"{bytes_}.\n"
            f"An image takes {1000 * self.seconds:.3g} ms. With {self.workers} at once, a fit draws for about: "
            f"{', '.join(each)}."
        )


def check_generator(model: SceneModel) -> GeneratorReport:
    """Draw a few scenes of the prior twice. Running workers of any generator are ended.

    Raises:
        ModelError: the model has no generator.
        GeneratorError: it cannot draw them.
    """
    if model.generator is None:
        raise ModelError(
            f"Expected a model with a generator, actual {model.name!r}, which probscene draws itself; leave --render "
            "out."
        )
    with chunk_randomness(0, 0):
        request = sample(model, model.prior, SCENES).drawing
    render, found = GeneratedRenderer(model.generator, model.canvas, threads=1), []
    spent = 0.0
    for order in (range(SCENES), reversed(range(SCENES))):
        close_pools()
        render(request[:1])  # starts it
        before, each = time.monotonic(), {}
        for i in order:
            each[i] = render(request[i : i + 1])
        spent += time.monotonic() - before
        found.append([each[i] for i in range(SCENES)])
    close_pools()
    command = model.generator if isinstance(model.generator, Command) else None
    return GeneratorReport(
        command.name if command else getattr(model.generator, "__name__", type(model.generator).__name__),
        _differs(*found),
        spent / (2 * SCENES),
        1 if command is None else command.workers or cores(),
        command is None or command.reproducible,
    )


def cost(model: SceneModel, preset: Preset) -> str:
    """How long a fit draws, in a sentence, where that is long; else empty."""
    if model.generator is None:
        return ""
    report = check_generator(model)
    seconds = report.seconds * preset.images / report.workers
    if seconds < SLOW:
        return ""
    return (
        f"Note: this fit has about {preset.images:,} images drawn, for which the generator {report.command} needs "
        f"{_told(seconds)} ({1000 * report.seconds:.3g} ms an image, {report.workers} at once); fewer with "
        "--features count=efficientnet, and with --set reuse=4, which takes renders of equal counts again."
    )


def _differs(first: list[RenderBatch], again: list[RenderBatch]) -> tuple[str, ...]:
    names = [key for key in RenderBatch._fields if isinstance(getattr(first[0], key), torch.Tensor)]
    return tuple(
        key
        for key in names
        if not all(torch.equal(getattr(a, key), getattr(b, key)) for a, b in zip(first, again, strict=True))
    )


def _presets() -> dict[str, Preset]:
    chosen = {name: PRESETS[name] for name in ("quick", "default", "street")}
    return chosen | {"quick with count=efficientnet": PRESETS["quick"].with_features("count=efficientnet")}


def _told(seconds: float) -> str:
    if seconds < MINUTE:
        return f"{seconds:.0f} s"
    return f"{seconds / MINUTE:.0f} min" if seconds < 2 * HOUR else f"{seconds / HOUR:.1f} h"
