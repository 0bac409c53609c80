"""Stained blood smears under the microscope: red cells, white cells and platelets."""

import cv2
import numpy as np
import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from probscene.drawing import Atlas, Drawing, Sprites
from probscene.grammar import Grammar
from probscene.model import scene_model
from probscene.scene import SceneGraph
from probscene.structure import StructurePrior, counts

GRAMMAR = Grammar("""
    Scene     -> Reds Whites Platelets
    Reds      -> rbc Reds | ε
    Whites    -> wbc Whites | ε
    Platelets -> platelet Platelets | ε
""")
PRIOR = StructurePrior(
    GRAMMAR, Reds=counts(*[1] * 41), Whites=counts(3, 4, 2, 1), Platelets=counts(6, 5, 4, 3, 2, 1, 1, 1, 1)
)
HEIGHT, WIDTH = 240, 320  # pixels: half of the photographs
RED, WHITE, PLATELET = 24.0, 46.0, 9.5  # typical radii, pixels of the canvas
FOCUS = (0.6, 1.2, 2.2)  # pixels of blur that every sprite is drawn with
DIRT, CROWD = 16, 6  # specks at most; steps in which cells push one another apart
CLASSES = ("rbc", "wbc", "platelet")


def outline(rng: np.random.Generator, size: int, radius: float, wobble: float, x=0.0, y=0.0) -> np.ndarray:
    """How far each pixel lies inside a bumpy disc around (x, y) of the middle, pixels, ``(size, size)``."""
    axis = np.arange(size) + 0.5 - size / 2
    dx, dy = axis[None, :] - x, axis[:, None] - y
    angle, edge = np.arctan2(dy, dx), np.ones((size, size))
    for waves in range(2, 7):
        edge += wobble / waves * rng.normal() * np.cos(waves * angle + rng.uniform(0, 6.3))
    return radius * edge - np.hypot(dx, dy)


def grain(rng: np.random.Generator, size: int, wave: float) -> np.ndarray:
    """Smooth noise of standard deviation 1, ``(size, size, 1)``."""
    noise = cv2.GaussianBlur(rng.normal(size=(size, size)), (0, 0), wave)
    return (noise / noise.std())[..., None]


def sprites(colour: np.ndarray, alpha: np.ndarray) -> list[np.ndarray]:
    """One look at every focus, RGBA."""
    found = []
    for blur in FOCUS:
        whole = cv2.GaussianBlur(np.dstack([np.clip(colour, 0, 255) * alpha[..., None], 255 * alpha]), (0, 0), blur)
        whole[..., :3] *= 255 / np.maximum(whole[..., 3:], 1)
        found.append(np.rint(np.clip(whole, 0, 255)).astype(np.uint8))
    return found


def red(rng: np.random.Generator, pallor: float) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """A red cell of radius 24, paler in the middle, and what it takes of the light that comes through others."""
    inside = outline(rng, 64, RED, 0.1)
    middle = outline(rng, 64, rng.uniform(8, 16), 0.25, *rng.normal(0, 2.5, 2))
    pale = pallor * np.clip(middle / 5 + 0.5, 0, 1)[..., None]
    rim = np.exp(-((inside / 3) ** 2))[..., None]
    colour = (200, 178, 178) + pale * (12, 36, 36) - rim * (2, 8, -4) + 2 * grain(rng, 64, 4) + 2 * grain(rng, 64, 0.7)
    there = np.clip(inside + 0.5, 0, 1)
    shade = np.broadcast_to((134.0, 88.0, 92.0), colour.shape)
    return sprites(colour, there * (0.8 - 0.15 * pale[..., 0])), sprites(shade, there * 0.2 * (1 - 0.9 * pale[..., 0]))


