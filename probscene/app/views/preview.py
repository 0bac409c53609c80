"""Pictures of scenes: grids, with the labels drawn in where they are asked for."""

from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from probscene.batch import RenderBatch
from probscene.errors import DataError, ProbsceneError
from probscene.model import SceneModel
from probscene.policy import Policy
from probscene.sampling import sample

from ..chunks import chunk_randomness
from ..files import make_folder
from ..fitting.run import RunFolder, is_run
from ..loading import load_model, renderer_for
from ..pictures import Pixels, colour_of, grid, pixels, write_picture


def preview(
    model_or_run: str, out: Path, num: int = 16, seed: int = 0, boxes: bool = False, assets: Path | None = None
) -> None:
    """Write a grid of scenes of a model's prior, or of a run's learnt structures, as a PNG.

    Args:
        assets: see ``opened``.

    Raises:
        ProbsceneError: a number that is not positive; see ``load_model`` and ``RunFolder.guide``.
        DataError: ``out`` is a folder.
        MachineError: it cannot be written.
    """
    if num < 1:
        raise ProbsceneError(f"expected a positive number of images, got {num}.")
    out = Path(out)
    if out.is_dir():
        raise DataError(f"expected a file to write the picture to, got the folder {out}; name a file in it.")
    model, policy = opened(model_or_run, assets)
    batch = scenes(model, policy, num, seed)
    images = pixels(batch.image)
    if boxes:
        images = [labelled(image, batch, i, model) for i, image in enumerate(images)]
    make_folder(out.parent)
    write_picture(out, grid(images))


def opened(model_or_run: str, assets: Path | None = None) -> tuple[SceneModel, Policy]:
    """A model and its prior, or a run's model and what the run has learnt.

    Args:
        assets: a folder that a model is drawn with.

    Raises:
        ProbsceneError: assets of a run, which has its own; see ``load_model`` and ``RunFolder.guide``.
    """
    if is_run(model_or_run):
        if assets is not None:
            raise ProbsceneError(
                f"expected a model with --assets, got the run {model_or_run}, which is drawn with what it was "
                "fitted with; leave --assets out."
            )
        run = RunFolder.at(Path(model_or_run))
        return run.model, run.guide
    model = load_model(model_or_run, assets)
    return model, model.prior


def scenes(model: SceneModel, policy: Policy, num: int, seed: int) -> RenderBatch:
    """Renders of ``num`` scenes with structures from ``policy``; the same for the same seed."""
    with chunk_randomness(seed, 0):
        return renderer_for(model)(sample(model, policy, num).drawing)


def labelled(image: Pixels, batch: RenderBatch, i: int, model: SceneModel) -> Pixels:
    """Scene ``i``'s image with the visible boxes and the names of its objects."""
    picture = Image.fromarray(image.copy())
    draw = ImageDraw.Draw(picture)
    size = max(10, min(model.canvas) // 20)
    font = ImageFont.load_default(size)
    for kind, box, seen in zip(batch.kind[i].tolist(), batch.box[i].tolist(), batch.pixels[i].tolist(), strict=True):
        if kind < 0 or not seen or model.grammar.kinds[kind] not in model.classes:
            continue
        name = model.grammar.kinds[kind]
        colour = colour_of(model.classes.index(name), len(model.classes))
        x0, y0, x1, y1 = box
        draw.rectangle((x0, y0, x1 - 1, y1 - 1), outline=colour)
        above, x = y0 > size + 2, max(0, min(x0, picture.width - font.getlength(name)))
        draw.text((x, y0 - 1 if above else y1), name, colour, font, anchor="ls" if above else "la")
    return np.asarray(picture)
