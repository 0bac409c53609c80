"""A generator of one's own: a laid table that Blender draws with Cycles, in an environment of its own.

    make blender                        # once: bpy, numpy and OpenEXR for Python 3.11 in .blender/, 1.1 GB
    probscene check examples/generators/blender/table.py --render
    probscene preview examples/generators/blender/table.py --out table.png --boxes
    probscene fit examples/generators/blender/table.py --features count=efficientnet --target photos/ --out runs/table

The grammar and the program say what stands where; ``draw.py`` says how it looks. ``BLENDER_PYTHON`` names another
environment that holds bpy. ``draw_other.py`` is a script with other materials and light, for the experiment's truth.
"""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyro
import pyro.distributions as dist

from probscene.generator import Command
from probscene.grammar import Grammar
from probscene.model import SceneModel, scene_model
from probscene.request import Objects, Request
from probscene.scene import SceneGraph
from probscene.structure import StructurePrior, counts

GRAMMAR = Grammar("""
    Scene   -> Places Bottles
    Places  -> Place Places | ε
    Place   -> plate(Drinks)
    Drinks  -> mug Drinks | ε
    Bottles -> bottle Bottles | ε
""")
PRIOR = StructurePrior(GRAMMAR, Places=counts(1, 1, 1, 1), Drinks=counts(1, 1), Bottles=counts(1, 1, 1, 1))
APART, SIDE, BACK = 0.36, 0.16, 0.22  # metres
HERE = Path(__file__).parent
PYTHON = os.environ.get("BLENDER_PYTHON", str(HERE.parents[2] / ".blender" / "bin" / "python"))
DRAW = Command([PYTHON, str(HERE / "draw.py")], version="1", memory=2000)


def target(seed: int) -> SceneModel:
    """The experiment's truth: hardly any table for one, a mug at most places, few bottles; drawn by another script."""
    few = 0.05 + 0.15 * np.random.default_rng(seed).random()
    prior = StructurePrior(
        GRAMMAR, Places=counts(few, few, 3, 2), Drinks=counts(few, 1), Bottles=counts(2, 3, few, few)
    )
    other = replace(DRAW, argv=(PYTHON, str(HERE / "draw_other.py")), files=(str(HERE / "draw.py"),))
    return replace(table, name="table_target", prior=prior, target=None, generator=other)


@scene_model(
    GRAMMAR,
    PRIOR,
    canvas=(128, 160),
    max_steps=30,
    classes=("plate", "mug", "bottle"),
    target=target,
    generator=DRAW,
)
def table(scene: SceneGraph) -> Request:
    """Metres and radians; every site of a node is ``(N, M)``."""
    light = pyro.sample("light", dist.Uniform(0.6, 1.2))
    sun = pyro.sample("sun", dist.Uniform(-2.5, 2.5))
    with scene.nodes("plate", "mug", "bottle"):
        aside = pyro.sample("aside", dist.Uniform(-0.04, 0.04))
        ahead = pyro.sample("ahead", dist.Uniform(-0.05, 0.05))
        shade = pyro.sample("shade", dist.Uniform(0.6, 1.15))
    with scene.nodes("plate", "bottle"):
        size = pyro.sample("size", dist.Uniform(0.20, 0.26))
    with scene.nodes("mug"):
        turn = pyro.sample("mug.turn", dist.Uniform(-3.0, 3.0))
    x = {kind: APART * (scene.rank(kind) - 0.5 * (scene.count(kind) - 1)) + aside for kind in ("plate", "bottle")}
    return scene.request(
        Objects("plate", x=x["plate"], y=ahead - 0.15, size=size, shade=shade),
        Objects("mug", x=scene.of_parent(x["plate"]) + SIDE + aside, y=ahead - 0.08, turn=turn, shade=shade),
        Objects("bottle", x=x["bottle"], y=BACK + ahead, size=size + 0.03, shade=shade),
        scene={"light": light, "sun": sun},
    )
