"""What a model that was begun from a few labelled photographs is worth to a detector.

    python benchmarks/begin_detector.py --photographs FOLDER [--out FOLDER] [--labelled 20] [--draws 5] [--seeds 1]
        [--sets alone begun then mixed learnt learnt_then] [--workers 2]

FOLDER is a labelled set of COCO: annotations.json and images/. A quarter of its photographs, with all their near
duplicates, is held out for tests. Of the others, some are drawn at random as the labelled ones, several times; from
each draw a model is begun, and scenes of its prior are generated. A trial then trains one detector each on

    alone         the labelled photographs alone
    begun         the scenes alone
    then          the scenes, then the photographs
    mixed         both in turn, half of the images shown each
    learnt        scenes of the model as fitted to all photographs but the held-out ones, with the labels of the few
    learnt_then   these scenes, then the photographs

each with several seeds. Printed are the average precisions at an overlap of 0.5 of each draw; in the mean over draws,
what each has more than ``alone``, and learnt scenes more than those of the prior. These have two 95 % intervals:
Student's t over the draws, which share the held-out photographs; and a bootstrap over held-out photographs, draws and,
within a draw, seeds. With learnt scenes, the total variation of each class's counts from those of the held-out
photographs is printed, too: of scenes of the prior and of the fit, of the few labelled photographs, and of as many as
are held out, drawn anew. Photographs are near duplicates where their pixels, at 32 x 32, correlate by more than 0.95.
"""

import argparse
import json
from pathlib import Path

import cv2
import numpy as np
from given import needed, out_option
from learn_labelled import apart, floor
from safetensors.numpy import load_file
from scipy.stats import t as student

from probscene.app.api.calls import generate
from probscene.app.api.fit import fit
from probscene.app.cut_paste.begin import begin
from probscene.app.datasets.generate import DatasetOptions, generate_scenes
from probscene.app.files import write_json
from probscene.app.loading import load_model
from probscene.app.memory import tune_malloc
from probscene.app.trial.bootstrap import draw as drawn
from probscene.app.trial.bootstrap import estimate
from probscene.app.trial.results import MEAN, precisions
from probscene.app.trial.scoring import MAIN
from probscene.app.trial.sets import LabelledSet
from probscene.app.trial.training import Detections
from probscene.app.trial.trial import TrialOptions, read_labelled, trial
from probscene.decoding import read_rgb

MIN_CORRELATION, SIDE = 0.95, 32  # of near duplicates; pixels
WITHOUT_FIT = "alone", "begun", "then", "mixed"
SETS = *WITHOUT_FIT, "learnt", "learnt_then"
DATASET = DatasetOptions(min_visible=0.2)
RESAMPLES = 1000


def groups_of(files: list[Path]) -> np.ndarray:
    """``(L,)`` the number of the group of near duplicates that each photograph is in."""
    small = np.stack([cv2.resize(read_rgb(f).mean(2), (SIDE, SIDE), interpolation=cv2.INTER_AREA) for f in files])
    flat = small.reshape(len(files), -1) - small.mean((1, 2))[:, None]
    flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-9)
    is_near, group = flat @ flat.T > MIN_CORRELATION, np.arange(len(files))
    for _ in files:
        spread = np.where(is_near, group, len(files)).min(1)
        if (spread == group).all():
            break
        group = spread
    return group


def split(files: list[Path], share: float, rng: np.random.Generator) -> tuple[list[str], list[str]]:
    """The names of photographs to train on and of those to test on, without endings."""
    group, test = groups_of(files), set()
    for number in rng.permutation(np.unique(group)):
        if len(test) >= share * len(files):
            break
        test |= set(np.flatnonzero(group == number).tolist())
    names = [file.stem for file in files]
    return [n for i, n in enumerate(names) if i not in test], [n for i, n in enumerate(names) if i in test]


def begun_set(args: argparse.Namespace, names: list[str], out: Path, seed: int) -> Path:
    """Scenes of a model that is begun from some photographs."""
    if not (out / "model").is_dir():
        whole = json.loads((args.photographs / "annotations.json").read_text())
        images = [image for image in whole["images"] if Path(image["file_name"]).stem in names]
        ids = {image["id"] for image in images}
        some = [one for one in whole["annotations"] if one["image_id"] in ids]
        out.mkdir(parents=True, exist_ok=True)
        write_json(out / "labels.json", {**whole, "images": images, "annotations": some})
        begin(args.photographs / "images", out / "labels.json", out / "model")
    model = load_model(str(out / "model" / "model.py"))
    generate_scenes(model, model.prior, args.scenes, out / "set", seed, "coco", options=DATASET)
    return out / "set"


def learnt_set(args: argparse.Namespace, pool: list[str], out: Path, seed: int) -> Path:
    """Scenes of the begun model, as fitted to the photographs of the pool with the labels that it was begun from."""
    photographs = [file for file in sorted((args.photographs / "images").iterdir()) if file.stem in pool]
    labels, model = out / "labels.json", str(out / "model" / "model.py")
    run = fit(model, photographs, out=out / "run", seed=seed, labels=labels, resume=True)
    generate(run, args.scenes, out / "learnt", options=DATASET, seed=seed)
    return out / "learnt"


def read(path: Path | str) -> LabelledSet:
    """A labelled set; nothing is said of it."""
    return read_labelled(Path(path), None, lambda *_: None)


