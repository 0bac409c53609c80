"""A grammar small enough to enumerate, and a model small enough to render and train on in seconds."""

import pyro
import pyro.distributions as dist
import pytest
import torch

from probscene.derive import derive
from probscene.drawing import Sprites
from probscene.enumeration import enumerate_derivations
from probscene.grammar import Grammar
from probscene.inference.features.base import class_table, examples
from probscene.model import SceneModel
from probscene.renderers.sprites import SpriteRenderer
from probscene.sampling import sample
from probscene.scene import SceneGraph
from probscene.structure import StructurePrior, counts


@pytest.fixture(scope="session")
def small():
    """A grammar with 12 derivations, all of them, and a real distribution over them."""

    class Small:
        grammar = Grammar("Scene -> Left Right\nLeft -> a | b | c\nRight -> d Tail | e Tail\nTail -> f | ε")
        derivations = enumerate_derivations(grammar, 4)
        # One feature a kind, so that every derivation has features of its own.
        features = derivations.counts(len(grammar.kinds)).float()

        @staticmethod
        def observe(scenes):
            return scenes.derivation.counts(len(Small.grammar.kinds)).float()

        @staticmethod
        def cost(generated, real):
            """It depends on the scene alone, so that the expected gradient is a finite sum."""
            return (generated * torch.linspace(-1, 1.5, len(Small.grammar.kinds)) ** 3).sum(1) + 2.0

        @staticmethod
        def program(num_scenes, structure=None):
            with pyro.plate("scenes", num_scenes, dim=-2):
                policy = structure or StructurePrior(Small.grammar)
                return SceneGraph(Small.grammar, derive(Small.grammar, policy, num_scenes, 4)).draw()

    torch.manual_seed(3)
    Small.target = torch.distributions.Dirichlet(torch.ones(12)).sample()
    return Small


DOTS = Grammar("Scene -> Things\nThings -> Thing Things | ε\nThing -> red | blue")


def dots_program(num_scenes, structure):
    with pyro.plate("scenes", num_scenes, dim=-2):
        scene = SceneGraph(DOTS, derive(DOTS, structure, num_scenes, 12))
        with scene.nodes("red", "blue"):
            x = pyro.sample("thing.x", dist.Uniform(6.0, 58.0))
            y = pyro.sample("thing.y", dist.Uniform(6.0, 58.0))
    return scene.draw(
        Sprites.disc("red", x, y, radius=5.0, tint=(1.0, 0.1, 0.1)),
        Sprites.disc("blue", x, y, radius=5.0, tint=(0.1, 0.1, 1.0)),
    )


@pytest.fixture(scope="session")
def dots():
    """Up to four red and blue discs on 64 x 64 pixels."""
    prior = StructurePrior(DOTS, Things=counts(1, 1, 1, 1, 1))
    return SceneModel("dots", DOTS, prior, dots_program, (64, 64), 12, ("red", "blue"))


@pytest.fixture(scope="session")
def draw_dots(dots):
    """Labelled prior renders of ``dots``, by number."""
    render, classes = SpriteRenderer(dots.canvas, threads=1), class_table(dots.grammar.kinds, dots.classes)
    return lambda num: examples(render(sample(dots, dots.prior, num).drawing), classes)
