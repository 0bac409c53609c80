"""Multi-MNIST (Meta-Sim2, section 4.1): up to ten digits on a black canvas, 28x28 pixels each.

The prior scatters and turns them; the target is one upright row in the middle with a random distribution of counts and
of digits. Where the paper is silent: rotation within 30 degrees, the row's spacing, exemplars the target shares with
no prior scene.

``--assets DIR``, or the environment variable ``PROBSCENE_MNIST``, draws with the original IDX files in a folder.
"""

import math
from functools import partial

import numpy as np
import pyro
import pyro.distributions as dist
from torch import Tensor

from probscene.derive import derive
from probscene.drawing import Drawing, Sprites
from probscene.grammar import Grammar
from probscene.model import SceneModel
from probscene.policy import Policy
from probscene.scene import SceneGraph
from probscene.structure import StructurePrior, counts, weights

from .digits import SIZE, Digits, Source, idx, shipped

GRAMMAR = Grammar("""
    Scene  -> bg Digits
    Digits -> Digit Digits | ε
    Digit  -> 0 | 1 | 2 | 3 | 4 | 5 | 6 | 7 | 8 | 9
""")
CLASSES = tuple("0123456789")
MAX_DIGITS = 10
PRIOR = StructurePrior(GRAMMAR, Digits=counts(*[1] * (MAX_DIGITS + 1)))
CANVAS = 256
MAX_STEPS = 32  # up to 15 digits, more than the longest of the prior
TURN = math.radians(30)
MARGIN = math.ceil(SIZE / 2 * (math.cos(TURN) + math.sin(TURN)))  # a turned glyph stays on the canvas


def scattered(num_scenes: int, structure: Policy, digits: Source) -> Drawing:
    """The prior's program: place and rotation are uniform."""
    with pyro.plate("scenes", num_scenes, dim=-2):
        scene = SceneGraph(GRAMMAR, derive(GRAMMAR, structure, num_scenes, MAX_STEPS))
        with scene.nodes(*CLASSES):
            x = pyro.sample("digit.x", dist.Uniform(MARGIN, CANVAS - MARGIN))  # (N, M) pixels
            y = pyro.sample("digit.y", dist.Uniform(MARGIN, CANVAS - MARGIN))
            angle = pyro.sample("digit.angle", dist.Uniform(-TURN, TURN))
            exemplar = pyro.sample("digit.exemplar", dist.Uniform(0.0, 1.0))
    return draw(scene, digits(False), exemplar, x, y, angle)


def row(num_scenes: int, structure: Policy, digits: Source) -> Drawing:
    """The target's program: upright, in the middle, evenly spaced."""
    with pyro.plate("scenes", num_scenes, dim=-2):
        scene = SceneGraph(GRAMMAR, derive(GRAMMAR, structure, num_scenes, MAX_STEPS))
        with scene.nodes(*CLASSES):
            exemplar = pyro.sample("digit.exemplar", dist.Uniform(0.0, 1.0))
    rank, count = scene.rank(*CLASSES), scene.count(*CLASSES)
    spacing = CANVAS // (count + 1)
    spacing = spacing - spacing * (count - 1) % 2  # so that the row is centred and every glyph on whole pixels
    x = CANVAS // 2 + (2 * rank - count + 1) * spacing // 2
    return draw(scene, digits(True), exemplar, x, CANVAS // 2)


def draw(scene: SceneGraph, digits: Digits, exemplar, x, y, angle: Tensor | float = 0.0) -> Drawing:
    """Each digit's own glyph."""
    digit = (scene.kind - GRAMMAR.kind("0")).clamp(min=0)
    return scene.draw(Sprites(CLASSES, digits.atlas, digits.sprite(digit, exemplar), x, y, angle))


def target(seed: int, digits: Source = shipped, assets: str = "") -> SceneModel:
    """The experiment's truth: counts in 0..10 and digits from distributions that are Dirichlet(1) draws of ``seed``."""
    rng = np.random.default_rng(seed)
    number, share = rng.dirichlet(np.ones(MAX_DIGITS + 1)), rng.dirichlet(np.ones(len(CLASSES)))
    prior = StructurePrior(GRAMMAR, Digits=counts(*number), Digit=weights(*share))
    program = partial(row, digits=digits)
    more = {"channels": 1, "assets": assets}
    return SceneModel("multi_mnist_target", GRAMMAR, prior, program, (CANVAS, CANVAS), MAX_STEPS, CLASSES, **more)


def with_assets(folder: str) -> SceneModel:
    """The model with the digits of the original IDX files in a folder."""
    for held_out in (False, True):
        idx(folder, held_out)  # which finds what is wrong with it
    return multi_mnist(partial(idx, folder), f"IDX digits in {folder}")


def multi_mnist(digits: Source = shipped, assets: str = "") -> SceneModel:
    """The model with digits of any source, see ``probscene.models.digits``; ``assets`` names it in words."""
    return SceneModel(
        name="multi_mnist",
        grammar=GRAMMAR,
        prior=PRIOR,
        program=partial(scattered, digits=digits),
        canvas=(CANVAS, CANVAS),
        max_steps=MAX_STEPS,
        classes=CLASSES,
        channels=1,
        assets=assets,
        with_assets=with_assets,
        target=partial(target, digits=digits, assets=assets),
        assets_variable="PROBSCENE_MNIST",
    )


MODEL = multi_mnist(assets="digits of the install")
