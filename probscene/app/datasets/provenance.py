"""Provenance: where each image of a dataset comes from, one JSON object an image, and the image made again from it.

Images are drawn in chunks of 64. A chunk's randomness comes from the seed and the chunk's number alone, and a chunk is
always drawn whole: so neither the number of images nor that of the workers changes an image. Axis letters: N scenes,
M nodes, C H W.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from pyro.poutine.messenger import Messenger
from torch import Tensor

from probscene.batch import RenderBatch
from probscene.derivation import Derivation
from probscene.errors import DataError, GrammarError
from probscene.model import SceneModel
from probscene.sampling import Scenes, run_program

from ..chunks import as_written, chunk_randomness
from ..loading import renderer_for

SHARED = 1000  # images of a folder, where there are several


def stem(index: int, flat: bool) -> str:
    """What the files of image number ``index`` are called, without ending; where not ``flat``, with a folder before it
    that a thousand images share."""
    return f"{index:06d}" if flat else f"{index // SHARED:04d}/{index:06d}"


def image_name(index: int, flat: bool) -> str:
    """The file of image number ``index``, relative to the dataset's folder."""
    return f"images/{stem(index, flat)}.png"


def provenance(
    model: SceneModel, scenes: Scenes, first: int, origin: dict[str, Any], flat: bool = True
) -> list[dict[str, Any]]:
    """One line for each scene: ``origin``, then the image's own index, rules and parameters.

    ``parameters`` gives by site the values at the nodes where it counts, in the order of the nodes; they are exact.
    """
    lines = []
    for i in range(len(scenes.derivation)):
        rules = scenes.derivation.rules[i]
        rules = rules[rules >= 0].tolist()
        lines.append(
            {
                "image": image_name(first + i, flat),
                "index": first + i,
                **origin,
                "rules": rules,
                "derivation": _spelt(model, rules),
                "parameters": {
                    site: exact(value[i][scenes.site_mask[site][i]]) for site, value in scenes.parameters.items()
                },
            }
        )
    return lines


def remake(model: SceneModel, line: dict[str, Any]) -> tuple[Tensor, RenderBatch]:
    """The image of a provenance line, from its rules and parameters: ``(C, H, W)`` uint8 as in the file, and the render
    of this one scene with its labels.

    Raises:
        DataError: a line that is not one of this model's.
    """
    try:
        rules, spelt, parameters = line["rules"], line["derivation"], dict(line["parameters"])
        known = all(0 <= rule < len(model.grammar.rules) for rule in rules) and _spelt(model, rules) == spelt
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f"expected a line of provenance.jsonl with rules and parameters, {_named(line)}.") from error
    if not known:
        raise DataError(
            f"expected a line whose rules are those of model {model.name!r}, {_named(line)}; name its model."
        )
    try:
        derivation = Derivation.from_rules(model.grammar, torch.tensor([rules], dtype=torch.int64))
    except GrammarError as error:
        raise DataError(f"expected a derivation of model {model.name!r}, {_named(line)}: {error}") from error
    if not derivation.complete.all():
        raise DataError(
            f"expected a whole derivation of model {model.name!r}, {_named(line)}, whose rules end too soon."
        )
    recorded = _Recorded(parameters)
    with chunk_randomness(0, 0):  # what does not count is drawn; that must change neither the image nor the caller
        scenes = run_program(replace(model, program=recorded(model.program)), derivation)
    recorded.check(set(scenes.parameters), line)
    batch = renderer_for(model)(scenes.drawing)
    return as_written(model, batch.image)[0], batch


class _Recorded(Messenger):
    """Gives the program's sites their recorded values where they count."""

    def __init__(self, values: dict[str, list]):
        super().__init__()
        self.values, self.wrong = values, set()

    def _pyro_sample(self, msg):
        name, fn = msg["name"], msg["fn"]
        if name not in self.values:
            return
        mask = torch.as_tensor(True if msg["mask"] is None else msg["mask"]).expand(fn.batch_shape)
        value = fn().clone()
        try:
            value[mask] = torch.tensor(self.values[name], dtype=value.dtype).reshape(int(mask.sum()), *fn.event_shape)
        except (RuntimeError, TypeError, ValueError):
            self.wrong.add(name)
        msg["value"], msg["done"] = value, True

    def check(self, sites: set[str], line: dict[str, Any]) -> None:
        wrong = sorted(self.wrong | (sites ^ set(self.values)))
        if wrong:
            raise DataError(f"expected values of the model's own sites, {_named(line)} with others of {wrong}.")


def _named(line: Any) -> str:
    return f"got that of {line['image']}" if isinstance(line, dict) and "image" in line else "got something else"


def _spelt(model: SceneModel, rules: list[int]) -> str:
    return "; ".join(str(model.grammar.rules[rule]) for rule in rules)


def exact(values: Tensor) -> list:
    """Numbers that JSON gives back to the bit; float32 with the fewest digits that do."""
    if values.dtype != torch.float32:
        return values.tolist()
    array = values.numpy()
    short = array.astype("U").astype(np.float64)
    return np.where(short.astype(np.float32) == array, short, array.astype(np.float64)).tolist()
