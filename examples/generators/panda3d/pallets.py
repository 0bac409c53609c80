"""A generator of one's own: a warehouse floor that Panda3D draws, in a process of its own.

    pip install panda3d
    probscene check examples/generators/panda3d/pallets.py --render
    probscene preview examples/generators/panda3d/pallets.py --out pallets.png --boxes
    probscene fit examples/generators/panda3d/pallets.py --target photos/ --out runs/pallets

The grammar and the program say what stands where; ``draw.py`` says how it looks and which pixel shows what. Where
Panda3D is installed elsewhere, name that Python in place of ``sys.executable``.
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyro
import pyro.distributions as dist
import torch

from probscene.generator import Command
from probscene.grammar import Grammar
from probscene.model import Groups, SceneModel, scene_model
from probscene.request import Objects, Request
from probscene.scene import SceneGraph
from probscene.structure import StructurePrior, counts, ranked, weights

GRAMMAR = Grammar("""
    Scene   -> Pallets
    Pallets -> Pallet Pallets | ε
    Pallet  -> pallet(Goods)
    Goods   -> Good Goods | ε
    Good    -> crate | drum
""")
PRIOR = StructurePrior(GRAMMAR, Pallets=counts(1, 1, 1, 1), Goods=counts(1, 1, 1, 1, 1), Good=weights(1, 1))
PAINTS = torch.tensor([[0.20, 0.36, 0.62], [0.70, 0.22, 0.18], [0.25, 0.48, 0.30], [0.80, 0.66, 0.20]])
CARTON = torch.tensor([0.78, 0.62, 0.42])
APART, PALLET, HIGH = 2.3, 1.7, 0.18  # metres
DRAW = Command([sys.executable, str(Path(__file__).with_name("draw.py"))], version="1", memory=1000)


def target(seed: int) -> SceneModel:
    """The experiment's truth: a full first pallet and hardly anything on the others; how little is the seed's."""
    little = 0.1 + 0.3 * np.random.default_rng(seed).random()
    goods = ranked(counts(0, 0, 1, 3, 4), counts(1 - little, little))
    prior = StructurePrior(GRAMMAR, Pallets=counts(0, 1, 3, 2), Goods=goods, Good=weights(3, 1))
    return replace(pallets, name="pallets_target", prior=prior, target=None)


@scene_model(
    GRAMMAR,
    PRIOR,
    canvas=(128, 160),
    max_steps=40,
    classes=("pallet", "crate", "drum"),
    groups=Groups("pallet", along="x", max_groups=3),
    target=target,
    generator=DRAW,
)
def pallets(scene: SceneGraph) -> Request:
    """Metres and radians; every site of a node is ``(N, M)``."""
    N = len(scene.kind)
    light = pyro.sample("light", dist.Uniform(0.7, 1.2))
    sun = pyro.sample("sun", dist.Uniform(-1.0, 1.0))
    with scene.nodes("pallet"):
        aside = pyro.sample("pallet.aside", dist.Uniform(-0.2, 0.2))
        ahead = pyro.sample("pallet.ahead", dist.Uniform(-1.2, 1.2))
        turn = pyro.sample("pallet.turn", dist.Uniform(-0.3, 0.3))
    with scene.nodes("crate", "drum"):
        along = pyro.sample("good.along", dist.Uniform(-0.07, 0.07))
        across = pyro.sample("good.across", dist.Uniform(-0.07, 0.07))
        tall = pyro.sample("good.tall", dist.Uniform(0.5, 1.0))
    with scene.nodes("crate"):
        shade = pyro.sample("crate.shade", dist.Uniform(0.75, 1.1))
    with scene.nodes("drum"):
        paint = pyro.sample("drum.paint", dist.Categorical(torch.ones(len(PAINTS))))
    x = APART * (scene.rank("pallet") - 0.5 * (scene.count("pallet") - 1)) + aside
    place = scene.rank("crate", "drum")  # the quarters of a pallet, one after the other
    along, across = along + 0.4 * (2 * (place % 2) - 1), across + 0.4 * (2 * (place // 2) - 1)
    yaw = scene.of_parent(turn)
    good_x = scene.of_parent(x) + along * yaw.cos() - across * yaw.sin()
    good_y = scene.of_parent(ahead) + along * yaw.sin() + across * yaw.cos()
    crate = torch.stack([torch.full_like(tall, 0.7), torch.full_like(tall, 0.7), 0.8 * tall], -1)
    drum = torch.stack([torch.full_like(tall, 0.62), torch.full_like(tall, 0.62), tall], -1)
    carton = (shade[..., None] * CARTON).clamp(max=1)
    return scene.request(
        Objects("pallet", x=x, y=ahead, z=0.0, yaw=turn, size=torch.tensor([PALLET, PALLET, HIGH]).expand(N, 1, 3)),
        Objects("crate", x=good_x, y=good_y, z=HIGH, yaw=yaw, size=crate, colour=carton),
        Objects("drum", x=good_x, y=good_y, z=HIGH, yaw=yaw, size=drum, colour=PAINTS[paint]),
        scene={"light": light, "sun": sun},
    )
