"""Whether photographs' labels leave more room around objects than those of generated images."""

import math

import numpy as np
import torch

from probscene.decoding import read_rgb
from probscene.inference.statistics.box_margin import EdgeProfiles, edge_profiles, estimate_margin

from ..arguments import margin_text
from .sets import LabelledSet

MAX_IMAGES = 256  # of each set


def looser(
    photographs: LabelledSet,
    made: LabelledSet,
    margin: int | dict[str, int] = 0,
    value_range: tuple[float, float] | None = None,
) -> str | None:
    """What to say where people left more room; None where they did not, or nobody can say, see ``estimate_margin``.

    Args:
        made: generated images, whose boxes have a ``margin``, see ``checked_box_margin``.
        value_range: of photographs of 16 bits.
    """
    own, generated = set_profiles(photographs, value_range), set_profiles(made)
    given = dict.fromkeys(made.classes, margin) if isinstance(margin, int) else margin
    scale = math.sqrt(math.prod(made.examples[0].size) / math.prod(photographs.examples[0].size))
    found = {name: estimate_margin(own, generated, number) for number, name in enumerate(made.classes)}
    resized = {name: margin.resized(scale) for name, margin in found.items() if margin is not None}
    more = {name: margin for name, margin in resized.items() if round(margin.pixels)}
    if not more:
        return None
    words = ", ".join(f"{name} {margin}" for name, margin in more.items())
    total = {name: given.get(name, 0) + (round(more[name].pixels) if name in more else 0) for name in made.classes}
    wider = margin_text({name: pixels for name, pixels in total.items() if pixels})
    return (
        f"Labels of the photographs leave more room around objects than those of generated images, in pixels of these "
        f"on each side: {words}. For boxes like theirs, use --box-margin {wider}."
    )


def set_profiles(found: LabelledSet, value_range: tuple[float, float] | None = None) -> EdgeProfiles:
    """Of at most ``MAX_IMAGES`` images of a set."""
    parts = []
    for number, example in enumerate(found.examples[:MAX_IMAGES]):
        image = torch.from_numpy(read_rgb(example.path, value_range)).permute(2, 0, 1)
        label = torch.from_numpy(np.where(example.real, example.classes, -1))
        part = edge_profiles(image[None], torch.from_numpy(example.boxes)[None], label[None])
        parts.append(part._replace(image=part.image + number))
    return EdgeProfiles(*map(np.concatenate, zip(*parts, strict=True)))
