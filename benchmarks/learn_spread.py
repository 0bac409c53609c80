"""Whether spreads and dependences of parameters are learnt, on targets of Multi-MNIST that have some.

    python benchmarks/learn_spread.py --mnist FOLDER [--out FOLDER] [--targets 0 1 2] [--seed 0] [--preset quick]
                                      [--digits halves]

Images are drawn here with numpy and OpenCV from MNIST's digits. Each is a row: its height is N(m, 30) pixels, one
for all its digits; its gap is N(1, 0.15) of what would spread its digits over the canvas evenly; each digit is turned
by N(a, 8) degrees. m and a depend on the target. What would leave the canvas is drawn again. The fit sees the images
alone.

Printed for the prior, what was learnt and the truth, of as many scenes: mean and standard deviation of heights
(pixels), turns (degrees) and relative gaps (of images with two digits and more, by image), each with the Wasserstein-1
distance from the truth; ``neighbours``, the mean difference in height of neighbours; ``uneven``, the standard deviation
of relative gaps within an image; ``gap_number``, the correlation of an image's gap in pixels with its number of digits.
The floor is the distance of two samples of the truth that are as large as the target. The prior's scenes have the
learnt structures, so that all rows have the same numbers of digits.

A digit's turn is read by its slant, which differs from digit to digit, so that the model's digits and the target's have
to be of one population: the model draws with one half of MNIST's training set, the target with the other. With
``--digits t10k`` they are not: the model draws with the 4,500 digits that it comes with, the target with t10k, whose
digits lean 2.5 to 2.8 degrees less in the mean.
"""

import argparse
import gzip
import json
import shutil
from copy import copy
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from given import mnist_option, needed_mnist, out_option
from learn_multi_mnist import distributions, glyphs_of
from scipy.stats import wasserstein_distance

from probscene.app.api.fit import fit
from probscene.app.chunks import CHUNK, draw_chunk
from probscene.app.files import write_json
from probscene.app.fitting.begin import ModelFile
from probscene.app.fitting.pipeline import Execution
from probscene.app.fitting.presets import preset
from probscene.app.fitting.store import timing
from probscene.app.memory import tune_malloc

CANVAS, SIDE, SCENES = 256, 28, 4000
HEIGHT_SD, GAP_SD, TURN_SD = 30.0, 0.15, 8.0
NAMES = ("height", "turn", "gap")
HALVES, T10K = "halves", "t10k"


class Row(NamedTuple):
    """The digits of an image, from left to right: ``x``, ``y`` pixels of their middles, ``turn`` degrees, ``(n,)``."""

    x: np.ndarray
    y: np.ndarray
    turn: np.ndarray


def truth(target: int) -> tuple[float, float]:
    """The mean height, pixels, and turn, degrees."""
    rng = np.random.default_rng([10, target])
    return float(rng.uniform(108, 148)), float(rng.uniform(-6, 6))


def draw_row(rng: np.random.Generator, target: int, n: int) -> Row:
    """An image's row."""
    height, turn = truth(target)
    margin = 20
    while True:
        gap = rng.normal(1.0, GAP_SD) * CANVAS / (n + 1)
        x = CANVAS / 2 + gap * (np.arange(n) - (n - 1) / 2)
        y = rng.normal(height, HEIGHT_SD)
        if margin < y < CANVAS - margin and (n == 0 or margin < x[0] < CANVAS - margin):
            break
    turns = rng.normal(turn, TURN_SD, n)
    while (np.abs(turns) > 29).any():
        turns = np.where(np.abs(turns) > 29, rng.normal(turn, TURN_SD, n), turns)
    return Row(x, np.full(n, y), turns)


def halves(mnist: Path, folder: Path) -> Path:
    """A folder of IDX files with one half of the training set's digits as train and the other as t10k."""
    if not folder.is_dir():
        aside = folder.with_suffix(".part")
        aside.mkdir(parents=True, exist_ok=True)
        for first, part in enumerate(("train", "t10k")):
            glyphs = [of_class[first::2] for of_class in glyphs_of(mnist, "train")]
            labels = np.repeat(np.arange(10, dtype=np.uint8), [len(of_class) for of_class in glyphs])
            for name, values in (("images-idx3", np.concatenate(glyphs)), ("labels-idx1", labels)):
                sizes = np.array(values.shape, ">u4").tobytes()
                data = bytes((0, 0, 8, values.ndim)) + sizes + values.tobytes()
                (aside / f"{part}-{name}-ubyte.gz").write_bytes(gzip.compress(data, 1))
        aside.rename(folder)
    return folder