def white(rng: np.random.Generator, form: str) -> list[np.ndarray]:
    """A white cell of radius 46: cytoplasm and a nucleus of lobes."""
    size, plain = 116, form == "lymphocyte"
    inside = outline(rng, size, 46, 0.12 if form == "monocyte" else 0.06)
    colour = np.array({"neutrophil": (202, 176, 210), "eosinophil": (198, 142, 174)}.get(form, (186, 180, 218)), float)
    colour = colour + grain(rng, size, 1.6) * {"eosinophil": (16, 26, 18), "neutrophil": (6, 10, 6)}.get(form, 4)
    lobes = {"neutrophil": rng.integers(3, 6), "eosinophil": 2}.get(form, 1)
    start, nucleus = rng.uniform(0, 6.3), np.full((size, size), -99.0)
    for lobe in range(lobes):
        turn, away = start + lobe * rng.uniform(1.1, 1.9), 0.0 if lobes == 1 else rng.uniform(16, 22)
        radius = {"neutrophil": rng.uniform(13, 19), "eosinophil": rng.uniform(18, 23)}.get(form, 41 if plain else 34)
        part = outline(rng, size, radius, 0.1 if plain else 0.22, away * np.cos(turn), away * np.sin(turn))
        nucleus = np.logaddexp(nucleus / 3, part / 3) * 3
    purple = np.array((148, 110, 226)) + rng.normal(0, 12, 3) + (9, 11, 6) * grain(rng, size, 3)
    cover = np.clip(nucleus / 3 + 0.5, 0, 1)[..., None]
    alpha = np.clip(inside / 2 + 0.5, 0, 1) * (0.75 + 0.22 * cover[..., 0])
    return sprites(colour * (1 - cover) + purple * cover, alpha)


def platelet(rng: np.random.Generator) -> list[np.ndarray]:
    """A small violet body of radius 9.5, grainy and ragged."""
    inside = outline(rng, 32, PLATELET, 0.2)
    core = np.clip(outline(rng, 32, 6, 0.25) / 4 + 0.5, 0, 1)[..., None]
    colour = (176, 168, 222) - core * (34, 48, 2) + 10 * grain(rng, 32, 1.5)
    return sprites(colour, np.clip(inside / 3 + 0.5, 0, 1) * 0.9)


def field(rng: np.random.Generator) -> np.ndarray:
    """The empty slide, lit unevenly."""
    slope = rng.normal(0, 3, 2)
    y, x = np.mgrid[-1 : 1 : HEIGHT * 1j, -1 : 1 : WIDTH * 1j]
    light = slope[0] * x + slope[1] * y - rng.uniform(0, 6) * (x**2 + y**2)
    rgb = (
        (222, 223, 218)
        + light[..., None] * (0.8, 1.0, 1.2)
        + cv2.GaussianBlur(rng.normal(0, 4, (HEIGHT, WIDTH, 3)), (0, 0), 0.7)
    )
    return np.dstack([np.clip(rgb, 0, 255), np.full((HEIGHT, WIDTH), 255)]).round().astype(np.uint8)


def speck(rng: np.random.Generator) -> list[np.ndarray]:
    """A bubble or dirt: a dark ring around a light spot, too faint to hide what it lies on."""
    ring = outline(rng, 20, rng.uniform(2, 5), 0.25)
    alpha = np.clip(ring / 2 + 1, 0, 1) * rng.uniform(0.25, 0.49)
    light = np.clip(ring - rng.uniform(0.5, 3), 0, 1)[..., None]
    return sprites(np.array((120, 96, 96)) * (1 - light) + 250.0 * light, alpha)


RNG = np.random.default_rng(0)
LOOKS = [red(RNG, pallor) for pallor in np.linspace(0, 1, 12)]
REDS, SHADES = (Atlas(tuple(sum((look[i] for look in LOOKS), []))) for i in (0, 1))
FORMS = ("neutrophil", "neutrophil", "eosinophil", "lymphocyte", "monocyte")
WHITES = Atlas(tuple(sum((white(RNG, form) for form in FORMS * 4), [])))
PLATELETS = Atlas(tuple(sum((platelet(RNG) for _ in range(8)), [])))
SPECKS = Atlas(tuple(sum((speck(RNG) for _ in range(6)), [])))
FIELDS = Atlas(tuple(field(RNG) for _ in range(8)))


