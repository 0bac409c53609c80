"""Stained blood smears under the microscope: red cells, white cells and platelets, for photographs that you bring.

    python examples/blood_smear.py PHOTOGRAPHS --out beside.png     # photographs above, scenes of the prior below
    probscene fit examples/blood_smear.py --target PHOTOGRAPHS --out runs/blood

PHOTOGRAPHS is a folder of images of 640 x 480 pixels in which a red cell is about 100 across. Colours and sizes were
taken from looking at them; how many cells the prior has is a guess. See ``docs/tutorials/photographs_by_hand.md``.
"""

import argparse
import math
from itertools import chain
from pathlib import Path

import cv2
import numpy as np
import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

import probscene as ps
from probscene.drawing import Atlas

GRAMMAR = ps.Grammar("""
    Scene     -> Reds Whites Platelets
    Reds      -> rbc Reds | ε
    Whites    -> wbc Whites | ε
    Platelets -> platelet Platelets | ε
""")
PRIOR = ps.StructurePrior(
    GRAMMAR, Reds=ps.counts(*[1] * 41), Whites=ps.counts(1, 1, 1, 1), Platelets=ps.counts(*[1] * 9)
)
HEIGHT, WIDTH = 240, 320  # pixels: half of the photographs
RED, WHITE, PLATELET = 27.5, 49.0, 6.0  # typical radii, pixels of the canvas
FOCUS = (0.6, 1.2, 2.2)  # pixels of blur that every sprite is drawn with
DIRT, CROWD = 16, 6  # specks at most; steps in which cells push one another apart
CLASSES = ("rbc", "wbc", "platelet")


def outline(rng: np.random.Generator, size: int, radius: float, wobble: float, x=0.0, y=0.0) -> np.ndarray:
    """How far each pixel lies inside a bumpy disc around (x, y) of the middle, pixels, ``(size, size)``."""
    dy, dx = np.mgrid[:size, :size] + 0.5 - size / 2 - np.reshape((y, x), (2, 1, 1))
    angle, edge = np.arctan2(dy, dx), np.ones((size, size))
    for waves in range(2, 7):
        edge += wobble / waves * rng.normal() * np.cos(waves * angle + rng.uniform(0, 6.3))
    return radius * edge - np.hypot(dx, dy)


def grain(rng: np.random.Generator, size: int, wave: float) -> np.ndarray:
    """Smooth noise of standard deviation 1, ``(size, size, 1)``."""
    noise = cv2.GaussianBlur(rng.normal(size=(size, size)), (0, 0), wave)[..., None]
    return noise / noise.std()


def sprites(colour: np.ndarray, alpha: np.ndarray) -> list[np.ndarray]:
    """One look at every focus, RGBA."""
    whole = np.dstack([np.clip(colour, 0, 255) * alpha[..., None], 255 * alpha])
    blurred = [cv2.GaussianBlur(whole, (0, 0), blur) for blur in FOCUS]
    straight = [np.dstack([w[..., :3] * 255 / np.maximum(w[..., 3:], 1), w[..., 3]]) for w in blurred]
    return [np.rint(np.clip(pixels, 0, 255)).astype(np.uint8) for pixels in straight]


def red(rng: np.random.Generator, pallor: float) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """A red cell of radius 27.5, paler in the middle, and what it takes of the light that comes through others."""
    inside = outline(rng, 72, RED, 0.1)
    middle = outline(rng, 72, rng.uniform(9, 17), 0.25, *rng.normal(0, 2.5, 2))
    pale = pallor * np.clip(middle / 7 + 0.5, 0, 1)[..., None]
    rim = np.exp(-((inside / 3) ** 2))[..., None]
    colour = (200, 178, 178) + pale * (10, 34, 32) - rim * (2, 8, -4) + 2 * grain(rng, 72, 4) + 4 * grain(rng, 72, 0.7)
    there, shade = np.clip(inside + 0.5, 0, 1), np.broadcast_to((134.0, 88.0, 92.0), colour.shape)
    return sprites(colour, there * (0.8 - 0.15 * pale[..., 0])), sprites(shade, there * 0.2 * (1 - 0.9 * pale[..., 0]))


