"""How close a fit comes to the truth on Multi-MNIST, from target images that another program drew.

    python benchmarks/learn_multi_mnist.py --mnist FOLDER [--out FOLDER] [--presets quick oracle] [--targets 0]
        [--learn structure]

The images are drawn here with numpy and OpenCV from the digits of t10k (the original IDX files), which the model does
not have; the fit sees the folder alone. Printed is the total variation of the number of digits and of their classes
between 20,000 structures and the distributions that the target was drawn from, of the prior, of the start and of what
was learnt, and of the labels of 5,000 images that ``generate`` writes. The floor is between two samples of the truth
that are as large as the target. Runs of one preset and seed share their feature network, which depends on nothing else.
"""

import argparse
import gzip
import json
import shutil
import time
from pathlib import Path

import cv2
import numpy as np
import torch
from given import mnist_option, needed_mnist, out_option

from probscene.app.api.fit import fit
from probscene.app.datasets.generate import generate_scenes
from probscene.app.files import write_json
from probscene.app.fitting.config import BOTH, STRUCTURE, configuration, parameter_choice
from probscene.app.fitting.pipeline import Execution
from probscene.app.fitting.presets import DEFAULT, PAPER, QUICK
from probscene.app.fitting.store import timing
from probscene.derive import derive_complete
from probscene.drawing import Drawing
from probscene.inference.guides.lstm import LSTMGuide
from probscene.inference.objective import ScoreFunction, ScoreFunctionConfig
from probscene.inference.pretrain import pretrain
from probscene.inference.statistics.count_metrics import histogram, pooled_shares, total_variation
from probscene.inference.structure_training import StructureSchedule, StructureTraining
from probscene.models.multi_mnist import CLASSES, GRAMMAR, MODEL
from probscene.sampling import seed_everything
from probscene.structure import StructurePrior, counts, weights

PRESETS = {
    "quick": QUICK,
    "quick-mmd": QUICK.with_divergence("mmd"),
    "default": DEFAULT,
    "default-mmd": DEFAULT.with_divergence("mmd"),
    "paper": PAPER,
    "oracle": QUICK,
}
ORACLE_BATCHES = 100
GENERATED = 5000  # images
FLOOR_PAIRS = 50
SOURCES = ("prior", "start", "learnt", "generated", "floor")


def distributions(target: int) -> tuple[np.ndarray, np.ndarray]:
    """Truth: P(number of digits) ``(11,)`` and P(class) ``(10,)``."""
    rng = np.random.default_rng([7, target])
    return rng.dirichlet(np.ones(11)), rng.dirichlet(np.ones(10))


def glyphs_of(mnist: Path, part: str = "t10k") -> list[np.ndarray]:
    """The digits of t10k, or of another part of MNIST, ``(n, 28, 28)`` uint8 of each class."""
    pixels = np.frombuffer(gzip.decompress((mnist / f"{part}-images-idx3-ubyte.gz").read_bytes()), np.uint8, offset=16)
    labels = np.frombuffer(gzip.decompress((mnist / f"{part}-labels-idx1-ubyte.gz").read_bytes()), np.uint8, offset=8)
    return [pixels.reshape(-1, 28, 28)[labels == c] for c in range(10)]


def draw_target(mnist: Path, target: int, folder: Path, images: int) -> None:
    """Upright digits in an evenly spaced row, pasted by numpy."""
    if folder.is_dir():
        return
    glyphs = glyphs_of(mnist)
    number, share = distributions(target)
    rng = np.random.default_rng([8, target])
    aside = folder.with_suffix(".part")
    shutil.rmtree(aside, ignore_errors=True)
    aside.mkdir(parents=True)
    for i in range(images):
        n = rng.choice(11, p=number)
        canvas = np.zeros((256, 256), np.uint8)
        for k, digit in enumerate(rng.choice(10, p=share, size=n)):
            x = round(256 * (k + 1) / (n + 1)) - 14
            window = canvas[114:142, x : x + 28]
            np.maximum(window, rng.choice(glyphs[digit]), out=window)
        cv2.imwrite(str(aside / f"{i:06d}.png"), canvas)
    aside.rename(folder)


def distances(policy, target: int) -> tuple[float, float]:
    """Total variation of number and of classes between 20,000 structures and the truth."""
    seed_everything(99)
    derivation, _ = derive_complete(GRAMMAR, policy, 20_000, MODEL.max_steps)
    return from_truth(
        derivation.counts(len(GRAMMAR.kinds))[:, [GRAMMAR.kind(name) for name in CLASSES]].numpy(), target
    )


def distances_generated(policy, target: int, folder: Path) -> tuple[float, float]:
    """The same between the labels of images that are generated and the truth."""
    generate_scenes(MODEL, policy, GENERATED, folder, seed=5)
    seen = np.zeros((GENERATED, len(CLASSES)), int)
    for label in json.loads((folder / "annotations.json").read_text())["annotations"]:
        seen[label["image_id"], label["category_id"] - 1] += 1
    return from_truth(seen, target)


