"""The smallest model that can be fitted and judged: up to three discs, red or blue; its target has more, and redder."""

import pyro
import pyro.distributions as dist

from probscene.derive import derive
from probscene.drawing import Sprites
from probscene.grammar import Grammar
from probscene.model import SceneModel
from probscene.scene import SceneGraph
from probscene.structure import StructurePrior, counts, weights

GRAMMAR = Grammar("""
    Scene -> Discs
    Discs -> Disc Discs | ε
    Disc  -> red | blue
""")


def program(num_scenes, structure):
    with pyro.plate("scenes", num_scenes, dim=-2):
        scene = SceneGraph(GRAMMAR, derive(GRAMMAR, structure, num_scenes, max_steps=12))
        with scene.nodes("red", "blue"):
            x = pyro.sample("x", dist.Uniform(8.0, 56.0))
            y = pyro.sample("y", dist.Uniform(8.0, 56.0))
    return scene.draw(
        Sprites.disc("red", x, y, radius=6.0, tint=(1.0, 0.2, 0.2)),
        Sprites.disc("blue", x, y, radius=6.0, tint=(0.2, 0.2, 1.0)),
    )


def model(discs, disc, **more):
    prior = StructurePrior(GRAMMAR, Discs=counts(*discs), Disc=weights(*disc))
    return SceneModel("discs", GRAMMAR, prior, program, (64, 64), 12, ("red", "blue"), **more)


def target(seed):
    return model((0.1, 0.1, 0.2, 0.6), (4, 1))


MODEL = model((1, 1, 1, 1), (1, 1), target=target)