def white(rng: np.random.Generator, form: str) -> list[np.ndarray]:
    """A white cell of radius 49: cytoplasm and a nucleus of lobes."""
    size, plain = 124, form == "lymphocyte"
    inside = outline(rng, size, 0.8 * WHITE if plain else WHITE, 0.06 if form == "neutrophil" else 0.12)
    colour = np.array({"neutrophil": (202, 176, 210), "eosinophil": (198, 142, 174)}.get(form, (190, 182, 214)), float)
    colour = colour + grain(rng, size, 1.6) * {"eosinophil": (24, 38, 26), "neutrophil": (6, 10, 6)}.get(form, 4)
    lobes = {"neutrophil": rng.integers(3, 6), "eosinophil": 2}.get(form, 1)
    start, nucleus = rng.uniform(0, 6.3), np.full((size, size), -99.0)
    radii = {"neutrophil": (13, 19), "eosinophil": (18, 23), "lymphocyte": (36, 39)}.get(form, (32, 42))
    for lobe in range(lobes):
        turn, away = start + lobe * rng.uniform(1.1, 1.9), 0.0 if lobes == 1 else rng.uniform(18, 28)
        part = outline(rng, size, rng.uniform(*radii), 0.1 if plain else 0.2, away * np.cos(turn), away * np.sin(turn))
        nucleus = np.logaddexp(nucleus / 3, part / 3) * 3
    purple = (146, 108, 226) - rng.uniform(0, 80 if plain else 35) * np.array((1, 0.6, 0.5)) + 9 * grain(rng, size, 3)
    cover = np.clip(nucleus / 3 + 0.5, 0, 1)[..., None]
    alpha = np.clip(inside / 2 + 0.5, 0, 1) * (0.75 + 0.22 * cover[..., 0])
    return sprites(colour * (1 - cover) + purple * cover, alpha)


def platelet(rng: np.random.Generator) -> list[np.ndarray]:
    """A small violet body of radius 6, grainy and ragged, some as pale as the slide."""
    inside = outline(rng, 28, PLATELET, 0.2)
    core = np.clip(outline(rng, 28, 4, 0.25) / 3 + 0.5, 0, 1)[..., None]
    stain = (182, 164, 222) - core * (38, 50, 4) + 10 * grain(rng, 28, 1)
    return sprites(stain + rng.uniform(0, 0.5) * (224 - stain), 0.9 * np.clip(inside / 2 + 0.5, 0, 1))


def field(rng: np.random.Generator) -> np.ndarray:
    """The empty slide, lit unevenly."""
    slope = rng.normal(0, 3, 2)
    y, x = np.mgrid[-1 : 1 : HEIGHT * 1j, -1 : 1 : WIDTH * 1j]
    light = slope[0] * x + slope[1] * y - rng.uniform(0, 6) * (x**2 + y**2)
    noise = cv2.GaussianBlur(rng.normal(0, 6, (HEIGHT, WIDTH, 3)), (0, 0), 0.7)
    rgb = (222, 223, 218) + light[..., None] * (0.8, 1.0, 1.2) + noise
    return np.dstack([np.clip(rgb, 0, 255), np.full((HEIGHT, WIDTH), 255)]).round().astype(np.uint8)


def speck(rng: np.random.Generator) -> list[np.ndarray]:
    """A bubble or dirt: a dark ring around a light spot, too faint to hide what it lies on."""
    ring = outline(rng, 20, rng.uniform(2, 5), 0.25)
    alpha = np.clip(ring / 2 + 1, 0, 1) * rng.uniform(0.25, 0.49)
    light = np.clip(ring - rng.uniform(0.5, 3), 0, 1)[..., None]
    return sprites(np.array((120, 96, 96)) * (1 - light) + 250.0 * light, alpha)


RNG = np.random.default_rng(0)
LOOKS = zip(*(red(RNG, pallor) for pallor in np.linspace(0, 1, 12)), strict=True)
REDS, SHADES = (Atlas(tuple(chain(*looks))) for looks in LOOKS)
FORMS = ("neutrophil", "neutrophil", "eosinophil", "lymphocyte", "lymphocyte", "monocyte")
WHITES = Atlas(tuple(chain(*(white(RNG, form) for form in FORMS * 4))))
PLATELETS = Atlas(tuple(chain(*(platelet(RNG) for _ in range(12)))))
SPECKS = Atlas(tuple(chain(*(speck(RNG) for _ in range(6)))))
FIELDS = Atlas(tuple(field(RNG) for _ in range(8)))


def settled(x: Tensor, y: Tensor, radius: Tensor, there: Tensor, close: Tensor) -> tuple[Tensor, Tensor]:
    """Cells at x and y in 0..1 push one another away, small ones farther, to ``close`` times their radii; pixels."""
    total, margin = radius[:, :, None] + radius[:, None, :], 0.3 * radius  # a third of a cell stays on the canvas
    x, y = (WIDTH + 2 * margin) * x - margin, (HEIGHT + 2 * margin) * y - margin
    yields = there[:, :, None] * there[:, None, :] * (radius[:, None, :] / total) ** 2
    for _ in range(CROWD):
        dx, dy = x[:, :, None] - x[:, None, :], y[:, :, None] - y[:, None, :]
        far = (dx**2 + dy**2).clamp(min=1e-3).sqrt()
        push = yields * (close[..., None] * total - far).clamp(min=0) / far
        x = torch.minimum(torch.maximum(x + (push * dx).sum(2), -margin), WIDTH + margin)
        y = torch.minimum(torch.maximum(y + (push * dy).sum(2), -margin), HEIGHT + margin)
    return x, y


