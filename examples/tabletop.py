"""A new domain in one file: plates and mugs on a round table, seen from above.

    python examples/tabletop.py --num 8 --out grid.png            # labelled scenes of the prior
    probscene fit examples/tabletop.py --target photos/ --out runs/tabletop

A plate stands relative to the table, a mug relative to its plate. In the prior every plate has as many mugs as any
other; in ``target(seed)`` the first plate is set for company. No list of rule weights can say that.
"""

import argparse
import math
from dataclasses import replace

import cv2
import numpy as np
import pyro
import pyro.distributions as dist
import torch

from probscene.drawing import Atlas, Drawing, Sprites, disc
from probscene.grammar import Grammar
from probscene.model import SceneModel, scene_model
from probscene.renderers.sprites import SpriteRenderer
from probscene.sampling import sample, seed_everything
from probscene.scene import SceneGraph
from probscene.structure import StructurePrior, counts, ranked

GRAMMAR = Grammar("""
    Scene  -> table(Plates)
    Plates -> Plate Plates | ε
    Plate  -> plate(Mugs)
    Mugs   -> mug Mugs | ε
""")
PRIOR = StructurePrior(GRAMMAR, Plates=counts(1, 3, 3, 3), Mugs=counts(3, 3, 2, 1))
CANVAS, MIDDLE, TURN = 256, 128.0, 2 * math.pi
TABLE, PLATE, MUG = 122.0, 38.0, 11.0  # radii, pixels
FLOOR = (0.36, 0.43, 0.44)
GLAZES = torch.tensor([[1.0, 0.99, 0.95], [0.70, 0.84, 0.86], [0.98, 0.87, 0.66], [0.86, 0.90, 0.78]])
ENAMELS = torch.tensor([[0.85, 0.32, 0.24], [0.18, 0.36, 0.55], [0.93, 0.70, 0.25], [0.29, 0.47, 0.35]])


