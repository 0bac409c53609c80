"""A model with every sort of site: trays with balls in them on a floor, none of which can be seen but these two; and a
model of two scenarios, the other of which has balls by the same names elsewhere."""

import pyro
import pyro.distributions as dist
import pytest
import torch

from probscene.drawing import Sprites
from probscene.grammar import Grammar
from probscene.model import scene_model
from probscene.scenarios import join
from probscene.structure import StructurePrior, counts

TRAYS = Grammar("""
    Scene -> floor(Trays)
    Trays -> tray(Stack) Trays | ε
    Stack -> hidden(Balls)
    Balls -> Ball Balls | ε
    Ball  -> red | blue
""")
TRAYS_PRIOR = StructurePrior(TRAYS, Trays=counts(1, 2, 2), Balls=counts(1, 1, 1, 1))


class Capped(dist.Uniform):
    """A third of its values are the largest."""

    def rsample(self, sample_shape=()):
        return super().rsample(torch.Size(sample_shape)).mul(1.5).clamp(max=0.999)


@pytest.fixture(scope="session")
def trays():
    """The model; a ball's place depends on its tray's, and its shade on its size."""

    @scene_model(TRAYS, TRAYS_PRIOR, canvas=(64, 64), max_steps=40, classes=("tray", "red", "blue"))
    def trays(scene):
        bright = pyro.sample("scene.bright", dist.Uniform(0.4, 1.0))
        with scene.nodes("tray"):
            x = pyro.sample("tray.x", dist.Normal(32.0, 8.0))
            y = pyro.sample("tray.y", dist.Uniform(10.0, 54.0))
            pyro.sample("tray.wood", dist.Categorical(torch.ones(3)))
        with scene.nodes("red", "blue"):
            away = pyro.sample("ball.away", dist.Uniform(-8.0, 8.0))
            size = pyro.sample("ball.size", dist.Uniform(2.0, 4.0))
            shade = pyro.sample("ball.shade", dist.Uniform(0.3, 0.5 + size / 8))
            pyro.sample("ball.fixed", dist.Uniform(0.0, 1.0), infer={"learn": False})
            pyro.sample("ball.odd", dist.Beta(2.0, 2.0))
            pyro.sample("ball.capped", Capped(0.0, 1.0))
        with scene.nodes("floor"):
            pyro.sample("floor.turn", dist.Uniform(0.0, 1.0))
        with scene.nodes("hidden"):
            pyro.sample("hidden.depth", dist.Uniform(0.0, 1.0))
        with pyro.plate("decoration", scene.kind.shape[1], dim=-1):  # as wide as the nodes, by chance
            pyro.sample("decoration.x", dist.Uniform(0.0, 64.0))
        at = scene.of_parent(scene.of_parent(x)), scene.of_parent(scene.of_parent(y))
        tone = (shade * bright)[..., None] * torch.tensor([1.0, 0.4, 0.3])
        return scene.draw(
            Sprites.disc("tray", x, y, radius=9.0, tint=(0.2, 0.5, 0.2)),
            Sprites.disc(("red", "blue"), at[0] + away, at[1], radius=size, tint=tone),
            background=(0.05, 0.05, 0.05),
        )

    return trays


HALL = Grammar("""
    Scene -> wall wall wall floor lamp Balls
    Balls -> Ball Balls | ε
    Ball  -> red | blue
""")


@pytest.fixture(scope="session")
def rooms(trays):
    """Trays or a hall, whose shortest scene has more nodes than that of trays and whose longest has fewer."""

    prior = StructurePrior(HALL, Balls=counts(1, 1, 1))

    @scene_model(HALL, prior, canvas=(64, 64), max_steps=20, classes=("red", "blue"))
    def hall(scene):
        bright = pyro.sample("scene.bright", dist.Uniform(0.2, 0.6))
        with scene.nodes("red", "blue"):
            away = pyro.sample("ball.away", dist.Normal(0.0, 12.0))
            size = pyro.sample("ball.size", dist.Uniform(1.0, 5.0))
            shade = pyro.sample("ball.shade", dist.Uniform(0.3, 0.5 + size / 10))
            pyro.sample("ball.fixed", dist.Uniform(0.0, 1.0))
        with scene.nodes("floor"):
            pyro.sample("floor.turn", dist.Uniform(-1.0, 1.0))
        with scene.nodes("lamp"):
            pyro.sample("lamp.height", dist.Uniform(0.0, 1.0))
        tone = (shade * bright)[..., None] * torch.tensor([1.0, 0.4, 0.3])
        balls = Sprites.disc(("red", "blue"), 32 + away, 32.0, radius=size, tint=tone)
        return scene.draw(balls, background=(0.05, 0.05, 0.05))

    return join("rooms", {"trays": trays, "hall": hall}, [2.0, 1.0])


@pytest.fixture(scope="session", params=["trays", "rooms"])
def model(request):
    """A model of one grammar, and one of several scenarios."""
    return request.getfixturevalue(request.param)


DISCS = Grammar("Scene -> Discs\nDiscs -> disc Discs | ε")
DISCS_PRIOR = StructurePrior(DISCS, Discs=counts(0, 1, 1, 1))


@pytest.fixture(scope="session")
def smeared():
    """Discs in photos of other light, focus and grain."""

    @scene_model(DISCS, DISCS_PRIOR, canvas=(64, 64), max_steps=8, classes=("disc",))
    def smeared(scene):
        photo = scene.photo(exposure=(0.5, 1.5), blur=(0.0, 3.0), noise=(0.0, 12.0))
        with scene.nodes("disc"):
            x = pyro.sample("disc.x", dist.Uniform(8.0, 56.0))
        return scene.draw(Sprites.disc("disc", x, 32.0, radius=6.0), background=(0.3, 0.3, 0.3), photo=photo)

    return smeared