def apart(x: Tensor, y: Tensor, radius: Tensor, there: Tensor, close: Tensor) -> tuple[Tensor, Tensor]:
    """Where cells come to lie that push one another away until ``close`` times their radii; those that stay pile up."""
    reach = close[..., None] * (radius[:, :, None] + radius[:, None, :])
    both = there[:, :, None] & there[:, None, :]
    mine = (radius[:, None, :] / (radius[:, :, None] + radius[:, None, :])) ** 2  # the larger one moves less
    for _ in range(CROWD):
        dx, dy = x[:, :, None] - x[:, None, :], y[:, :, None] - y[:, None, :]
        far = (dx**2 + dy**2).clamp(min=1e-3).sqrt()
        push = both * mine * (reach - far).clamp(min=0) / far
        x = (x + (push * dx).sum(2)).clamp(-8, WIDTH + 8)
        y = (y + (push * dy).sum(2)).clamp(-8, HEIGHT + 8)
    return x, y


@scene_model(GRAMMAR, PRIOR, canvas=(HEIGHT, WIDTH), max_steps=96, classes=CLASSES)
def blood_smear(scene: SceneGraph) -> Drawing:
    """Lengths in pixels; sites of the whole slide are ``(N, 1)``, of cells ``(N, M)``."""
    unit = dist.Uniform(0.0, 1.0)
    light, dye, hue, focus, close, pale, empty, dusty = (
        pyro.sample(f"slide.{name}", unit)
        for name in ("light", "dye", "hue", "focus", "close", "pale", "field", "dusty")
    )
    with scene.nodes(*CLASSES):
        x, y, turn, look, size, shape, tone = (
            pyro.sample(f"cell.{name}", unit) for name in ("x", "y", "turn", "look", "size", "shape", "tone")
        )
    with pyro.plate("dirt", DIRT, dim=-1):
        dirt = [pyro.sample(f"dirt.{name}", unit) for name in ("x", "y", "look", "there")]
    red, white = scene.mask("rbc"), scene.mask("wbc")
    scale = torch.where(red, 0.85 + 0.3 * size, torch.where(white, 0.6 + 0.75 * size, 0.7 + 0.7 * size))
    radius = scale * torch.where(red, RED, torch.where(white, WHITE, PLATELET))
    x, y = apart(WIDTH * x, HEIGHT * y, radius, scene.mask(*CLASSES), 0.5 + 0.5 * close)
    blur = (3 * (0.75 * focus + 0.25 * tone)).long().clamp(max=2)
    narrow = scale * (1 - torch.where(red, 0.4, 0.2) * shape**2)

    def drawn(kind: str, atlas: Atlas, which: Tensor, tint: Tensor, **more) -> Sprites:
        sprite = 3 * (which * len(atlas) / 3).long().clamp(max=len(atlas) // 3 - 1) + blur
        return Sprites(kind, atlas, sprite, x, y, 6.2832 * turn, scale, narrow, tint, **more)

    grey = 0.88 + 0.06 * light
    stain = torch.stack([1 - 0.06 * dye, 0.97 - 0.1 * dye, 1 - 0.06 * hue - 0.1 * dye], -1)
    stain = stain * (0.94 + 0.06 * tone[..., None])
    violet = torch.stack([0.82 + 0.18 * tone, 0.84 + 0.16 * hue + 0 * tone, 1 - 0.1 * dye + 0 * tone], -1)
    flat = (0.7 * pale + 0.8 * look - 0.2).clamp(0, 1)
    one = torch.ones(len(scene.kind), 1, dtype=torch.bool)
    slide = torch.stack([grey, grey, grey - 0.04 * (hue - 0.5)], -1)
    return scene.draw(
        Sprites((), FIELDS, (8 * empty).long().clamp(max=7), WIDTH / 2, HEIGHT / 2, tint=slide, present=one),
        drawn("rbc", REDS, flat, stain),
        drawn("rbc", SHADES, flat, torch.ones(3), labelled=False),
        drawn("wbc", WHITES, look, violet),
        drawn("platelet", PLATELETS, look, violet),
        Sprites(
            (), SPECKS, (18 * dirt[2]).long().clamp(max=17), WIDTH * dirt[0], HEIGHT * dirt[1], present=dirt[3] < dusty
        ),
    )