def wood() -> np.ndarray:
    """A round table of planks, 256x256."""
    rng = np.random.default_rng(0)
    row = np.arange(256)[:, None]
    grain = cv2.GaussianBlur(rng.normal(size=(256, 256)), (0, 0), sigmaX=24, sigmaY=0.8)
    shade = 1 + 0.05 * grain / grain.std() + rng.uniform(-0.06, 0.06, 8)[row // 32] - 0.25 * (row % 32 == 0)
    sprite = disc(256)
    sprite[..., :3] = np.clip(shade[..., None] * (186, 138, 92), 0, 255)
    return sprite


def rings(size: int, *rings: tuple[float, int]) -> np.ndarray:
    """Discs of grey on one another, each with its radius, ``(size, size, 4)``; the radius 1 touches the border."""
    sprite = disc(size)
    for radius, grey in rings:
        inner = disc(round(size * radius / 2) * 2)
        edge = (size - len(inner)) // 2
        part = sprite[edge : size - edge, edge : size - edge, :3]
        part[:] = part + (grey - part.astype(float)) * (inner[..., 3:] / 255)
    return sprite


def mug() -> np.ndarray:
    """A mug of coffee, 64 pixels across, its handle to the right, ``(96, 96, 4)``."""
    sprite = np.full((96, 96, 4), (225, 225, 225, 0), np.uint8)
    cv2.ellipse(sprite, (78, 48), (14, 10), 0, 0, 360, (225, 225, 225, 255), 6, cv2.LINE_AA)
    cup, middle = rings(64, (1, 255), (0.72, 90), (0.64, 60)), sprite[16:80, 16:80]
    np.copyto(middle, cup, where=cup[..., 3:] > middle[..., 3:])
    return sprite


DISH = rings(128, (1, 225), (0.94, 255), (0.68, 210), (0.64, 242))
WOOD, DISHES, MUGS = Atlas((wood(),)), Atlas((DISH,)), Atlas((mug(),))


def target(seed: int) -> SceneModel:
    """The experiment's truth: two or three mugs on the first plate, hardly any on the others; how few is the seed's."""
    few = 0.05 + 0.25 * np.random.default_rng(seed).random()
    prior = StructurePrior(GRAMMAR, Plates=counts(0, 2, 5, 3), Mugs=ranked(counts(0, 1, 4, 5), counts(1 - few, few)))
    return replace(tabletop, name="tabletop_target", prior=prior, target=None)


@scene_model(GRAMMAR, PRIOR, canvas=(CANVAS, CANVAS), max_steps=40, classes=("plate", "mug"), target=target)
def tabletop(scene: SceneGraph) -> Drawing:
    """Angles in radians, lengths in pixels; every site is ``(N, M)``."""
    with scene.nodes("table"):
        table_turn = pyro.sample("table.turn", dist.Uniform(0.0, TURN))
    with scene.nodes("plate"):
        place = pyro.sample("plate.place", dist.Uniform(-0.2, 0.2))
        away = pyro.sample("plate.away", dist.Uniform(58.0, 80.0))
        glaze = pyro.sample("plate.glaze", dist.Categorical(torch.ones(len(GLAZES))))
    with scene.nodes("mug"):
        spot = pyro.sample("mug.spot", dist.Uniform(-0.2, 0.2))
        handle = pyro.sample("mug.handle", dist.Uniform(0.0, TURN))
        enamel = pyro.sample("mug.enamel", dist.Categorical(torch.ones(len(ENAMELS))))
    # Siblings share out the circle around their parent's middle, so that none stands on another.
    plate_angle = scene.of_parent(table_turn) + TURN * scene.rank("plate") / scene.count("plate").clamp(min=1) + place
    plate_x, plate_y = MIDDLE + away * plate_angle.cos(), MIDDLE - away * plate_angle.sin()
    mug_angle = scene.of_parent(plate_angle) + TURN * scene.rank("mug") / scene.count("mug").clamp(min=1) + spot
    mug_x = scene.of_parent(plate_x) + PLATE / 2 * mug_angle.cos()
    mug_y = scene.of_parent(plate_y) - PLATE / 2 * mug_angle.sin()
    return scene.draw(
        Sprites("table", WOOD, 0, MIDDLE, MIDDLE, table_turn, TABLE / 128, labelled=False),
        Sprites.disc("plate", plate_x + 2, plate_y + 3, PLATE + 1, tint=(0.42, 0.30, 0.20), labelled=False),  # shadow
        Sprites("plate", DISHES, 0, plate_x, plate_y, scale=PLATE / 64, tint=GLAZES[glaze]),
        Sprites("mug", MUGS, 0, mug_x, mug_y, handle, MUG / 32, tint=ENAMELS[enamel]),
        background=FLOOR,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description="Draw labelled scenes of the prior.")
    parser.add_argument("--num", type=int, default=8, help="how many scenes")
    parser.add_argument("--out", default="tabletop.png", help="where to write the picture")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    if options.num < 1:
        parser.error(f"expected --num of at least 1, got {options.num}")
    seed_everything(options.seed)
    batch = SpriteRenderer(tabletop.canvas)(sample(tabletop, PRIOR, options.num).drawing)
    pictures = batch.image.permute(0, 2, 3, 1).numpy().copy()
    for picture, kinds, boxes in zip(pictures, batch.kind.tolist(), batch.box.int().tolist(), strict=True):
        for kind, (x0, y0, x1, y1) in zip(kinds, boxes, strict=True):
            if x1 > x0:
                name, ink = GRAMMAR.kinds[kind], (255, 255, 255) if kind == GRAMMAR.kind("plate") else (60, 20, 60)
                cv2.rectangle(picture, (x0, y0), (x1 - 1, y1 - 1), ink, 1)
                cv2.putText(picture, name, (x0 + 1, y0 - 2), 0, 0.35, ink, 1, cv2.LINE_AA)
    blank = np.zeros((-len(pictures) % 4, CANVAS, CANVAS, 3), np.uint8)
    rows = np.concatenate([pictures, blank]).reshape(-1, 4, CANVAS, CANVAS, 3)
    if not cv2.imwrite(options.out, rows.transpose(0, 2, 1, 3, 4).reshape(-1, 4 * CANVAS, 3)[..., ::-1]):
        parser.error(f"expected --out in a folder that can be written, got {options.out}")


if __name__ == "__main__":
    main()
