"""A small model for labels: turned cars with keypoints on lots, under trees and a veil, some off the canvas."""

import numpy as np
import pyro
import pyro.distributions as dist

from probscene.derive import derive
from probscene.drawing import Atlas, Sprites
from probscene.grammar import Grammar
from probscene.model import SceneModel
from probscene.scene import SceneGraph
from probscene.structure import StructurePrior, counts, weights

GRAMMAR = Grammar("""
    Scene -> Lots Trees Veils
    Lots  -> Lot Lots | ε
    Lot   -> lot(Cars)
    Cars  -> car Cars | ε
    Trees -> tree Trees | ε
    Veils -> veil | ε
""")
PRIOR = StructurePrior(
    GRAMMAR, Lots=counts(0.2, 0.8), Cars=counts(0.1, 0.2, 0.3, 0.4), Trees=counts(0.2, 0.4, 0.4), Veils=weights(1, 3)
)
CAR = np.full((12, 24, 4), (200, 60, 40, 255), np.uint8)
CAR[:2, :2] = CAR[-2:, :2] = 0  # rounded off behind
KEYPOINTS = {"nose": (22.5 / 24, 0.5), "left": (0.4, 1.5 / 12), "beyond": (1.5, 0.5)}


def program(num_scenes, structure=PRIOR):
    with pyro.plate("scenes", num_scenes, dim=-2):
        scene = SceneGraph(GRAMMAR, derive(GRAMMAR, structure, num_scenes, max_steps=24))
        light = pyro.sample("light", dist.Uniform(0.5, 1.0))
        with scene.nodes("lot", "tree"):
            x = pyro.sample("x", dist.Uniform(0.0, 96.0))
            y = pyro.sample("y", dist.Uniform(0.0, 72.0))
        with scene.nodes("car"):
            turn = pyro.sample("car.turn", dist.VonMises(0.0, 0.1))
            far = pyro.sample("car.far", dist.Normal(0.0, 14.0).expand([2]).to_event(1))
            scale = pyro.sample("car.scale", dist.Uniform(0.6, 1.6))
            car_x = pyro.deterministic("car.x", scene.of_parent(x) + far[..., 0])
        car_y = scene.of_parent(y) + far[..., 1]
    return scene.draw(
        Sprites.box("lot", x, y, 60.0, 40.0, tint=light.unsqueeze(-1).expand(-1, -1, 3) * 0.5),
        Sprites("car", Atlas((CAR,)), 0, car_x, car_y, turn, scale, keypoints=KEYPOINTS),
        Sprites.disc("tree", x, y, radius=10.0, tint=(0.1, 0.6, 0.1)),
        Sprites.box("veil", 48.0, 70.0, 60.0, 12.0, tint=(0.2, 0.2, 0.3), labelled=False),
        background=(0.6, 0.6, 0.5),
    )


MODEL = SceneModel("cars", GRAMMAR, PRIOR, program, (72, 96), 24, ("car", "tree"), stuff=("tree",))
