"""Pictures of scenes: grids, with the labels drawn in where they are asked for."""

import colorsys
import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from probscene.app.files import make_folder, write_whole
from probscene.app.loading import load_model, renderer_for
from probscene.app.provenance import chunk_randomness
from probscene.app.run import Run, is_run
from probscene.batch import RenderBatch
from probscene.errors import DataError, ProbsceneError
from probscene.model import SceneModel
from probscene.policy import Policy
from probscene.sampling import sample

GAP = 2  # pixels between the images of a grid
LINE = (96, 96, 96)

Pixels = NDArray[np.uint8]


def preview(
    model_or_run: str, out: Path, num: int = 16, seed: int = 0, boxes: bool = False, assets: Path | None = None
) -> None:
    """Write a grid of scenes of a model's prior, or of a run's learnt structures, as a PNG.

    Args:
        assets: see ``opened``.

    Raises:
        ProbsceneError: a number that is not positive; see ``load_model`` and ``Run.guide``.
        DataError: ``out`` is a folder.
        MachineError: it cannot be written.
    """
    if num < 1:
        raise ProbsceneError(f"Expected a positive number of images, actual {num}.")
    out = Path(out)
    if out.is_dir():
        raise DataError(f"Expected a file to write the picture to, actual the folder {out}; name a file in it.")
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
        ProbsceneError: assets of a run, which has its own; see ``load_model`` and ``Run.guide``.
    """
    if is_run(model_or_run):
        if assets is not None:
            raise ProbsceneError(
                f"Expected a model with --assets, actual the run {model_or_run}, which is drawn with what it was "
                "fitted with; leave --assets out."
            )
        run = Run.open(Path(model_or_run))
        return run.model, run.guide()
    model = load_model(model_or_run, assets)
    return model, model.prior


def scenes(model: SceneModel, policy: Policy, num: int, seed: int) -> RenderBatch:
    """Renders of ``num`` scenes with structures from ``policy``; the same for the same seed."""
    with chunk_randomness(seed, 0):
        return renderer_for(model)(sample(model, policy, num).drawing)


def pixels(image: Tensor) -> list[Pixels]:
    """Images ``(N, 1 or 3, H, W)`` as N arrays ``(H, W, 3)``."""
    return [x.permute(1, 2, 0).expand(-1, -1, 3).numpy() for x in image]


def grid(images: list[Pixels], columns: int | None = None) -> Pixels:
    """Images of one size side by side, as near to a square as they go, ``(H, W, 3)``."""
    height, width, _ = images[0].shape
    columns = columns or math.ceil(math.sqrt(len(images)))
    rows = math.ceil(len(images) / columns)
    sheet = np.empty((rows * (height + GAP) + GAP, columns * (width + GAP) + GAP, 3), np.uint8)
    sheet[:] = LINE
    for i, image in enumerate(images):
        y, x = (GAP + (i // columns) * (height + GAP), GAP + (i % columns) * (width + GAP))
        sheet[y : y + height, x : x + width] = image
    return sheet


def labelled(image: Pixels, batch: RenderBatch, i: int, model: SceneModel) -> Pixels:
    """Scene ``i``'s image with the visible boxes and the names of its objects."""
    picture = Image.fromarray(image.copy())
    draw = ImageDraw.Draw(picture)
    font = ImageFont.load_default(max(10, min(model.canvas) // 20))
    for kind, box, seen in zip(batch.kind[i].tolist(), batch.box[i].tolist(), batch.pixels[i].tolist(), strict=True):
        if kind < 0 or not seen or model.grammar.kinds[kind] not in model.classes:
            continue
        name = model.grammar.kinds[kind]
        colour = colour_of(model.classes.index(name), len(model.classes))
        x0, y0, x1, y1 = box
        draw.rectangle((x0, y0, x1 - 1, y1 - 1), outline=colour)
        above = y0 > font.size + 2
        draw.text((x0, y0 - 1 if above else y1), name, colour, font, anchor="ls" if above else "la")
    return np.asarray(picture)


def colour_of(index: int, number: int) -> tuple[int, int, int]:
    """One of ``number`` colours, RGB, apart in hue and bright enough on black."""
    red, green, blue = colorsys.hls_to_rgb(index / max(1, number), 0.62, 0.95)
    return round(255 * red), round(255 * green), round(255 * blue)


def side_by_side(groups: dict[str, list[Pixels]], size: int = 128) -> Pixels:
    """A grid for each group under its caption, one beside the other; images are shrunk to ``size`` pixels."""
    grids = {caption: grid([shrunk(image, size) for image in images]) for caption, images in groups.items()}
    margin, head = 16, 40
    width = sum(g.shape[1] for g in grids.values()) + margin * (len(grids) + 1)
    height = max(g.shape[0] for g in grids.values()) + head + margin
    sheet = Image.new("RGB", (width, height), (255, 255, 255))
    draw, font, x = ImageDraw.Draw(sheet), ImageFont.load_default(20), margin
    for caption, picture in grids.items():
        draw.text((x, head - 10), caption, (20, 20, 20), font, anchor="ls")
        sheet.paste(Image.fromarray(picture), (x, head))
        x += picture.shape[1] + margin
    return np.asarray(sheet)


def shrunk(image: Pixels, size: int) -> Pixels:
    """At most ``size`` pixels high and wide."""
    if max(image.shape[:2]) <= size:
        return image
    picture = Image.fromarray(image)
    picture.thumbnail((size, size), Image.Resampling.BOX)
    return np.asarray(picture)


def write_picture(path: Path, picture: Pixels) -> None:
    """A PNG, whole or not at all."""
    write_whole(path, lambda temporary: Image.fromarray(picture).save(temporary, "PNG"))
