"""A model file with two scenarios: a row of discs on a blue ground, and boxes with discs beside them."""

from dataclasses import replace

import pyro
import pyro.distributions as dist
import torch

from probscene.derive import derive
from probscene.drawing import Sprites
from probscene.grammar import Grammar
from probscene.model import SceneModel
from probscene.scene import SceneGraph
from probscene.structure import StructurePrior, counts

ROW = Grammar("Scene -> Discs\nDiscs -> disc Discs | ε")
YARD = Grammar("Scene -> Boxes Discs\nBoxes -> box Boxes | ε\nDiscs -> disc Discs | ε")


def program(grammar, ground):
    def scenes(num_scenes, structure):
        with pyro.plate("scenes", num_scenes, dim=-2):
            scene = SceneGraph(grammar, derive(grammar, structure, num_scenes, 12))
            with scene.nodes(*grammar.kinds):
                x = pyro.sample("x", dist.Uniform(6.0, 58.0))
                y = pyro.sample("y", dist.Uniform(6.0, 58.0))
        everywhere = replace(
            Sprites.box((), torch.full((1, 1), 32.0), 32.0, 64.0, 64.0, tint=ground),
            present=torch.ones(num_scenes, 1, dtype=torch.bool),
        )
        boxes = [Sprites.box("box", x, y, 10.0, 10.0, tint=(0.8, 0.3, 0.1))] if "box" in grammar.kinds else []
        return scene.draw(everywhere, *boxes, Sprites.disc("disc", x, y, radius=5.0, tint=(0.9, 0.9, 0.2)))

    return scenes


def row(prior):
    return SceneModel("row", ROW, prior, program(ROW, (0.1, 0.1, 0.4)), (64, 64), 12, ("disc",))


def yard(prior):
    return SceneModel("yard", YARD, prior, program(YARD, (0.3, 0.3, 0.3)), (64, 64), 12, ("disc", "box"))


SCENARIOS = {
    "row": row(StructurePrior(ROW, Discs=counts(1, 1, 1))),
    "yard": yard(StructurePrior(YARD, Boxes=counts(1, 1, 1), Discs=counts(1, 1))),
}
