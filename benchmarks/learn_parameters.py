"""How close layout comes to the target's on Multi-MNIST, learnt with structure from images of another program.

    python benchmarks/learn_parameters.py --mnist FOLDER [--out FOLDER] [--targets 0] [--preset quick] [--seed 0]
        [--parameters likelihood]

Targets are those of ``learn_multi_mnist.py``: upright digits of t10k in an evenly spaced row. Printed for the prior,
the learnt structure alone, the learnt parameters alone (in the prior's structures), and both: how far digits are from
their places in the row and from its line, pixels; how far they are turned, degrees; how many are more than five pixels
off; and KID from 500 target images in EfficientNet-Lite0's features, with an interval, and its floor, another 500
target images. Learnt parameters are shown whether the fit has kept them or not; it says which. Total variation of the
number of digits and of their classes is that of the structures, before and after their second pass. FOLDER holds the
runs, ``results.json`` and a picture of each target and way of learning parameters, ``scenes-K.png`` for likelihood:
prior, structure alone, both, target.
"""

import argparse
import json
import math
from copy import copy
from pathlib import Path

import cv2
import numpy as np
import torch
from given import mnist_option, needed_mnist, out_option
from learn_multi_mnist import distances, draw_target
from torch import Tensor

from probscene.app.api.fit import fit
from probscene.app.chunks import CHUNK, draw_chunk
from probscene.app.files import write_json
from probscene.app.fitting.config import LIKELIHOOD
from probscene.app.fitting.learnt_parameters import NAME, learnt_by, prefixed
from probscene.app.fitting.pipeline import Execution
from probscene.app.fitting.presets import preset
from probscene.app.fitting.run import RunFolder
from probscene.app.fitting.store import timing
from probscene.app.fitting.structure_stage import BEFORE
from probscene.app.loading import renderer_for
from probscene.app.memory import tune_malloc
from probscene.dataset import ImageFolder
from probscene.inference.features.pretrained import EfficientNetLite
from probscene.inference.statistics.image_metrics import ImageDistance, kid
from probscene.policy import Policy
from probscene.sampling import Scenes

IMAGES, OFF, SIDE = 500, 5.0, 4  # of each side for KID; pixels; pictures along a side of a panel
SOURCES = ("prior", "structure", "parameters", "both")
SHOWN = ("prior", "structure", "both")


def row_errors(scenes: list[Scenes]) -> dict[str, float]:
    """Of the digits of all scenes, how far they are from an upright, evenly spaced row."""
    parts = []
    for some in scenes:
        has = some.site_mask["digit.x"]
        x = some.parameters["digit.x"].where(has, torch.inf).sort(1).values
        number = has.sum(1, keepdim=True)
        place = 256 * torch.arange(1, x.shape[1] + 1) / (number + 1)
        across = (x - place).where(torch.isfinite(x), torch.nan).abs()
        order = some.parameters["digit.x"].where(has, torch.inf).argsort(1)
        up = (some.parameters["digit.y"] - 128).abs().gather(1, order)
        turned = some.parameters["digit.angle"].abs().gather(1, order) * 180 / math.pi
        parts.append(torch.stack([across, up, turned], -1)[torch.isfinite(x)])
    errors = torch.cat(parts)
    off = (errors[:, :2] > OFF).any(1).double().mean()
    return dict(zip(("place", "line", "angle", "off"), [*errors.mean(0).tolist(), float(off)], strict=True))


def drawn(run: RunFolder, policy: Policy, seed: int) -> tuple[list[Scenes], Tensor]:
    """Scenes, and their first ``IMAGES`` images ``(IMAGES, 3, H, W)``."""
    render = renderer_for(run.model)
    scenes = [draw_chunk(run.model, policy, seed, chunk) for chunk in range(-(-IMAGES // CHUNK))]
    return scenes, torch.cat([render(some.drawing).image for some in scenes])[:IMAGES]


def with_interval(figure: ImageDistance) -> dict[str, float]:
    """For JSON."""
    return {"value": figure.value, "low": figure.low, "high": figure.high}


def picture(panels: list[Tensor], path: Path) -> None:
    """Panels of pictures beside one another."""
    blocks = []
    for images in panels:
        framed = torch.nn.functional.pad(images[: SIDE**2, 0], (2, 2, 2, 2), value=90)
        grid = framed.view(SIDE, SIDE, *framed.shape[1:])
        block = grid.permute(0, 2, 1, 3).reshape(SIDE * framed.shape[1], -1).numpy()
        blocks.append(np.pad(block, ((0, 0), (0, 40)), constant_values=255))
    whole = np.concatenate(blocks, 1)[:, :-40]
    cv2.imwrite(str(path), cv2.resize(whole, None, fx=0.375, fy=0.375, interpolation=cv2.INTER_AREA))


def measured(target: int, method: str, args: argparse.Namespace) -> dict:
    """The rows of one target and one way of learning parameters."""
    images, name = args.out / f"target-{target}", "both" if method == LIKELIHOOD else method
    draw_target(args.mnist, target, images, args.images)
    config, out = preset(args.preset).set(f"parameters={method}", *args.set), args.out / f"{name}-{target}"
    execution = Execution(1, cache=args.out / "cache")
    run = fit("multi_mnist", images, config, out=out, seed=args.seed, resume=True, execution=execution)
    look, real = EfficientNetLite(), ImageFolder(images, run.model.canvas, run.model.channels)
    of_real = look.embed(torch.stack([real.load(i) for i in range(2 * IMAGES)]))
    first, before = run.new_guide().eval(), run.read_tensors(BEFORE)
    assert before is not None
    first.load_state_dict(before)
    row: dict = {
        "target": target,
        "seed": args.seed,
        "method": method,
        "kept": run.parameters["kept"],
        "seconds": timing(run),
        "total_variation": distances(run.guide, target),
        "total_variation_before": distances(first, target),
    }
    row["floor"] = with_interval(kid(of_real[:IMAGES], of_real[IMAGES:], "efficientnet"))
    panels, tensors = [], run.read_tensors(NAME)
    learnt = None
    if tensors:
        learnt = learnt_by(run.model, run.config, run.parameters, run.guide, prefixed(tensors)).with_parameters
    for source in SOURCES:
        policy = copy(run.guide if source in ("structure", "both") else run.model.prior)
        policy.with_parameters = learnt if source in ("parameters", "both") else None
        scenes, pictures = drawn(run, policy, 1)
        distance = kid(of_real[:IMAGES], look.embed(pictures), "efficientnet")
        row[source] = row_errors(scenes) | {"kid": with_interval(distance)}
        panels += [pictures] if source in SHOWN else []
    file = f"scenes-{target}.png" if method == LIKELIHOOD else f"scenes-{method}-{target}.png"
    picture([*panels, torch.stack([real.load(i) for i in range(SIDE**2)])], args.out / file)
    return row


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    mnist_option(parser)
    out_option(parser, __file__)
    parser.add_argument("--targets", nargs="+", type=int, default=[0])
    parser.add_argument("--images", type=int, default=2000)
    parser.add_argument("--preset", default="quick")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--parameters", nargs="+", default=[LIKELIHOOD], help="ways of learning them")
    parser.add_argument("--set", action="append", default=[], help="as of probscene fit")
    args = parser.parse_args()
    tune_malloc()
    args.mnist = needed_mnist(args.mnist)
    rows = []
    for target in args.targets:
        for method in args.parameters:
            rows.append(measured(target, method, args))
            print(json.dumps(rows[-1]), flush=True)
            write_json(args.out / "results.json", rows)


if __name__ == "__main__":
    main()
