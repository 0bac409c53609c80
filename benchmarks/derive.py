"""Prior derivations a second, in batches of 500 on one thread, beside Scenic and plain Python.

Scenic (BSD licence; version 3.1) is no dependency of ours. Give it an environment of its own and name its interpreter:

    python3.11 -m venv /tmp/scenic && /tmp/scenic/bin/pip install 'scenic==3.1.*'
    python benchmarks/derive.py --scenic-python /tmp/scenic/bin/python

The scenes are the same for all. Multi-MNIST: n uniform in 0..10 objects, each of one of ten classes, with uniform x and
y. Aerial 2D: one to four roads, each a random distance below the one before, on each 0 to 8 cars at a uniform place on
it and a uniform angle. A Scenic program has no random number of objects, so it gets one program for each number of
digits, and for 48 structures of Aerial's prior, compiled before the clock runs. By default Scenic keeps objects from
overlapping, by drawing the scene again, which ours does not here; both ways are measured. Aerial's own program, which
keeps the cars of a road apart and places trees and houses, is a row of its own.
The unit is CPU seconds of one process, which other processes hardly disturb.
"""

import argparse
import bisect
import json
import os
import random
import subprocess
import sys
import time

import pyro
import pyro.distributions as dist
import torch

from probscene.derive import derive
from probscene.grammar import Grammar
from probscene.models import aerial2d, multi_mnist
from probscene.scene import SceneGraph
from probscene.structure import StructurePrior
from probscene.threads import use_threads

BATCH = 500
LOW, HIGH = 20.0, 236.0  # pixels

DIGITS = """
class Digit:
    label: DiscreteRange(0, 9)
    width: 28
    length: 28
    allowCollisions: {overlap}
    requireVisible: False

ego = new Object at (-1000, -1000), with requireVisible False
for i in range(globalParameters.structure):
    new Digit at (Range(20, 236), Range(20, 236))
"""

ROADS = """
class Road:
    width: 256
    length: 48
    allowCollisions: True
    requireVisible: False

class Car:
    width: 9
    length: 18
    allowCollisions: {overlap}
    requireVisible: False

ego = new Object at (-1000, -1000), with requireVisible False
y = 0
for cars in globalParameters.structure:
    y = y + 48 + Range(0, 16)
    new Road at (128, y)
    for i in range(cars):
        new Car at (Range(10, 246), y + Range(-12, 12)), facing Range(0, 360) deg
"""

SCENIC = """
import json, random, sys, time
import numpy, scenic

program, structures, seconds = json.loads(sys.argv[1])
scenarios = [scenic.scenarioFromString(program, params={"structure": s}, mode2D=True) for s in structures]
random.seed(0), numpy.random.seed(0)
start, scenes, objects = time.process_time(), 0, 0
while (passed := time.process_time() - start) < seconds:
    scene, _ = scenarios[random.randrange(len(scenarios))].generate(maxIterations=10**6)
    scenes, objects = scenes + 1, objects + len(scene.objects) - 1
print(json.dumps([scenes / passed, objects / scenes]))
"""


def derived(model) -> int:
    """A batch of structures; the number of objects in it."""
    with pyro.plate("scenes", BATCH, dim=-2):
        derivation = derive(model.GRAMMAR, model.PRIOR, BATCH, model.MAX_STEPS)
    return labelled(derivation, model)


def digits_placed() -> int:
    """A batch of structures with a place for each digit."""
    with pyro.plate("scenes", BATCH, dim=-2):
        scene = SceneGraph(
            multi_mnist.GRAMMAR, derive(multi_mnist.GRAMMAR, multi_mnist.PRIOR, BATCH, multi_mnist.MAX_STEPS)
        )
        with scene.nodes(*multi_mnist.CLASSES):
            pyro.sample("x", dist.Uniform(LOW, HIGH))
            pyro.sample("y", dist.Uniform(LOW, HIGH))
    return labelled(scene, multi_mnist)


def cars_placed() -> int:
    """A batch of structures with a place for each road and, relative to it, for each car."""
    grammar = aerial2d.GRAMMAR
    with pyro.plate("scenes", BATCH, dim=-2):
        scene = SceneGraph(grammar, derive(grammar, aerial2d.PRIOR, BATCH, aerial2d.MAX_STEPS))
        with scene.nodes("road"):
            further = pyro.sample("further", dist.Uniform(48.0, 64.0))
        with scene.nodes("car"):
            pyro.sample("x", dist.Uniform(10.0, 246.0))
            prefixed = pyro.sample("beside", dist.Uniform(-12.0, 12.0))
            pyro.sample("angle", dist.Uniform(0.0, 6.2832))
        _ = scene.of_parent((further * scene.mask("road")).cumsum(1)) + prefixed
    return labelled(scene, aerial2d)


def aerial() -> int:
    """Aerial's own program, up to what there is to draw."""
    drawing = aerial2d.MODEL(BATCH)
    return labelled(drawing, aerial2d)


def labelled(scenes, model) -> int:
    """How many objects there are of classes that are labelled."""
    kinds = torch.tensor([model.GRAMMAR.kind(name) for name in model.CLASSES])
    return int(torch.isin(scenes.kind, kinds).sum())


