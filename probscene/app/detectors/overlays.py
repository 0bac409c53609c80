"""Photographs with what a detector has found in them drawn on."""

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from ..pictures import Pixels, colour_of
from ..trial.training import Detections

MIN_SIDE, MAX_SIDE = 640, 1280  # pixels of a picture's longer side, so that words can be read in small photographs


def overlay(image: NDArray[np.uint8], found: Detections, classes: tuple[str, ...]) -> Pixels:
    """A photograph ``(H, W, 3)``, larger or smaller, with boxes, classes and scores."""
    longer = max(image.shape[:2])
    scale = max(MIN_SIDE, min(MAX_SIDE, longer)) / longer
    width, height = (max(1, round(side * scale)) for side in image.shape[1::-1])
    picture = Image.fromarray(image).resize((width, height), Image.Resampling.BICUBIC)
    draw, size = ImageDraw.Draw(picture), max(12, max(width, height) // 50)
    font = ImageFont.load_default(size)
    for box, number, score in zip(found.boxes * scale, found.classes, found.scores, strict=True):
        x0, y0, x1, y1 = map(float, box)
        colour, words = colour_of(int(number), len(classes)), f"{classes[number]} {score:.2f}"
        draw.rectangle((x0, y0, max(x0, x1 - 1), max(y0, y1 - 1)), outline=colour, width=2)
        x = max(0, min(x0, width - font.getlength(words)))
        where, anchor = ((x, y0 - 1), "ls") if y0 > size + 2 else ((x, y1), "la")
        draw.rectangle(draw.textbbox(where, words, font, anchor), fill=(0, 0, 0))
        draw.text(where, words, colour, font, anchor)
    return np.asarray(picture)
