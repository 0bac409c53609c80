"""Is everything random in a program a site? Only then one seed gives one dataset, and an image can be remade from its
line of ``provenance.jsonl``."""

from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from probscene.batch import Renderer
from probscene.derivation import Derivation
from probscene.model import SceneModel
from probscene.request import Renderable, Request
from probscene.sampling import Scenes, run_program

from ..chunks import chunk_randomness

SCENES = 4


def hidden_randomness(
    model: SceneModel, derivation: Derivation, render: Renderer, again: SceneModel | None = None
) -> list[str]:
    """A fault where a few scenes differ when they are drawn again: by the same seed, also from the model's file
    imported ``again``, or from the values of their sites by another seed. Each scene is rendered three or four times;
    of a generator's, what it is asked for is compared."""

    def run(seed: int, values: dict[str, Tensor] | None = None, of: SceneModel = model) -> Scenes:
        with chunk_randomness(seed, 0):
            return run_program(of, derivation, values, density=False)

    first = run(1)
    where = {
        "where it runs twice with the same seed": run(1),
        "where its sites have the recorded values, as remake gives them, and the seed is another": run(
            2, first.parameters
        ),
    }
    if again is not None:
        where["where its file is imported again"] = run(1, of=again)
    # Rendered outside ``run``: a renderer of the user's may draw random numbers, too.
    rendered = list(_rendered(first.drawing, render))
    differs = [words for words, other in where.items() if not _same(rendered, list(_rendered(other.drawing, render)))]
    if not differs:
        return []
    return [
        f"expected the program to draw the same scenes again, got other ones {', and '.join(differs)}: something "
        "random is no site (torch.rand, random, numpy's generators), or is kept from call to call. Draw it with "
        "pyro.sample, such as shift = pyro.sample('shift', dist.Uniform(0.0, 1.0))."
    ]


def _same(one: list, other: list) -> bool:
    return all(_equal(*pair) for pair in zip(one, other, strict=True))


def _rendered(drawing: Renderable, render: Renderer) -> Iterator[Any]:
    if isinstance(drawing, Request):
        yield drawing.records((0, 0))
        yield from vars(drawing.photo).values() if drawing.photo is not None else ()
    else:
        batch = render(drawing)
        yield from (batch.image, batch.instance, batch.amodal_box)


def _equal(one: Any, other: Any) -> bool:
    return torch.equal(one, other) if isinstance(one, Tensor) else one == other