class Plain:
    """The same prior by recursive descent in plain Python: one scene after the other, as lists.

    It shows what the tensors cost: here are no tensors to draw from, no Pyro sites, no log-probabilities, no policy
    that is a network.
    """

    def __init__(self, grammar: Grammar, prior: StructurePrior, place):
        self.place = place  # (kind, the parent's place) -> a place
        self.table = prior.table[:, 0].double().exp().cumsum(-1).tolist()  # (V + 1, C, K), as no list is ranked here
        self.rules = [[self.read(grammar, symbol) for symbol in rule.rhs] for rule in grammar.rules]

    def read(self, grammar: Grammar, symbol) -> tuple:
        """A symbol as (name, nonterminal or -1, what hangs below it)."""
        if isinstance(symbol, str):
            return symbol, grammar.nonterminals.index(symbol) if symbol in grammar.nonterminals else -1, ()
        return symbol.name, -1, [self.read(grammar, child) for child in symbol.children]

    def __call__(self) -> int:
        """A batch; each scene is a list of nodes (kind, parent, place)."""
        objects = 0
        for _ in range(BATCH):
            nodes = []
            self.expand(0, 0, nodes, -1)
            objects += sum(name != "bg" for name, *_ in nodes)
        return objects

    def expand(self, symbol: int, repeat: int, nodes: list[tuple], owner: int) -> None:
        """Choose a rule, append its objects and expand its nonterminals."""
        below = self.table[symbol][repeat]
        self.grow(self.rules[bisect.bisect(below, random.random() * below[-1])], symbol, repeat, nodes, owner)

    def grow(self, symbols: list[tuple], symbol: int, repeat: int, nodes: list[tuple], owner: int) -> None:
        """Append symbols below an owner."""
        for name, child, inner in symbols:
            if child >= 0:
                self.expand(child, repeat + 1 if child == symbol else 0, nodes, owner)
                continue
            nodes.append((name, owner, self.place(name, nodes[owner][2] if owner >= 0 else None)))
            if inner:
                self.grow(inner, -1, 0, nodes, len(nodes) - 1)


def digit_place(name, parent) -> tuple[float, float]:
    """Uniform."""
    return random.uniform(LOW, HIGH), random.uniform(LOW, HIGH)


def road_place(name, parent) -> tuple[float, ...]:
    """A road's distance from the one before; a car's place relative to its road, and its angle."""
    if name == "road":
        return (random.uniform(48.0, 64.0),)
    return random.uniform(10.0, 246.0), parent[0] + random.uniform(-12.0, 12.0), random.uniform(0.0, 6.2832)


def rate(batch, seconds: float) -> tuple[float, float]:
    """Scenes a CPU second, and objects a scene."""
    batch()  # warm
    start, scenes, objects = time.process_time(), 0, 0
    while (passed := time.process_time() - start) < seconds:
        objects += batch()
        scenes += BATCH
    return scenes / passed, objects / scenes


def scenic(python: str, program: str, structures: list, overlap: bool, seconds: float) -> tuple[float, float]:
    """The same of Scenic, in a process of its own."""
    given = json.dumps([program.format(overlap=overlap), structures, seconds])
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    run = subprocess.run([python, "-c", SCENIC, given], capture_output=True, text=True, env=environment)
    if run.returncode:
        sys.exit(f"Scenic did not run under {python}:\n{run.stderr}")
    return tuple(json.loads(run.stdout.splitlines()[-1]))


def table(title: str, ours: dict, program: str, structures: list, python: str | None, seconds: float) -> None:
    """Measure and print; ``ours``: the second row is what all are compared with."""
    rows = {name: rate(batch, seconds) for name, batch in ours.items()}
    if python:
        for name, overlap in (("Scenic, its default: no overlap", False), ("Scenic, overlap allowed", True)):
            rows[name] = scenic(python, program, structures, overlap, seconds)
    compared = list(rows.values())[1][0]
    print(f"{title:36} {'scenes/s':>10} {'objects':>8} {'ours is':>9}")
    for name, (scenes, objects) in rows.items():
        print(
            f"{name:36} {scenes:10,.{0 if scenes >= 10 else 1}f} {objects:8.2f} {compared / scenes:8.1f}x", flush=True
        )
    print()


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenic-python", metavar="PATH", help="an interpreter that has Scenic 3.1")
    parser.add_argument("--seconds", type=float, default=5.0, help="CPU seconds for each row")
    given = parser.parse_args()
    use_threads(1)
    pyro.set_rng_seed(0)
    drawn = random.Random(0)
    roads = [[drawn.randrange(9) for _ in range(1 + i % 4)] for i in range(48)]
    digits = {
        "probscene, structures only": lambda: derived(multi_mnist),
        "probscene, with places": digits_placed,
        "plain Python lists, with places": Plain(multi_mnist.GRAMMAR, multi_mnist.PRIOR, digit_place),
    }
    cars = {
        "probscene, structures only": lambda: derived(aerial2d),
        "probscene, with places": cars_placed,
        "probscene, the model's own program": aerial,
        "plain Python lists, with places": Plain(aerial2d.GRAMMAR, aerial2d.PRIOR, road_place),
    }
    table("Multi-MNIST", digits, DIGITS, list(range(11)), given.scenic_python, given.seconds)
    table("Aerial 2D", cars, ROADS, roads, given.scenic_python, given.seconds)
    if not given.scenic_python:
        print("Scenic was not measured: name an interpreter that has it with --scenic-python (see --help).")


if __name__ == "__main__":
    main()
