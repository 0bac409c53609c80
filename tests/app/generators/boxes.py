"""A model whose scenes a program in another process draws."""

import sys
from pathlib import Path

import pyro
import pyro.distributions as dist

from probscene.generator import Command
from probscene.grammar import Grammar
from probscene.model import scene_model
from probscene.request import Objects
from probscene.structure import StructurePrior, counts

GRAMMAR = Grammar("""
    Scene  -> Plates
    Plates -> Plate Plates | ε
    Plate  -> plate(Mugs)
    Mugs   -> mug Mugs | ε
""")
DRAW = Path(__file__).with_name("draw_boxes.py")


@scene_model(
    GRAMMAR,
    StructurePrior(GRAMMAR, Plates=counts(0, 1, 1, 1), Mugs=counts(1, 1, 1)),
    canvas=(32, 40),
    max_steps=40,
    classes=("plate", "mug"),
    generator=Command([sys.executable, str(DRAW)], timeout=120.0, start_timeout=120.0),
)
def boxes(scene):
    """Plates with mugs; pixels."""
    light = pyro.sample("light", dist.Uniform(0.2, 1.0))
    with scene.nodes("plate", "mug"):
        x = pyro.sample("x", dist.Uniform(-4.0, 44.0))
        y = pyro.sample("y", dist.Uniform(-4.0, 36.0))
    return scene.request(Objects(("plate", "mug"), x=x, y=y), scene={"light": light})