def from_truth(seen: np.ndarray, target: int) -> tuple[float, float]:
    """Total variation of number and of classes between counts ``(N, 10)`` and the truth."""
    return apart(shares(seen), distributions(target))


def shares(seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of each number of digits, and of each class, in counts ``(N, 10)``."""
    return histogram(seen.sum(1)), pooled_shares(seen)


def apart(one: tuple[np.ndarray, np.ndarray], other: tuple[np.ndarray, np.ndarray]) -> tuple[float, float]:
    """Total variation of number and of classes."""
    number, classes = (total_variation(*pair) for pair in zip(one, other, strict=True))
    return number, classes


def floor(target: int, images: int) -> tuple[float, float]:
    """The mean distances of two samples of the truth, of as many images as the target has."""
    (number, share), rng = distributions(target), np.random.default_rng([9, target])

    def sample() -> tuple[np.ndarray, np.ndarray]:
        lengths = rng.choice(len(number), images, p=number)
        return shares(rng.multinomial(lengths, share))

    each = [apart(sample(), sample()) for _ in range(FLOOR_PAIRS)]
    number_apart, classes_apart = np.mean(each, 0)
    return float(number_apart), float(classes_apart)


def fit_images(name: str, target: int, seed: int, args) -> tuple[LSTMGuide, dict[str, float]]:
    """A fit from images, resumed if it was begun."""
    images, out = args.out / f"target-{target}", args.out / f"{name}-{target}"
    config = configuration(PRESETS[name], parameters=parameter_choice(args.learn, None))
    execution = Execution(cache=args.out / "cache")
    run = fit("multi_mnist", images, config, out=out, seed=seed, resume=True, execution=execution)
    return run.guide, timing(run)


def fit_counts(target: int, seed: int, images: int) -> tuple[LSTMGuide, dict[str, float]]:
    """The same objective on true counts: what is left is the error of optimisation."""
    start = time.monotonic()
    kinds = [GRAMMAR.kind(name) for name in CLASSES]

    def observe(scenes):
        seen = scenes.derivation.counts(len(GRAMMAR.kinds))[:, kinds].float()
        return torch.cat([seen, seen.sum(1, keepdim=True)], 1)

    def structures(num_scenes):
        drawn = MODEL.program(num_scenes, MODEL.prior)
        return Drawing(drawn.kind, drawn.kinds, ())

    seed_everything(seed)
    number, share = distributions(target)
    truth = StructurePrior(GRAMMAR, Digits=counts(*number), Digit=weights(*share))
    real, _ = derive_complete(GRAMMAR, truth, images, MODEL.max_steps)
    seen = real.counts(len(GRAMMAR.kinds))[:, kinds].float()
    guide = LSTMGuide(GRAMMAR, MODEL.max_steps)
    pretrain(guide, MODEL.prior)
    loss = ScoreFunction(observe, QUICK.divergence(), ScoreFunctionConfig(updates=QUICK.updates))
    features = torch.cat([seen, seen.sum(1, keepdim=True)], 1)
    StructureTraining(structures, guide, loss, features, StructureSchedule(batches=ORACLE_BATCHES), seed=seed).run()
    return guide, {"structure": time.monotonic() - start}


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    mnist_option(parser)
    out_option(parser, __file__)
    parser.add_argument("--presets", nargs="+", choices=PRESETS, default=["quick", "oracle"])
    parser.add_argument("--targets", nargs="+", type=int, default=[0])
    parser.add_argument("--images", type=int, default=5000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--learn", choices=[STRUCTURE, BOTH], default=STRUCTURE, help="as of probscene fit (%(default)s)"
    )
    args = parser.parse_args()
    args.mnist = needed_mnist(args.mnist)
    rows = []
    for name in args.presets:
        for target in args.targets:
            draw_target(args.mnist, target, args.out / f"target-{target}", args.images)
            if name == "oracle":
                guide, took = fit_counts(target, args.seed, args.images)
            else:
                guide, took = fit_images(name, target, args.seed, args)
            rows.append(
                {
                    "preset": name,
                    "target": target,
                    "prior": distances(MODEL.prior, target),
                    "start": distances(MODEL.pretraining_policy, target),
                    "learnt": distances(guide, target),
                    "generated": distances_generated(guide, target, args.out / f"{name}-{target}-generated"),
                    "floor": floor(target, args.images),
                    "seconds": took,
                }
            )
            print(json.dumps(rows[-1]), flush=True)
            write_json(args.out / "results.json", rows)
    show(args.presets, rows)


def show(presets: list[str], rows: list[dict]) -> None:
    """Print a line for each preset and what is compared: the means over the targets, then what was learnt of each."""
    print(f"\n{'':20}" + "".join(f"{source:>11}" for source in SOURCES) + "   learnt, each target")
    for name in presets:
        for column, what in enumerate(("number", "classes")):
            found = np.array([[row[source][column] for source in SOURCES] for row in rows if row["preset"] == name])
            cells = "".join(f"{mean:11.3f}" for mean in found.mean(0))
            each = " ".join(f"{value:.3f}" for value in found[:, SOURCES.index("learnt")])
            print(f"{name:12}{what:8}{cells}   {each}")


if __name__ == "__main__":
    main()
