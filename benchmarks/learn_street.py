"""Whether a fit to real street frames comes closer to them than the prior: numbers of cars, FID and KID.

    python benchmarks/learn_street.py FRAMES/ LABELS --out FOLDER [--seeds 0 1 2] [--min-height 25]

Fits see the images alone. ``LABELS`` is KITTI's ``label_2``, or a CSV of counts, of the same images. Cars of scenes are
counted as the labels count them, of 2,000 rendered scenes (``probscene evaluate``). Printed for each seed: total
variation and Wasserstein-1 of the number of cars from the labels', FID and KID in EfficientNet's features, each for the
prior, the start and what was learnt; FOLDER holds the runs, ``results.json`` and a histogram, ``cars.png``.
"""

import argparse
import json
import time
from pathlib import Path

import matplotlib
import numpy as np

from probscene.app.api.fit import fit
from probscene.app.evaluation.evaluate import Evaluation, evaluate
from probscene.app.evaluation.labels import read_labels
from probscene.app.evaluation.sources import FITTED
from probscene.app.files import write_json
from probscene.app.fitting.overrides import override
from probscene.app.fitting.presets import preset
from probscene.app.memory import keep_freed_memory
from probscene.dataset import ImageFolder
from probscene.inference.judging.metrics import histogram, total_variation, wasserstein

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.ticker import MaxNLocator


def cars(found: Evaluation) -> dict[str, np.ndarray]:
    """The histogram of the number of cars by source."""
    column = found.classes.index("car")
    return {name: histogram(source.counts[:, column]) for name, source in found.sources.items()}


def row(found: Evaluation) -> dict:
    """How far prior, start and learnt are from the labels and from the images."""
    each = cars(found)
    out = {"truth": {"mean": round(float(np.dot(np.arange(len(each["truth"])), each["truth"])), 2)}}
    for name in (name for name in each if name in FITTED):
        out[name] = {
            "mean": round(float(np.dot(np.arange(len(each[name])), each[name])), 2),
            "total_variation": round(float(total_variation(each[name], each["truth"])), 3),
            "wasserstein": round(float(wasserstein(each[name], each["truth"])), 3),
        }
        for distances in found.images.values():
            out[name] |= {figure.name: round(float(figure.value), 4) for figure in distances[name]}
    return out


def picture(histograms: list[dict[str, np.ndarray]], path: Path) -> None:
    """The prior, what each seed learnt, and the labels."""
    most = max(len(each) for found in histograms for each in found.values())
    figure, axes = plt.subplots(figsize=(7, 3), layout="constrained")
    axes.bar(range(len(histograms[0]["truth"])), histograms[0]["truth"], color="0.85", width=0.9, label="labels")
    for name, colour in (("prior", "tab:orange"), ("start", "tab:purple")):
        axes.plot(histograms[0][name], "o--", color=colour, label=name)
    for i, found in enumerate(histograms):
        axes.plot(found["learnt"], "o-", color="tab:blue", alpha=0.6, label="learnt" if i == 0 else None)
    axes.set(xlabel="cars in an image", ylabel="share of images", xlim=(-0.6, most - 0.4))
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.legend()
    figure.savefig(path, dpi=130)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("images", type=Path)
    parser.add_argument("labels", type=Path)
    parser.add_argument("--out", type=Path, required=True, help="folder for the runs")
    parser.add_argument("--model", default="driving_simple")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--features", default="count=efficientnet", help="as of probscene fit")
    parser.add_argument("--set", action="append", default=[], dest="settings", help="as of probscene fit")
    parser.add_argument("--min-height", type=float, default=0.0, help="of KITTI's boxes that are counted, pixels")
    args = parser.parse_args()
    keep_freed_memory()
    rows, histograms = [], []
    for seed in args.seeds:
        path = args.out / f"run-{seed}"
        chosen = override(preset("street").with_features(args.features), args.settings)
        start = time.monotonic()
        run = fit(args.model, args.images, chosen, seed, out=path, resume=True, cache=False)
        seconds = round(time.monotonic() - start, 1)
        target = ImageFolder(args.images, run.model.canvas, run.model.channels)
        truth = read_labels(args.labels, run.model, target, False, args.min_height)
        found = evaluate(run, target, truth, lambda *_: None, num=2000, features=["efficientnet"])
        rows.append({"seed": seed, "seconds": seconds, **row(found)})
        histograms.append(cars(found))
        print(json.dumps(rows[-1]), flush=True)
        write_json(args.out / "results.json", rows)
        picture(histograms, args.out / "cars.png")


if __name__ == "__main__":
    main()
