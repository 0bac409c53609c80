"""Taichi and Quadrants draw the same bytes: sprites, streets, and what a camera makes of them."""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

from probscene.renderers.engine_choice import ENGINES

DIGESTS = """
import hashlib, sys
import pyro, torch
import pyro.distributions as dist
import probscene as ps
from probscene.app.loading import load_model, renderer_for
from probscene.sampling import sample, seed_everything

GRAMMAR = ps.Grammar("Scene -> Plates\\nPlates -> plate Plates | ε")

@ps.scene_model(
    GRAMMAR, ps.StructurePrior(GRAMMAR, Plates=ps.counts(1, 2, 2)), canvas=(60, 90), max_steps=8, classes=("plate",)
)
def photographed(scene):
    photo = scene.photo(
        exposure=(0.7, 1.3), vignette=(0.0, 0.5), blur=(0.5, 2.0), noise=(1.0, 8.0), jpeg_quality=(40.0, 95.0)
    )
    with scene.nodes("plate"):
        x = pyro.sample("plate.x", dist.Uniform(10.0, 80.0))
    return scene.draw(ps.Sprites.disc("plate", x, 32.0, radius=8.0), background=(0.4, 0.3, 0.2), photo=photo)

for model in (*map(load_model, ("multi_mnist", "aerial2d", "driving_simple")), photographed):
    seed_everything(0)
    batch = renderer_for(model, 1)(sample(model, model.prior, 4, density=False).drawing)
    geometry = [] if batch.space is None else [value for value in batch.space if torch.is_tensor(value)]
    for value in (*batch[:7], *geometry):
        print(model.name, hashlib.sha256(value.contiguous().numpy().tobytes()).hexdigest())
print(sorted({"taichi", "quadrants"} & {*sys.modules}))
"""


def _digests(engine):
    command, environment = [sys.executable, "-c", DIGESTS], {**os.environ, "PROBSCENE_ENGINE": engine}
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def test_both_engines_draw_the_same_bytes():
    with ThreadPoolExecutor() as pool:
        drawn = dict(zip(ENGINES, pool.map(_digests, ENGINES), strict=True))
    assert len(drawn["taichi"]) > 28 and {engine: lines.pop() for engine, lines in drawn.items()} == {
        engine: f"['{engine}']" for engine in ENGINES
    }
    assert drawn["taichi"] == drawn["quadrants"]
