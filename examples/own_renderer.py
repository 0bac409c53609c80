"""A renderer of one's own: buoys at night, whose lights add up where the built-in sprites would cover one another.

    probscene preview examples/own_renderer.py --out night.png --boxes
    probscene fit examples/own_renderer.py --target photos/ --out runs/night

The model says what is there, ``Sprites.disc`` where and how large; ``NightRenderer`` reads this drawing and makes of it
an image and its labels in plain numpy and OpenCV. Any renderer of yours, a game engine or a physical simulator, goes in
the same way. What it must return is said by ``Renderer`` in probscene.batch; the first batch is checked.
"""

from dataclasses import replace

import cv2
import numpy as np
import pyro
import pyro.distributions as dist
import torch

from probscene.batch import RenderBatch
from probscene.drawing import Drawing, Layer, Sprites
from probscene.grammar import Grammar
from probscene.model import SceneModel, scene_model
from probscene.scene import SceneGraph
from probscene.structure import StructurePrior, counts, weights

GRAMMAR = Grammar("""
    Scene -> Buoys
    Buoys -> Buoy Buoys | ε
    Buoy  -> red | green
""")
PRIOR = StructurePrior(GRAMMAR, Buoys=counts(1, 1, 1, 1, 1, 1))
CANVAS, HORIZON = 96, 30  # pixels
SKY, SEA = (16, 20, 40), (8, 18, 30)
SPREAD = 2.5  # how much farther than its disc a light's glow reaches


class NightRenderer:
    """Draws the discs of a drawing as lights over the sea.

    Args:
        canvas: height and width of the images, pixels.
        threads: not used; one scene is quick.
    """

    def __init__(self, canvas: tuple[int, int], threads: int | None = None):
        self.canvas = canvas
        height, width = canvas
        self.y, self.x = np.mgrid[:height, :width] + 0.5  # the middles of the pixels
        self.night = np.full((height, width, 3), SKY, np.uint8)
        cv2.rectangle(self.night, (0, HORIZON), (width, height), SEA, cv2.FILLED)

    def __call__(self, drawing: Drawing) -> RenderBatch:
        """Render every scene, one after the other."""
        each = [self._scene(drawing, scene) for scene in range(len(drawing))]
        image, instance, kind, box, amodal_box, pixels, visible = (
            torch.from_numpy(np.stack(field)) for field in zip(*each, strict=True)
        )
        return RenderBatch(image.permute(0, 3, 1, 2), instance, kind, box, amodal_box, pixels, visible)

    def _scene(self, drawing: Drawing, scene: int) -> tuple[np.ndarray, ...]:
        """Image ``(H, W, 3)`` and the labels of one scene, in the order of a ``RenderBatch``."""
        M = drawing.kind.shape[1]
        image, instance = self.night.astype(np.float32), np.zeros(self.canvas, np.int16)
        kind, whole = np.full(M, -1), np.zeros((M, *self.canvas), bool)
        for layer in drawing.layers:
            for node in layer.present[scene].nonzero().flatten().tolist():
                glow, disc = self._light(layer, scene, node)
                image += 255 * glow[..., None] * layer.tint[scene, node].numpy()
                if layer.labelled:
                    whole[node], kind[node] = disc, int(drawing.kind[scene, node])
                    instance[disc] = node + 1
        seen = instance == np.arange(1, M + 1)[:, None, None]  # (M, H, W)
        pixels, size = seen.sum((1, 2)), whole.sum((1, 2))
        visible = (pixels / np.maximum(size, 1)).astype(np.float32)
        colours = np.clip(np.rint(image), 0, 255).astype(np.uint8)
        return colours, instance, kind, boxes(seen), boxes(whole), pixels, visible

    def _light(self, layer: Layer, scene: int, node: int) -> tuple[np.ndarray, np.ndarray]:
        """How bright a light shines in each pixel, and which pixels are its disc; with its reflection in the water."""
        x, y, scale = (float(value[scene, node]) for value in (layer.x, layer.y, layer.scale_x))
        radius = scale * layer.atlas.sprites[0].shape[1] / 2
        away = ((self.x - x) ** 2 + (self.y - y) ** 2) / radius**2
        below = np.abs(self.x - x) / radius + np.maximum(self.y - y, 0) / (6 * radius)
        reflection = 0.35 * np.exp(-2 * below) * (self.y > y)
        return np.exp(-away / SPREAD) + reflection, away <= 1


def boxes(masks: np.ndarray) -> np.ndarray:
    """The extents ``(M, 4)`` float32 of masks ``(M, H, W)``: x0, y0, x1, y1, ends exclusive; zeros where one is empty.

    Discs lie inside the canvas here, so that the box of the whole disc is the amodal one.
    """
    found = [cv2.boundingRect(mask.astype(np.uint8)) for mask in masks]
    return np.array([(x, y, x + w, y + h) for x, y, w, h in found], np.float32).reshape(-1, 4)


def target(seed: int) -> SceneModel:
    """The experiment's truth: more buoys than in the prior, and most of them red."""
    prior = StructurePrior(GRAMMAR, Buoys=counts(0, 0, 1, 2, 4, 4), Buoy=weights(3, 1))
    return replace(night, name="night_target", prior=prior, target=None)


@scene_model(
    GRAMMAR,
    PRIOR,
    canvas=(CANVAS, CANVAS),
    max_steps=24,
    classes=("red", "green"),
    target=target,
    renderer=NightRenderer,
)
def night(scene: SceneGraph) -> Drawing:
    """Buoys on the sea, larger the nearer they are; every site is ``(N, M)``, pixels."""
    with scene.nodes("red", "green"):
        x = pyro.sample("buoy.x", dist.Uniform(8.0, CANVAS - 8.0))
        y = pyro.sample("buoy.y", dist.Uniform(HORIZON + 6.0, CANVAS - 8.0))
    radius = 2.0 + 4.0 * (y - HORIZON) / (CANVAS - HORIZON)
    return scene.draw(
        Sprites.disc("red", x, y, radius, tint=(1.0, 0.25, 0.15)),
        Sprites.disc("green", x, y, radius, tint=(0.2, 1.0, 0.45)),
    )
