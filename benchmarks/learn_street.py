"""Whether a fit to real street frames comes closer to them than the prior: numbers of cars, FID and KID, looks.

    python benchmarks/learn_street.py FRAMES/ LABELS [--out FOLDER] [--seeds 0] [--min-height 25]
        [--model driving] [--learn structure,parameters] [--all COUNTS.csv]

Fits see the images alone. ``LABELS`` is KITTI's ``label_2``, or a CSV of counts, of the same images. Cars of scenes are
counted as the labels count them, of 2,000 rendered scenes (``probscene evaluate``). Printed for each seed: total
variation and Wasserstein-1 of the number of cars from the labels', each for the prior, the start and what was learnt;
as ``read`` how what is read of cars goes with the labels: in all frames, and, of KITTI's, in those of which regions
marked DontCare, whose objects have no labels, cover less than 1 % and in the others; as ``structures`` how many objects
of each class their scenes have, seen or not. Of 500 images of each source, drawn with one seed, follow as ``apart`` KID
and FID from all frames in EfficientNet's features, and as ``looks``, with the frames', what a photographer would say:
how bright they are, their contrast, saturation and noise, and the row of the horizon, each the mean with the interval
of 95 % of bootstraps over images. Where parameters are learnt, too, so do these of learnt structures with the prior's
parameters, as ``structure``. ``--all`` names a CSV with a column ``Car_ge25px``, the cars of 25 pixels and more in all
of KITTI's label files: how far each source, and the labels of the frames, are from these follows as ``all``. FOLDER
holds the runs, ``results.json``, a histogram, ``cars.png``, and for each seed the paper's grid of images, prior,
learnt and real from the left, ``images-SEED.png``.

The rows of the paper's tables 1 and 2: the prior's figures are in every run; ``--learn parameters`` keeps the prior's
structure and learns parameters (row 2 of table 1); ``--learn structure`` and ``structure,parameters`` are the others.
The simple prior (table 2) is the model ``driving_simple``, the tuned one (table 1) ``driving``.
"""

import argparse
import csv
import json
import math
import time
from copy import copy
from pathlib import Path

import cv2
import matplotlib
import numpy as np
import torch
from given import needed, out_option
from learn_parameters import drawn
from read_photographs import correlation
from torch import Tensor

from probscene.app.api.fit import fit
from probscene.app.evaluation.evaluate import Evaluation, evaluate
from probscene.app.evaluation.labels import Labels, read_labels
from probscene.app.evaluation.sources import LEARNT, SAMPLED_SOURCES, baseline_policies
from probscene.app.evaluation.structure_counts import sample_counts
from probscene.app.files import write_json
from probscene.app.fitting.config import BOTH, STRUCTURE
from probscene.app.fitting.pipeline import Execution
from probscene.app.fitting.presets import preset
from probscene.app.fitting.run import RunFolder
from probscene.app.labels.kitti import DONT_CARE, read_objects
from probscene.app.memory import tune_malloc
from probscene.dataset import ImageFolder
from probscene.inference.features.pretrained import EfficientNetLite
from probscene.inference.statistics.count_metrics import histogram, total_variation, wasserstein
from probscene.inference.statistics.image_metrics import fid, kid

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.ticker import MaxNLocator

DRAWN, RESAMPLES, SMOOTH = 500, 1000, 5  # images of a source; bootstraps; rows
PARAMETERS = "parameters"
SETTINGS = {
    STRUCTURE: ["parameters=none"],
    BOTH: ["parameters=any"],
    PARAMETERS: ["parameters=any", "structure.batches=0", "refine.batches=0", "pretrain.on_prior=true"],
}
GRID, GRID_WIDTH = (4, 2), 420  # rows and columns of a source's images; pixels of one
MARKED, SCENES = 0.01, 2000  # of a frame; of which objects are counted


def cars(found: Evaluation) -> dict[str, np.ndarray]:
    """The histogram of the number of cars by source."""
    column = found.classes.index("car")
    return {name: histogram(source.counts[:, column]) for name, source in found.sources.items()}


def row(found: Evaluation) -> dict:
    """How far prior, start and learnt are from the labels."""
    each = cars(found)
    out = {"truth": {"mean": round(float(np.dot(np.arange(len(each["truth"])), each["truth"])), 2)}}
    for name in (name for name in each if name in SAMPLED_SOURCES):
        out[name] = {
            "mean": round(float(np.dot(np.arange(len(each[name])), each[name])), 2),
            "total_variation": round(float(total_variation(each[name], each["truth"])), 3),
            "wasserstein": round(float(wasserstein(each[name], each["truth"])), 3),
        }
    return out


