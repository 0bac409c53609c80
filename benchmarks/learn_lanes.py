"""How close the layout of cars comes to the target's on Aerial 2D, learnt with structure from images alone.

    python benchmarks/learn_lanes.py [--out FOLDER] [--seeds 0] [--images 2000] [--preset quick] [--set key=value]

The target's images are drawn by the model's own target program, as in ``learn_aerial.py``; its cars are spaced evenly
in their lanes. Printed for the prior, the learnt structure alone, structure and parameters, and the target itself: how
far cars are from even spacing, pixels; the standard deviation of the gap between two cars over that of even spacing;
how far they are turned from the lane's axis, degrees; by how many cars the lanes of a road differ; and KID from 500
target images in EfficientNet-Lite0's features, with an interval; the target's own row has that of another 500. FOLDER
holds the runs, ``results.json`` and a picture for each seed, ``scenes-K.png``: prior, structure alone, both, target.
"""

import argparse
import json
import math
from copy import copy
from pathlib import Path

import cv2
import numpy as np
import torch
from given import out_option
from learn_aerial import Truth, judged
from learn_parameters import IMAGES, drawn, with_interval
from torch import Tensor

from probscene.app.api.fit import fit
from probscene.app.datasets.generate import generate_scenes
from probscene.app.files import write_json
from probscene.app.fitting.pipeline import Execution
from probscene.app.fitting.presets import preset
from probscene.app.fitting.store import timing
from probscene.app.memory import tune_malloc
from probscene.dataset import ImageFolder
from probscene.inference.features.pretrained import EfficientNetLite
from probscene.inference.statistics.image_metrics import kid
from probscene.models.aerial2d import CANVAS, GRAMMAR, MODEL
from probscene.sampling import Scenes, sample, seed_everything

SIDE = 3  # pictures along a side of a panel


def lane_errors(scenes: list[Scenes]) -> dict[str, float]:
    """Of the cars of all scenes, from what is drawn."""
    away, gaps, turned, uneven = [], [], [], []
    for some in scenes:
        road, car = (layer for layer in some.drawing.layers if layer.labelled and layer.present.any())
        parent = some.derivation.trimmed().parent
        is_car = some.drawing.kind == GRAMMAR.kind("car")
        for n in range(len(parent)):
            for r in parent[n][is_car[n]].unique().tolist():
                mine = is_car[n] & (parent[n] == r)
                below = car.y[n] > road.y[n, r]
                lanes = [car.x[n][mine & (below == side)].sort().values for side in (False, True)]
                uneven.append(abs(len(lanes[0]) - len(lanes[1])))
                for x in filter(len, lanes):
                    pitch = CANVAS / len(x)
                    away += (x - pitch * (torch.arange(len(x)) + 0.5)).abs().tolist()
                    gaps += (x.diff() / pitch).tolist()
                to_axis = (car.angle[n][mine] + math.pi / 2).remainder(math.pi) - math.pi / 2
                turned += (to_axis.abs() * 180 / math.pi).tolist()
    figures = (np.mean(away), np.std(gaps), np.mean(turned), np.mean(uneven))
    return dict(zip(("place", "gap_sd", "angle", "uneven"), map(float, figures), strict=True))


def picture(panels: list[Tensor], path: Path) -> None:
    """Panels of pictures beside one another."""
    blocks = []
    for images in panels:
        framed = torch.nn.functional.pad(images[: SIDE**2], (2, 2, 2, 2), value=90)
        side = framed.shape[2]
        grid = framed.view(SIDE, SIDE, 3, side, side).permute(0, 3, 1, 4, 2).reshape(SIDE * side, -1, 3)
        blocks.append(np.pad(grid.numpy(), ((0, 0), (0, 40), (0, 0)), constant_values=255))
    whole = np.concatenate(blocks, 1)[:, :-40, ::-1]
    cv2.imwrite(str(path), cv2.resize(whole, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))


def measured(seed: int, args: argparse.Namespace) -> dict:
    """One seed's rows."""
    target, truth = args.out / f"target-{seed}", MODEL.target(0)
    generate_scenes(truth, truth.prior, args.images, target, seed=1000 + seed, format="images")
    config, out = preset(args.preset).set("parameters=any", *args.set), args.out / f"both-{seed}"
    execution = Execution(1, cache=args.out / "cache")
    run = fit("aerial2d", target / "images", config, out=out, seed=seed, resume=True, execution=execution)
    look, real = EfficientNetLite(), ImageFolder(target / "images", run.model.canvas, run.model.channels)
    of_real = look.embed(torch.stack([real.load(i) for i in range(2 * IMAGES)]))
    seed_everything(seed)
    floor = kid(of_real[:IMAGES], of_real[IMAGES:], "efficientnet")
    row: dict = {
        "seed": seed,
        "kept": run.parameters["kept"],
        "seconds": timing(run),
        "structure_of": judged(run.guide, Truth()),
    }
    row["target"] = lane_errors([sample(truth, truth.prior, IMAGES)]) | {"kid": with_interval(floor)}
    panels = []
    for source in ("prior", "structure", "both"):
        policy = copy(run.model.prior if source == "prior" else run.guide)
        policy.with_parameters = run.guide.with_parameters if source == "both" else None
        scenes, pictures = drawn(run, policy, 1)
        distance = kid(of_real[:IMAGES], look.embed(pictures), "efficientnet")
        row[source] = lane_errors(scenes) | {"kid": with_interval(distance)}
        panels.append(pictures)
    picture([*panels, torch.stack([real.load(i) for i in range(SIDE**2)])], args.out / f"scenes-{seed}.png")
    return row


def main():
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    out_option(parser, __file__)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--images", type=int, default=2000)
    parser.add_argument("--preset", default="quick")
    parser.add_argument("--set", action="append", default=[], help="as of probscene fit")
    args = parser.parse_args()
    tune_malloc()
    rows = []
    for seed in args.seeds:
        rows.append(measured(seed, args))
        print(json.dumps(rows[-1]), flush=True)
        write_json(args.out / "results.json", rows)


if __name__ == "__main__":
    main()
