"""Can a model's generator be relied on: are its bytes the same in fresh processes and another order, and what does an
image cost?"""

import time
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import NamedTuple

import torch

from probscene.batch import RenderBatch
from probscene.errors import ModelError
from probscene.generator import Command, Generator
from probscene.model import SceneModel
from probscene.renderers.generator.pool import close_pools
from probscene.renderers.generator.renderer import GeneratedRenderer
from probscene.sampling import sample
from probscene.threads import cores

from ..chunks import chunk_randomness

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
        images: that a fit has drawn, by preset.
    """

    command: str
    differs: tuple[str, ...]
    seconds: float
    workers: int
    reproducible: bool
    images: Mapping[str, int]

    @property
    def fault(self) -> str:
        """What to fix; empty for nothing."""
        if not self.differs or not self.reproducible:
            return ""
        return (
            f"expected the generator {self.command} to draw a scene with the same bytes by fresh processes and in "
            f"another order, got another {' and another '.join(self.differs)}; let all that is random in it come "
            "from scene.seed and keep nothing from scene to scene, or say so: Command(..., reproducible=False)."
        )

    def __str__(self) -> str:
        bytes_ = "the same bytes" if not self.differs else f"another {' and another '.join(self.differs)}"
        if self.differs and not self.reproducible:
            bytes_ += ", as its Command says; no image can be made again"
        each = [f"{name} {_told(self.seconds * images / self.workers)}" for name, images in self.images.items()]
        return (
            f"Generator {self.command}: {SCENES} scenes drawn twice, by fresh processes and in another order: "
            f"{bytes_}.\n"
            f"An image takes {1000 * self.seconds:.3g} ms. With {self.workers} at once, a fit draws for about: "
            f"{', '.join(each)}."
        )


def check_generator(model: SceneModel, images: Mapping[str, int]) -> GeneratorReport:
    """Draw a few scenes of the prior twice. Running workers of the generator are ended.

    Args:
        images: that a fit has drawn, by preset, for which the time is estimated.

    Raises:
        ModelError: the model has no generator.
        DataError: a file that it is made of cannot be read.
        GeneratorError: it cannot draw them.
    """
    if model.generator is None:
        raise ModelError(
            f"expected a model with a generator, got {model.name!r}, which probscene draws itself; leave --render out."
        )
    generator = _unkept(model.generator)
    if isinstance(generator, Command):
        generator.fingerprint()
    _end(generator)
    spent, first = _drawn(generator, model, range(SCENES))
    _end(generator)
    more, again = _drawn(generator, model, reversed(range(SCENES)))
    _end(generator)
    return GeneratorReport(
        _name(generator),
        _differs(first, again),
        (spent + more) / 2,
        _workers(generator),
        not isinstance(generator, Command) or generator.reproducible,
        images,
    )


def cost(model: SceneModel, images: int) -> str:
    """How long a fit draws so many images, in a sentence, where that is long; else empty. The workers that it starts go
    on.

    Raises:
        GeneratorError: the generator cannot draw a few scenes of the prior.
    """
    if model.generator is None:
        return ""
    generator = _unkept(model.generator)
    workers, each = _workers(generator), _drawn(generator, model, range(SCENES))[0]
    if generator != model.generator:
        _end(generator)
    seconds = each * images / workers
    if seconds < SLOW:
        return ""
    return (
        f"Note: this fit has about {images:,} images drawn, for which the generator {_name(generator)} "
        f"needs {_told(seconds)} ({1000 * each:.3g} ms an image, {workers} at once); fewer with "
        "--features count=efficientnet, and with --set structure.render_cache=4, which takes renders of equal "
        "counts again."
    )


def _unkept(generator: Generator) -> Generator:
    """The generator, of which no picture is kept: what is checked has to be drawn."""
    return replace(generator, keep=None) if isinstance(generator, Command) else generator


def _drawn(generator: Generator, model: SceneModel, order: Iterable[int]) -> tuple[float, list[RenderBatch]]:
    """Seconds an image, where scenes are drawn one by one in that order; and the pictures, in the order of the
    scenes."""
    with chunk_randomness(0, 0):
        scenes = sample(model, model.prior, SCENES).drawing
    render = GeneratedRenderer(generator, model.canvas)
    render(scenes[torch.zeros(_workers(generator), dtype=torch.int64)])  # starts all workers
    before = time.monotonic()
    found = {i: render(scenes[i : i + 1]) for i in order}
    return (time.monotonic() - before) / SCENES, [found[i] for i in range(SCENES)]


def _end(generator: Generator) -> None:
    if isinstance(generator, Command):
        close_pools(generator)


def _name(generator: Generator) -> str:
    return (
        generator.name if isinstance(generator, Command) else getattr(generator, "__name__", type(generator).__name__)
    )


def _workers(generator: Generator) -> int:
    return generator.workers or cores() if isinstance(generator, Command) else 1


def _differs(first: list[RenderBatch], again: list[RenderBatch]) -> tuple[str, ...]:
    names = [key for key in RenderBatch._fields if isinstance(getattr(first[0], key), torch.Tensor)]
    return tuple(
        key
        for key in names
        if not all(torch.equal(getattr(a, key), getattr(b, key)) for a, b in zip(first, again, strict=True))
    )


def _told(seconds: float) -> str:
    if seconds < MINUTE:
        return f"{seconds:.0f} s"
    return f"{seconds / MINUTE:.0f} min" if seconds < 2 * HOUR else f"{seconds / HOUR:.1f} h"