def from_all(found: Evaluation, counts: Path) -> dict:
    """How far each source, and the frames' labels, are from the labels of many more frames."""
    with counts.open(encoding="utf-8") as file:
        every = histogram(torch.tensor([int(line["Car_ge25px"]) for line in csv.DictReader(file)]))
    return {
        name: {
            "total_variation": round(float(total_variation(each, every)), 3),
            "wasserstein": round(float(wasserstein(each, every)), 3),
        }
        for name, each in cars(found).items()
        if name in (*SAMPLED_SOURCES, "truth")
    }


def reading(run: RunFolder, frames: ImageFolder, labels: Path, truth: Labels) -> dict[str, list[float]]:
    """The correlation of what is read of cars with the labels, and in how many frames."""
    net = run.network()
    assert net is not None and truth.classes is not None
    read = net.embed(frames.subset(len(frames))).numpy()[:, net.names.index("car")]
    true = truth.structures.counts[:, truth.classes.index("car")]
    which = {"all": np.full(len(frames), True)}
    if labels.is_dir():
        found = [read_objects(labels / f"{path.stem}.txt") for path in frames.paths]
        covered = np.array([
            sum((one.right - one.left) * (one.bottom - one.top) for one in objects if one.name == DONT_CARE)
            for objects in found
        ])  # fmt: skip
        marked = covered >= MARKED * np.prod(frames.sizes, 1)
        which |= {"labelled": ~marked, "marked": marked}
    each = {name: (correlation(read[some], true[some]), some.sum()) for name, some in which.items() if some.any()}
    return {name: [round(r, 3), int(number)] for name, (r, number) in each.items()}


def structures(run: RunFolder) -> dict[str, dict[str, float]]:
    """How many objects of each class scenes of each source have in the mean."""
    means = {
        name: sample_counts(run.model, policy, SCENES, 0).counts.mean(0).round(2).tolist()
        for name, policy in {**baseline_policies(run.model), LEARNT: run.guide}.items()
    }
    return {name: dict(zip(run.model.classes, each, strict=True)) for name, each in means.items()}


def said(images: Tensor) -> dict[str, list[float]]:
    """Mean and interval of what is said of ``(N, 3, H, W)`` uint8 images, all in 0..1: brightness and contrast, the
    mean and deviation of grey; saturation; noise, by the Laplacian [1]; and the horizon, the row at which the image
    darkens most from above to below.

    References:
        [1] Immerkær, *Fast noise variance estimation*, Computer Vision and Image Understanding 1996.
    """
    x = images.double() / 255
    grey, most = x.mean(1), x.amax(1)
    kernel = torch.tensor([[1.0, -2.0, 1.0], [-2.0, 4.0, -2.0], [1.0, -2.0, 1.0]], dtype=torch.float64)
    rough = torch.nn.functional.conv2d(grey[:, None], kernel[None, None]).abs()
    rows = torch.nn.functional.avg_pool1d(grey.mean(2)[:, None], SMOOTH, 1)[:, 0]
    falls = (rows[:, :-SMOOTH] - rows[:, SMOOTH:]).argmax(1) + SMOOTH
    each = {
        "brightness": grey.mean((1, 2)),
        "contrast": grey.std((1, 2)),
        "saturation": ((most - x.amin(1)) / most.clamp(min=1 / 255)).mean((1, 2)),
        "noise": math.sqrt(math.pi / 2) / 6 * rough.mean((1, 2, 3)),
        "horizon": falls / grey.shape[1],
    }
    rng, found = np.random.default_rng(0), {}
    for name, values in each.items():
        means = values.numpy()[rng.integers(0, len(values), (RESAMPLES, len(values)))].mean(1)
        found[name] = [round(float(number), 4) for number in (values.mean(), *np.quantile(means, (0.025, 0.975)))]
    return found


def looks(run: RunFolder, frames: ImageFolder, num: int, grid: Path) -> dict:
    """What is said of frames and of each source's images, and how far these are from the frames; some as a picture."""
    real = frames.subset(len(frames))
    policies = baseline_policies(run.model)
    if run.parameters:
        policies["structure"] = copy(run.guide)
        policies["structure"].with_parameters = None
    policies[LEARNT] = run.guide
    drawn_of = {name: drawn(run, policy, 1)[1][:num] for name, policy in policies.items()}
    draw_grid([drawn_of["prior"], drawn_of[LEARNT], real], grid)
    look = EfficientNetLite()
    of_frames, apart = look.embed(real), {}
    for name, images in drawn_of.items():
        found = look.embed(images)
        each = kid(of_frames, found, "efficientnet"), fid(of_frames, found, "efficientnet")
        apart[name] = {figure.name: [round(x, 4) for x in (figure.value, figure.low, figure.high)] for figure in each}
    return {"apart": apart, "looks": {"frames": said(real), **{name: said(x) for name, x in drawn_of.items()}}}