def draw_images(mnist: Path, target: int, folder: Path, images: int) -> None:
    """The target's folder."""
    if folder.is_dir():
        return
    glyphs = glyphs_of(mnist)
    number, share = distributions(target)
    rng = np.random.default_rng([11, target])
    aside = folder.with_suffix(".part")
    shutil.rmtree(aside, ignore_errors=True)
    aside.mkdir(parents=True)
    for i in range(images):
        row = draw_row(rng, target, int(rng.choice(11, p=number)))
        canvas = np.zeros((CANVAS, CANVAS), np.uint8)
        for x, y, turn in zip(*row, strict=True):
            glyph = rng.choice(glyphs[rng.choice(10, p=share)])
            middle = (SIDE - 1) / 2  # OpenCV's pixel centres are whole numbers, ours halves
            to = cv2.getRotationMatrix2D((middle, middle), turn, 1.0)
            to[:, 2] += x - 0.5 - middle, y - 0.5 - middle
            np.maximum(canvas, cv2.warpAffine(glyph, to, (CANVAS, CANVAS)), out=canvas)
        cv2.imwrite(str(aside / f"{i:06d}.png"), canvas)
    aside.rename(folder)


def rows_of(run, policy, seed: int) -> list[Row]:
    """Of scenes of the model."""
    rows = []
    for chunk in range(-(-SCENES // CHUNK)):
        scenes = draw_chunk(run.model, policy, seed, chunk)
        has = scenes.site_mask["digit.x"]
        values = [scenes.parameters[f"digit.{name}"].expand(has.shape) for name in ("x", "y", "angle")]
        for i in range(len(has)):
            x, y, angle = (value[i][has[i]].double().numpy() for value in values)
            order = x.argsort()
            rows.append(Row(x[order], y[order], np.degrees(angle[order])))
    return rows


def samples(rows: list[Row]) -> dict[str, np.ndarray]:
    """By name, all heights and turns, and the relative gaps of images."""
    several = [row for row in rows if len(row.x) > 1]
    gaps = [np.diff(row.x).mean() * (len(row.x) + 1) / CANVAS for row in several]
    return dict(
        zip(
            NAMES,
            (np.concatenate([r.y for r in rows]), np.concatenate([r.turn for r in rows]), np.array(gaps)),
            strict=True,
        )
    )


def figures(rows: list[Row], true: list[Row]) -> dict[str, float]:
    """What is printed."""
    several = [row for row in rows if len(row.x) > 1]
    found, expected = samples(rows), samples(true)
    result = {}
    for name in NAMES:
        result |= {f"{name}": found[name].mean(), f"{name}_sd": found[name].std()}
        result[f"{name}_w1"] = wasserstein_distance(found[name], expected[name])
    result["neighbours"] = np.concatenate([np.abs(np.diff(row.y)) for row in several]).mean()
    relative = [np.diff(row.x) * (len(row.x) + 1) / CANVAS for row in several if len(row.x) > 2]
    result["uneven"] = float(np.sqrt(np.mean([gaps.var() for gaps in relative])))
    pixels = [(np.diff(row.x).mean(), len(row.x)) for row in several]
    result["gap_number"] = float(np.corrcoef(np.array(pixels).T)[0, 1])
    return {name: round(float(value), 4) for name, value in result.items()}


def measured(target: int, args: argparse.Namespace) -> dict:
    """The rows of one target."""
    assets = None if args.digits == T10K else halves(args.mnist, args.out / HALVES)
    images = args.out / f"{args.digits}-{target}"
    draw_images(assets or args.mnist, target, images, args.images)
    config, out = preset(args.preset).set(*args.set), args.out / f"{args.preset}-{args.digits}-{target}-{args.seed}"
    execution, model = Execution(1, cache=args.out / "cache"), ModelFile("multi_mnist", assets)
    run = fit(model, images, config, out=out, seed=args.seed, resume=True, execution=execution)
    number, rng = distributions(target)[0], np.random.default_rng([12, target])

    def true_rows(many: int) -> list[Row]:
        return [draw_row(rng, target, int(n)) for n in rng.choice(11, many, p=number)]

    true, one, other = true_rows(20_000), true_rows(args.images), true_rows(args.images)
    plain = copy(run.guide)
    plain.with_parameters = None
    found = {"prior": rows_of(run, plain, 1), "learnt": rows_of(run, run.guide, 1), "truth": true}
    return {
        "target": target,
        "seed": args.seed,
        "kept": run.parameters["kept"],
        "sites": {site["name"]: site["learnt"] or site["because"] for site in run.parameters["sites"]},
        "seconds": timing(run),
        **{name: figures(rows, true) for name, rows in found.items()},
        "floor": figures(one, other),
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    mnist_option(parser)
    out_option(parser, __file__)
    parser.add_argument("--targets", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--images", type=int, default=2000)
    parser.add_argument("--digits", choices=(HALVES, T10K), default=HALVES, help="see above")
    parser.add_argument("--preset", default="quick")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--set", action="append", default=[], help="as of probscene fit")
    args = parser.parse_args()
    tune_malloc()
    args.mnist = needed_mnist(args.mnist)
    rows = []
    for target in args.targets:
        rows.append(measured(target, args))
        print(json.dumps(rows[-1]), flush=True)
        write_json(args.out / "results.json", rows)


if __name__ == "__main__":
    main()
