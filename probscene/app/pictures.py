"""Pictures: arrays of pixels, in grids and side by side, written as PNG."""

import colorsys
import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from .files import write_whole
from .style import LIGHT

GAP = 2  # pixels between the images of a grid
LINE = (96, 96, 96)

Pixels = NDArray[np.uint8]


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


def colour_of(index: int, number: int) -> tuple[int, int, int]:
    """One of ``number`` colours, RGB, apart in hue and bright enough on black."""
    red, green, blue = colorsys.hls_to_rgb(index / max(1, number), 0.62, 0.95)
    return round(255 * red), round(255 * green), round(255 * blue)


def side_by_side(groups: dict[str, list[Pixels]], size: int = 128) -> Pixels:
    """A grid for each group under its caption, one beside the other; images are shrunk to ``size`` pixels."""
    grids = {caption: grid([shrunk(image, size) for image in images]) for caption, images in groups.items()}
    margin, head, font = 16, 40, ImageFont.load_default(20)
    widths = [max(g.shape[1], math.ceil(font.getlength(caption))) for caption, g in grids.items()]
    height = max(g.shape[0] for g in grids.values()) + head + margin
    sheet = Image.new("RGB", (sum(widths) + margin * (len(grids) + 1), height), LIGHT["paper"])
    draw, x = ImageDraw.Draw(sheet), margin
    for (caption, picture), width in zip(grids.items(), widths, strict=True):
        draw.text((x, head - 10), caption, LIGHT["ink"], font, anchor="ls")
        sheet.paste(Image.fromarray(picture), (x, head))
        x += width + margin
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
