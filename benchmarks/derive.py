"""Prior derivations of Multi-MNIST a second, in batches of 500 on one thread, beside Scenic and plain Python.

Scenic (BSD licence; version 3.1) is no dependency of ours. Give it an environment of its own and name its interpreter:

    python3.11 -m venv /tmp/scenic && /tmp/scenic/bin/pip install 'scenic==3.1.*'
    python benchmarks/derive.py --scenic-python /tmp/scenic/bin/python

The scene is the same for all: n uniform in 0..10 objects, each of one of ten classes, with uniform x and y. A Scenic
program has no random number of objects, so it gets eleven programs, compiled before the clock runs. By default Scenic
keeps objects from overlapping, by drawing the scene again, which ours does not; both ways are measured.
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
from probscene.models.multi_mnist import CLASSES, GRAMMAR, MAX_STEPS, PRIOR
from probscene.scene import SceneGraph

BATCH = 500
LOW, HIGH = 20.0, 236.0  # pixels

SCENIC = """
import json, random, sys, time
import numpy, scenic

program = '''
class Digit:
    label: DiscreteRange(0, 9)
    width: 28
    length: 28
    allowCollisions: {overlap}
    requireVisible: False

ego = new Object at (-1000, -1000), with requireVisible False
for i in range(globalParameters.number):
    new Digit at (Range({low}, {high}), Range({low}, {high}))
'''.format(**json.loads(sys.argv[1]))
scenarios = [scenic.scenarioFromString(program, params={"number": n}, mode2D=True) for n in range(11)]
random.seed(0), numpy.random.seed(0)
start, scenes, objects = time.process_time(), 0, 0
while (passed := time.process_time() - start) < float(sys.argv[2]):
    scene, _ = scenarios[random.randrange(11)].generate(maxIterations=10**6)
    scenes, objects = scenes + 1, objects + len(scene.objects) - 1
print(json.dumps([scenes / passed, objects / scenes]))
"""


def derived() -> int:
    """A batch of structures; the number of digits in it."""
    with pyro.plate("scenes", BATCH, dim=-2):
        derivation = derive(GRAMMAR, PRIOR, BATCH, MAX_STEPS)
    return int((derivation.kind > 0).sum())  # kind 0 is the background


def placed() -> int:
    """A batch of structures with a place for each digit."""
    with pyro.plate("scenes", BATCH, dim=-2):
        scene = SceneGraph(GRAMMAR, derive(GRAMMAR, PRIOR, BATCH, MAX_STEPS))
        with scene.nodes(*CLASSES):
            pyro.sample("x", dist.Uniform(LOW, HIGH))
            pyro.sample("y", dist.Uniform(LOW, HIGH))
    return int((scene.kind > 0).sum())


class Plain:
    """The same prior by recursive descent in plain Python: one scene after the other, as lists.

    It shows what the tensors cost: here are no tensors to draw from, no Pyro sites, no log-probabilities, no policy
    that is a network.
    """

    def __init__(self):
        self.table = PRIOR.table[:, 0].double().exp().cumsum(-1).tolist()  # (V + 1, C, K), as no list is ranked here
        self.productions = [
            [(child, GRAMMAR.nonterminals.index(child) if child[0].isupper() else -1) for child in rule.rhs]
            for rule in GRAMMAR.rules
        ]

    def __call__(self) -> int:
        """A batch; each scene is a list of nodes (kind, parent, x, y)."""
        digits = 0
        for _ in range(BATCH):
            nodes = []
            self.expand(0, 0, nodes)
            digits += len(nodes) - 1
        return digits

    def expand(self, symbol: int, repeat: int, nodes: list[tuple]) -> None:
        """Choose a rule, append its objects and expand its nonterminals."""
        below = self.table[symbol][repeat]
        for name, child in self.productions[bisect.bisect(below, random.random() * below[-1])]:
            if child < 0:
                nodes.append((name, -1, random.uniform(LOW, HIGH), random.uniform(LOW, HIGH)))
            else:
                self.expand(child, repeat + 1 if child == symbol else 0, nodes)


def rate(batch, seconds: float) -> tuple[float, float]:
    """Scenes a CPU second, and digits a scene."""
    batch()  # warm
    start, scenes, digits = time.process_time(), 0, 0
    while (passed := time.process_time() - start) < seconds:
        digits += batch()
        scenes += BATCH
    return scenes / passed, digits / scenes


def scenic(python: str, overlap: bool, seconds: float) -> tuple[float, float]:
    """The same of Scenic, in a process of its own."""
    options = json.dumps({"overlap": overlap, "low": LOW, "high": HIGH})
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    run = subprocess.run([python, "-c", SCENIC, options, str(seconds)], capture_output=True, text=True, env=environment)
    if run.returncode:
        sys.exit(f"Scenic did not run under {python}:\n{run.stderr}")
    return tuple(json.loads(run.stdout.splitlines()[-1]))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenic-python", metavar="PATH", help="an interpreter that has Scenic 3.1")
    parser.add_argument("--seconds", type=float, default=5.0, help="CPU seconds for each row")
    given = parser.parse_args()
    torch.set_num_threads(1)
    pyro.set_rng_seed(0)
    rows = [
        ("probscene, structures only", rate(derived, given.seconds)),
        ("probscene, with places", rate(placed, given.seconds)),
        ("plain Python lists, with places", rate(Plain(), given.seconds)),
    ]
    if given.scenic_python:
        rows += [
            ("Scenic, its default: no overlap", scenic(given.scenic_python, False, given.seconds)),
            ("Scenic, overlap allowed", scenic(given.scenic_python, True, given.seconds)),
        ]
    ours = rows[1][1][0]
    print(f"{'':32} {'scenes/s':>10} {'digits':>7} {'ours is':>9}")
    for name, (scenes, digits) in rows:
        print(f"{name:32} {scenes:10,.0f} {digits:7.2f} {ours / scenes:8.1f}x")
    if not given.scenic_python:
        print("Scenic was not measured: name an interpreter that has it with --scenic-python (see --help).")


if __name__ == "__main__":
    main()