def count_distances(test: str, sets: dict[str, Path | str]) -> dict[str, dict[str, float]]:
    """Of each class, the total variation of a set's counts from those of the photographs to test on."""
    counts = {}
    for name, path in {"test": test, **sets}.items():
        one = read(path)
        counts[name] = {c: np.array([(e.classes == i).sum() for e in one.examples]) for i, c in enumerate(one.classes)}
    truth = counts.pop("test")
    return {
        c: {name: apart(of[c], true)[0] for name, of in counts.items()} | {"floor": floor(true)[0]}
        for c, true in truth.items()
    }


def measured(args: argparse.Namespace, draw: int, pool: list[str], test: Path) -> dict[str, dict[str, float]]:
    """The precisions of a draw's rows, of each class and of their mean, over seeds."""
    out = args.out / f"draw-{draw}"
    names = sorted(np.random.default_rng([args.seed, 1, draw]).choice(pool, args.labelled, replace=False).tolist())
    made = begun_set(args, names, out, draw)
    (out / "labelled.txt").write_text("\n".join(names) + "\n")
    few, held_out = (f"{args.photographs}@{listed}" for listed in (out / "labelled.txt", test))
    sets = {"alone": "real", "begun": f"{made}", "then": f"{made},real", "mixed": f"{made}+real"}
    if {"learnt", "learnt_then"} & {*args.sets}:
        learnt = learnt_set(args, pool, out, draw)
        sets |= {"learnt": f"{learnt}", "learnt_then": f"{learnt},real"}
        print(draw, json.dumps(count_distances(held_out, {"prior": made, "few": few, "learnt": learnt})), flush=True)
    sets = {name: sets[name] for name in args.sets}
    options = TrialOptions(real=few, numbers=[], seeds=args.seeds, seed=draw)
    found = trial(Path(held_out), out / "trial", sets, options, workers=args.workers).record()
    return {
        name: {of: one["value"] for of, one in row["precision"]["AP50"].items()} for name, row in found["rows"].items()
    }


def resampled(args: argparse.Namespace, test: Path, name: str) -> np.ndarray:
    """``(1 + B,)`` the mean precision of a set over draws and seeds, then its resamples, the same for all sets."""
    tested = read(f"{args.photographs}@{test}")
    draws = drawn(len(tested.examples), args.draws, RESAMPLES, args.seed)
    total = np.zeros(1 + RESAMPLES)
    for number in range(args.draws):
        files = [
            args.out / f"draw-{number}" / "trial" / "trainings" / f"{name}-{s}.safetensors" for s in range(args.seeds)
        ]
        each = precisions(tested, [detections(file, len(tested.examples)) for file in files], draws)
        (of_mean,) = (values for (of, measure), values in each.items() if of == MEAN and measure in MAIN)
        seeds = drawn(1, args.seeds, RESAMPLES, args.seed + 1 + number).seeds  # (1 + B, S)
        weight = draws.seeds[:, number] / draws.seeds.sum(1)
        total += weight * (of_mean.T * seeds).sum(1) / seeds.sum(1)
    return total


def gain(args: argparse.Namespace, each: list[dict[str, dict[str, float]]], name: str, base: str) -> str:
    """What one set has more than another one in the mean of the draws, in words."""
    more = 100 * np.array([rows[name]["mean"] - rows[base]["mean"] for rows in each])
    line = f"{name}: {more.mean():+.1f} points over {base}"
    if len(more) > 1:
        half = student.ppf(0.975, len(more) - 1) * more.std(ddof=1) / len(more) ** 0.5
        line += f" ({more.mean() - half:+.1f} to {more.mean() + half:+.1f}, t over draws)"
    one, other = (resampled(args, args.out / "test.txt", some) for some in (name, base))
    over = estimate(100 * (one - other))
    return line + f" ({over.low:+.1f} to {over.high:+.1f}, bootstrap over photographs, draws and seeds)"


def detections(file: Path, images: int) -> list[Detections]:
    """What a training's detector found, by test image."""
    found = load_file(file)
    rows = [found["images"] == i for i in range(images)]
    return [Detections(*(found[key][row] for key in ("boxes", "classes", "scores"))) for row in rows]


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    out_option(parser, __file__)
    parser.add_argument("--photographs", type=Path, help="a labelled set of COCO")
    parser.add_argument("--labelled", type=int, default=20)
    parser.add_argument("--draws", type=int, default=5)
    parser.add_argument("--scenes", type=int, default=600)
    parser.add_argument("--seeds", type=int, default=1, help="trainings of each set and draw")
    parser.add_argument("--sets", nargs="+", default=WITHOUT_FIT, choices=SETS)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=1)
    args = parser.parse_args()
    if args.sets[0] != "alone":
        parser.error("expected --sets to begin with alone, which the others are compared with")
    tune_malloc()
    args.photographs = needed(args.photographs, "a labelled set of photographs by --photographs FOLDER")
    files = sorted((args.photographs / "images").iterdir())
    pool, test = split(files, 0.25, np.random.default_rng([args.seed, 0]))
    args.out.mkdir(parents=True, exist_ok=True)
    (args.out / "test.txt").write_text("\n".join(test) + "\n")
    print(f"{len(pool)} photographs to draw from, {len(test)} to test on", flush=True)
    each = []
    for draw in range(args.draws):
        each.append(measured(args, draw, pool, args.out / "test.txt"))
        print(draw, json.dumps(each[-1]), flush=True)
        write_json(args.out / "results.json", each)
    for name, base in [*((name, "alone") for name in args.sets[1:]), ("learnt", "begun"), ("learnt_then", "then")]:
        if {name, base} <= {*args.sets}:
            print(gain(args, each, name, base), flush=True)


if __name__ == "__main__":
    main()
