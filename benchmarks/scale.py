"""What a fit costs against the number of target images, of objects in a scene, and of pixels: seconds and memory.

    python benchmarks/scale.py [--out FOLDER] [--images 300 3000 30000] [--objects 10 30 100 300]
                               [--canvas 128 256 512 1024]

Scenes are discs of two colours anywhere; the target has more of one. From 1,000 images of 128 x 128 pixels with about
10 objects one quantity grows at a time. Fits are short: 160 steps of the count network, 4 batches of structure, and 60
steps of parameters, each fit in a process of its own. Printed are seconds of each stage and the process's largest
memory in megabytes; then exponents: the slope of log seconds against the log of what grows, over the upper half of its
range. ``scale.png`` shows them, and has no point where a stage had nothing to do. A point that the folder's
``results.json`` has is not measured again. 100,000 images of 256 x 256 are ``--images 100000 --canvas 256 --objects``.
"""

import argparse
import json
import resource
import subprocess
import sys
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt
import numpy as np
import pyro
import pyro.distributions as dist
from given import out_option

import probscene as ps
from probscene.app.files import write_json
from probscene.app.fitting.store import timing
from probscene.app.memory import tune_malloc

GRAMMAR = ps.Grammar("""
    Scene -> Discs
    Discs -> Disc Discs | ε
    Disc  -> red | blue
""")
BASE = {"images": 1000, "objects": 10, "canvas": 128}
SETTINGS = {
    "features": "count", "features.schedule.steps": 160, "structure.batches": 4, "pretrain.derivations": 500,
    "pretrain.epochs": 2, "parameters.reader_steps": 20, "parameters.steps": 20, "parameters.rounds": 1,
    "parameters.round_reader_steps": 10, "parameters.round_steps": 10, "parameters.recalibration_renders": 400,
    "refine.batches": 1,
}  # fmt: skip
STAGES = ("reading", "features", "target", "pretraining", "structure", "parameters", "refinement", "outcome")


def discs(objects: int, canvas: int, reds: float) -> ps.SceneModel:
    """Scenes of 0.8 to 1.2 times so many discs, with a share of red ones."""
    low, high = round(0.8 * objects), round(1.2 * objects)
    lengths = ps.counts(*(1.0 if low <= n <= high else 0.0 for n in range(high + 1)))
    prior = ps.StructurePrior(GRAMMAR, Discs=lengths, Disc=ps.weights(reds, 1 - reds))

    @ps.scene_model(GRAMMAR, prior, canvas=(canvas, canvas), max_steps=3 * high + 4, classes=("red", "blue"))
    def discs(scene):
        with scene.nodes("red", "blue"):
            x = pyro.sample("x", dist.Uniform(8.0, canvas - 8.0))
            y = pyro.sample("y", dist.Uniform(8.0, canvas - 8.0))
        return scene.draw(
            ps.Sprites.disc("red", x, y, radius=4.0, tint=(1.0, 0.2, 0.2)),
            ps.Sprites.disc("blue", x, y, radius=4.0, tint=(0.2, 0.2, 1.0)),
        )

    return discs


def measured(images: int, objects: int, canvas: int, out: Path) -> dict[str, Any]:
    """A point's row."""
    tune_malloc()  # as the command line does
    name = f"{images}-{objects}-{canvas}"
    target = out / f"target-{name}"
    execution = ps.Execution(1, cache=False)
    config = ps.preset("quick").set(SETTINGS)
    run = ps.fit(discs(objects, canvas, 0.5), target / "images", config, out=out / f"run-{name}", execution=execution)
    megabytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {"images": images, "objects": objects, "canvas": canvas, "megabytes": megabytes, **timing(run)}


def in_a_process(images: int, objects: int, canvas: int, out: Path) -> dict[str, Any]:
    """A point's row, measured in a process of its own."""
    folder = out / f"target-{images}-{objects}-{canvas}"
    options = ps.DatasetOptions(flat=True)
    ps.generate(discs(objects, canvas, 0.8), images, folder, "images", options, progress=False)
    words = [sys.executable, __file__, "--out", out, "--point", images, objects, canvas]
    done = subprocess.run([*map(str, words)], stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def exponent(x: np.ndarray, y: np.ndarray) -> float:
    """The slope of log y against log x, over the upper half of the range of log x; NaN where some of y is."""
    upper = np.log(x) >= (np.log(x[0]) + np.log(x[-1])) / 2 - 1e-9
    upper[-2:] = True
    return float(np.polyfit(np.log(x[upper]), np.log(y[upper]), 1)[0]) if np.isfinite(y[upper]).all() else np.nan


def draw(rows: dict[str, list[dict[str, Any]]], file: Path) -> None:
    """Seconds of each stage against what grows."""
    figure, axes = plt.subplots(1, len(rows), figsize=(4.5 * len(rows), 4), sharey=True, squeeze=False)
    for axis, (what, points) in zip(axes[0], rows.items(), strict=True):
        for stage in STAGES:
            axis.loglog([p[what] for p in points], [p.get(stage, np.nan) for p in points], "o-", label=stage)
        axis.set_xlabel({"images": "target images", "objects": "objects a scene", "canvas": "canvas, pixels"}[what])
        axis.set_xticks([p[what] for p in points], [f"{p[what]:,}" for p in points])
        axis.minorticks_off()
        axis.grid(alpha=0.3)
    axes[0][0].set_ylabel("seconds")
    axes[0][-1].legend(fontsize=8, loc="center left", bbox_to_anchor=(1, 0.5))
    figure.tight_layout()
    figure.savefig(file, dpi=110)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    out_option(parser, __file__)
    parser.add_argument("--images", nargs="*", type=int, default=[300, 3000, 30000])
    parser.add_argument("--objects", nargs="*", type=int, default=[10, 30, 100, 300])
    parser.add_argument("--canvas", nargs="*", type=int, default=[128, 256, 512, 1024])
    parser.add_argument("--point", nargs=3, type=int, help=argparse.SUPPRESS)  # one, in this process
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    if args.point is not None:
        print(json.dumps(measured(*args.point, args.out)))
        return
    single = {what: values[0] for what in BASE if len(values := getattr(args, what)) == 1}
    rows: dict[str, list[dict[str, Any]]] = {}
    results = args.out / "results.json"
    before = json.loads(results.read_text()) if results.is_file() else []
    done = {tuple(point[what] for what in BASE): point for point in before}
    for what in BASE:
        for value in getattr(args, what):
            point = BASE | single | {what: value}
            if what in single and rows:
                continue
            values = tuple(point.values())
            if values not in done:
                done[values] = in_a_process(*values, args.out)
                print(json.dumps(done[values]), flush=True)
                write_json(results, list(done.values()))
            rows.setdefault(what, []).append(done[values])
    for what, points in rows.items():
        if len(points) > 1:
            x = np.array([point[what] for point in points], float)
            each = {s: exponent(x, np.array([p.get(s, np.nan) for p in points])) for s in (*STAGES, "megabytes")}
            print(f"{what}: " + ", ".join(f"{name} {value:.2f}" for name, value in each.items()))
    draw(rows, args.out / "scale.png")


if __name__ == "__main__":
    main()
