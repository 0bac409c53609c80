"""Up to five digits from 0 to 4 on a canvas of 96 pixels: Multi-MNIST at the size of a demo, which learns in a minute.

The prior scatters and turns them; the target is one upright row, with a random distribution of numbers and of digits.
"""

import math

import numpy as np
import pyro
import pyro.distributions as dist
from torch import Tensor

from probscene.drawing import Drawing, Sprites
from probscene.grammar import Grammar
from probscene.model import SceneModel, scene_model
from probscene.scene import SceneGraph
from probscene.structure import StructurePrior, counts, weights

from .digits import SIZE, shipped

GRAMMAR = Grammar("""
    Scene  -> bg Digits
    Digits -> Digit Digits | ε
    Digit  -> 0 | 1 | 2 | 3 | 4
""")
CLASSES = tuple("01234")
MAX_DIGITS = 5
PRIOR = StructurePrior(GRAMMAR, Digits=counts(*[1] * (MAX_DIGITS + 1)))
CANVAS = 96
MAX_STEPS = 20
SCALE = 0.6  # of a glyph of 28 pixels, so that five stand in a row
TURN = math.radians(30)
MARGIN = math.ceil(SCALE * SIZE / 2 * (math.cos(TURN) + math.sin(TURN)))  # a turned glyph stays on the canvas


def draw(scene: SceneGraph, held_out: bool, x: Tensor, y: Tensor | int, angle: Tensor | float = 0.0) -> Drawing:
    """Each digit by a specimen of its own."""
    digits = shipped(held_out)
    with scene.nodes(*CLASSES):
        exemplar = pyro.sample("digit.exemplar", dist.Uniform(0.0, 1.0))
    digit = (scene.kind - GRAMMAR.kind("0")).clamp(min=0)
    return scene.draw(Sprites(CLASSES, digits.atlas, digits.sprite(digit, exemplar), x, y, angle, SCALE))


def target(seed: int) -> SceneModel:
    """What a demo learns: numbers and digits by Dirichlet(1) draws of ``seed``, in an evenly spaced row."""
    rng = np.random.default_rng(seed)
    number, share = rng.dirichlet(np.ones(MAX_DIGITS + 1)), rng.dirichlet(np.ones(len(CLASSES)))
    prior = StructurePrior(GRAMMAR, Digits=counts(*number), Digit=weights(*share))

    @scene_model(GRAMMAR, prior, canvas=(CANVAS, CANVAS), max_steps=MAX_STEPS, classes=CLASSES, channels=1)
    def small_digits_target(scene: SceneGraph) -> Drawing:
        x = CANVAS * (scene.rank(*CLASSES) + 1) / (scene.count(*CLASSES) + 1)
        return draw(scene, True, x, CANVAS // 2)

    return small_digits_target


@scene_model(
    GRAMMAR, PRIOR, canvas=(CANVAS, CANVAS), max_steps=MAX_STEPS, classes=CLASSES, name="small_digits", channels=1,
    target=target,
)  # fmt: skip
def MODEL(scene: SceneGraph) -> Drawing:
    """The prior: place and rotation are uniform."""
    with scene.nodes(*CLASSES):
        x = pyro.sample("digit.x", dist.Uniform(MARGIN, CANVAS - MARGIN))
        y = pyro.sample("digit.y", dist.Uniform(MARGIN, CANVAS - MARGIN))
        angle = pyro.sample("digit.angle", dist.Uniform(-TURN, TURN))
    return draw(scene, False, x, y, angle)