def draw_grid(sources: list[Tensor], path: Path) -> None:
    """A few images ``(N, 3, H, W)`` of each source, the sources beside one another."""
    blocks = []
    for images in sources:
        rows, columns = GRID
        some = images[:: max(1, len(images) // (rows * columns))][: rows * columns].permute(0, 2, 3, 1).numpy()
        size = GRID_WIDTH, round(GRID_WIDTH * some.shape[1] / some.shape[2])
        small = [cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in some]
        framed = [cv2.copyMakeBorder(image, 2, 2, 2, 2, cv2.BORDER_CONSTANT, value=(255,) * 3) for image in small]
        block = np.concatenate([np.concatenate(framed[i::rows], 1) for i in range(rows)])
        blocks.append(cv2.copyMakeBorder(block, 0, 0, 0, 16, cv2.BORDER_CONSTANT, value=(255,) * 3))
    cv2.imwrite(str(path), cv2.cvtColor(np.concatenate(blocks, 1), cv2.COLOR_RGB2BGR))


def picture(histograms: list[dict[str, np.ndarray]], path: Path) -> None:
    """The prior, what each seed learnt, and the labels."""
    most = max(len(each) for found in histograms for each in found.values())
    figure, axes = plt.subplots(figsize=(7, 3), layout="constrained")
    axes.bar(range(len(histograms[0]["truth"])), histograms[0]["truth"], color="0.85", width=0.9, label="labels")
    for name, colour in (("prior", "tab:orange"), ("start", "tab:purple")):
        if name in histograms[0]:  # a model whose guides are pretrained on the prior has no start of its own
            axes.plot(histograms[0][name], "o--", color=colour, label=name)
    for i, found in enumerate(histograms):
        axes.plot(found["learnt"], "o-", color="tab:blue", alpha=0.6, label="learnt" if i == 0 else None)
    axes.set(xlabel="cars in an image", ylabel="share of images", xlim=(-0.6, most - 0.4))
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.legend()
    figure.savefig(path, dpi=130)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("images", type=Path, nargs="?")
    parser.add_argument("labels", type=Path, nargs="?")
    out_option(parser, __file__)
    parser.add_argument("--model", default="driving_simple")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--features", default="count=efficientnet", help="as of probscene fit")
    parser.add_argument("--set", action="append", default=[], dest="settings", help="as of probscene fit")
    parser.add_argument("--learn", choices=SETTINGS, default=STRUCTURE)
    parser.add_argument("--min-height", type=float, default=0.0, help="of KITTI's boxes that are counted, pixels")
    parser.add_argument("--all", type=Path, help="a CSV of the number of cars in all of KITTI's label files")
    args = parser.parse_args()
    args.images = needed(args.images, "a folder of street frames, and the file or folder of their labels")
    args.labels = needed(args.labels, "the frames' labels, KITTI's label_2 or a CSV of counts, after their folder")
    tune_malloc()
    rows, histograms = [], []
    for seed in args.seeds:
        path = args.out / f"run-{seed}"
        config = preset("street").with_features(args.features).set(*SETTINGS[args.learn], *args.settings)
        start = time.monotonic()
        run = fit(args.model, args.images, config, out=path, seed=seed, resume=True, execution=Execution(cache=False))
        seconds = round(time.monotonic() - start, 1)
        target = ImageFolder(args.images, run.model.canvas, run.model.channels)
        truth = read_labels(args.labels, run.model, target, False, args.min_height)
        found = evaluate(run, target, truth, lambda *_: None, num=SCENES)
        rows.append({"seed": seed, "seconds": seconds, **row(found)})
        rows[-1] |= {"read": reading(run, target, args.labels, truth), "structures": structures(run)}
        if args.all is not None:
            rows[-1] |= {"all": from_all(found, args.all)}
        if run.parameters:
            rows[-1] |= {"kept": run.parameters["kept"]}
        rows[-1] |= looks(run, target, DRAWN, args.out / f"images-{seed}.png")
        histograms.append(cars(found))
        print(json.dumps(rows[-1]), flush=True)
        write_json(args.out / "results.json", rows)
        picture(histograms, args.out / "cars.png")


if __name__ == "__main__":
    main()