@ps.scene_model(GRAMMAR, PRIOR, canvas=(HEIGHT, WIDTH), max_steps=96, classes=CLASSES)
def blood_smear(scene: ps.SceneGraph) -> ps.Drawing:
    """Lengths in pixels; sites of the whole slide are ``(N, 1)``, of cells ``(N, M)``."""
    unit = dist.Uniform(0.0, 1.0)
    slide = ("light", "dye", "hue", "focus", "close", "pale", "large", "field", "dusty")
    light, dye, hue, focus, close, pale, large, empty, dusty = (pyro.sample(f"slide.{name}", unit) for name in slide)
    with scene.nodes(*CLASSES):
        cell = ("x", "y", "turn", "look", "size", "shape", "tone")
        x, y, turn, look, size, shape, tone = (pyro.sample(f"cell.{name}", unit) for name in cell)
    with pyro.plate("dirt", DIRT, dim=-1):
        dirt_x, dirt_y, dirt, there = (pyro.sample(f"dirt.{name}", unit) for name in ("x", "y", "look", "there"))
    red, white = scene.mask("rbc"), scene.mask("wbc")
    scale = torch.where(red, 0.8 + 0.15 * large + 0.2 * size, torch.where(white, 0.7 + 0.68 * size, 0.7 + 0.7 * size))
    radius = scale * torch.where(red, RED, torch.where(white, WHITE, PLATELET))
    x, y = settled(x, y, radius, scene.mask(*CLASSES), 0.35 + 0.65 * close)
    blur = (3 * (0.75 * focus + 0.25 * tone)).long().clamp(max=2)
    narrow = scale * (1 - torch.where(red, 0.4, 0.2) * shape**2)

    def drawn(kind: str, looks: Atlas, which: Tensor, tint: Tensor, **more) -> ps.Sprites:
        sprite = 3 * (which * len(looks) / 3).long().clamp(max=len(looks) // 3 - 1) + blur
        return ps.Sprites(kind, looks, sprite, x, y, 2 * math.pi * turn, scale, narrow, tint, **more)

    grey, flat = 0.88 + 0.06 * light, (0.7 * pale + 0.8 * look - 0.2).clamp(0, 1)
    colour = torch.stack([grey - 0.03 * hue, grey, grey - 0.02 * hue], -1)
    stain = torch.stack([1 - 0.06 * dye, 0.98 - 0.08 * dye, 1 - 0.08 * dye - 0.14 * hue], -1)
    violet = torch.stack(torch.broadcast_tensors(0.9 - 0.25 * hue + 0.1 * tone, 0.84 + 0.16 * hue, 1 - 0.1 * dye), -1)
    return scene.draw(
        ps.Sprites((), FIELDS, (8 * empty).long().clamp(max=7), WIDTH / 2, HEIGHT / 2, tint=colour, present=light >= 0),
        drawn("rbc", REDS, flat, stain * (0.94 + 0.06 * tone[..., None])),
        drawn("rbc", SHADES, flat, torch.ones(3), labelled=False),
        drawn("wbc", WHITES, look, violet),
        drawn("platelet", PLATELETS, look, violet),
        ps.Sprites(
            (), SPECKS, (18 * dirt).long().clamp(max=17), WIDTH * dirt_x, HEIGHT * dirt_y, present=there < dusty
        ),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description="Photographs above, scenes of the prior below.")
    parser.add_argument("photographs", type=Path, help="folder of PNG, JPEG or TIFF images")
    parser.add_argument("--out", required=True, help="the PNG to write")
    options = parser.parse_args()
    ps.seed_everything(0)
    read = ps.ImageFolder(options.photographs, (HEIGHT, WIDTH), 3, skip_bad=True)
    if len(read) < 8:
        parser.error(f"expected at least 8 images in {options.photographs}, got {len(read)}")
    photographs = [read.load(i) for i in np.random.default_rng(0).choice(len(read), 8, replace=False)]
    drawn = ps.render(blood_smear, ps.sample(blood_smear, PRIOR, 8)).image
    rows = torch.stack([*photographs, *drawn]).reshape(4, 4, 3, HEIGHT, WIDTH).permute(0, 3, 1, 4, 2)
    if not cv2.imwrite(options.out, rows.reshape(4 * HEIGHT, 4 * WIDTH, 3).flip(-1).numpy()):
        parser.error(f"expected --out in a folder that can be written, got {options.out}")


if __name__ == "__main__":
    main()
