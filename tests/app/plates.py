"""A small model for tests: colour, turned and hidden shapes, a cover without a label, one light a scene."""

import pyro
import pyro.distributions as dist
import torch

from probscene.derive import derive
from probscene.drawing import Sprites
from probscene.grammar import Grammar
from probscene.model import SceneModel
from probscene.scene import SceneGraph
from probscene.structure import StructurePrior, counts, weights

GRAMMAR = Grammar("""
    Scene  -> Plates Veils
    Plates -> Plate Plates | ε
    Plate  -> plate(Mugs)
    Mugs   -> mug Mugs | ε
    Veils  -> veil | ε
""")
PRIOR = StructurePrior(GRAMMAR, Plates=counts(0.2, 0.4, 0.4), Mugs=counts(0.3, 0.4, 0.3), Veils=weights(1, 2))


def program(num_scenes, structure=PRIOR):
    with pyro.plate("scenes", num_scenes, dim=-2):
        scene = SceneGraph(GRAMMAR, derive(GRAMMAR, structure, num_scenes, max_steps=40))
        light = pyro.sample("light", dist.Uniform(0.5, 1.0))
        with scene.nodes("plate"):
            x = pyro.sample("plate.x", dist.Uniform(0.0, 64.0))
            y = pyro.sample("plate.y", dist.Uniform(0.0, 64.0))
            tint = pyro.sample("plate.tint", dist.Dirichlet(torch.ones(3)))
        with scene.nodes("mug"):
            angle = pyro.sample("mug.angle", dist.VonMises(0.0, 0.5))
            far = pyro.sample("mug.far", dist.LogNormal(2.0, 0.3))
            big = pyro.sample("mug.big", dist.Categorical(torch.tensor([0.5, 0.5])))
    mug_x = scene.of_parent(x) + far * torch.cos(angle)
    mug_y = scene.of_parent(y) + far * torch.sin(angle)
    return scene.draw(
        Sprites.disc("plate", x, y, radius=12.0, tint=tint * light.unsqueeze(-1)),
        Sprites.box("mug", mug_x, mug_y, 5.0 + 3 * big, 8.0, angle, tint=(0.9, 0.8, 0.2)),
        Sprites.box("veil", 32.0, 60.0, 70.0, 12.0, tint=(0.2, 0.2, 0.3), labelled=False),
        background=(0.1, 0.2, 0.1),
    )


MODEL = SceneModel("plates", GRAMMAR, PRIOR, program, (64, 64), 40, ("mug", "plate"))
