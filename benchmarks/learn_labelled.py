"""What a few labelled images are worth to a fit: its structures, against the labels of images that had none.

    python benchmarks/learn_labelled.py MODEL IMAGES LABELS [--number 10] [--among PATTERN] [--classes car ...]
        [--preset street] [--learn structure,parameters] [--seeds 0 1 2] [--min-height 25]

Each seed draws ``--number`` of the images at random, fits with their counts, and is judged by the labels of all others.
With ``--among`` the labelled images are drawn from those whose name matches, such as those of one place; the fit then
has these few and all that do not match, by which it is judged. With ``--number 0`` no image has a label. LABELS is a
CSV of counts, COCO's JSON, or KITTI's ``label_2``, of all images. Structure alone is learnt unless said otherwise.

Printed for each class are total variation and Wasserstein-1 from the labels, of the prior, the start, what was learnt,
the histogram of the labelled few alone, and the floor: as many labels drawn anew, the mean of 200 times. FOLDER holds
the runs and ``results.json``.
"""

import argparse
import fnmatch
import json
import time
from pathlib import Path

import numpy as np
from given import command, needed, out_option

import probscene as ps
from probscene.app.api.fit import fit
from probscene.app.evaluation.evaluate import evaluate
from probscene.app.evaluation.labels import Labels, read_labels
from probscene.app.evaluation.sources import SAMPLED_SOURCES
from probscene.app.evaluation.structure_counts import StructureCounts
from probscene.app.files import make_folder, write_json
from probscene.app.fitting.config import BOTH, STRUCTURE, configuration, parameter_choice
from probscene.app.fitting.pipeline import Execution
from probscene.app.fitting.presets import PRESETS, preset
from probscene.app.labels.counts import write_counts
from probscene.app.loading import load_model
from probscene.app.memory import tune_malloc
from probscene.dataset import ImageFolder
from probscene.inference.statistics.count_metrics import histogram, total_variation, wasserstein

SCENES, RESAMPLES = 2000, 200
COUNTS = "count=efficientnet"


def apart(counts: np.ndarray, truth: np.ndarray) -> list[float]:
    """Total variation and Wasserstein-1 of ``(N,)`` and ``(M,)`` counts."""
    one, other = histogram(counts), histogram(truth)
    return [round(float(distance(one, other)), 3) for distance in (total_variation, wasserstein)]


def floor(truth: np.ndarray) -> list[float]:
    """How far labels drawn anew would be, in the mean."""
    rng = np.random.default_rng(0)
    return np.mean([apart(rng.choice(truth, len(truth)), truth) for _ in range(RESAMPLES)], 0).round(3).tolist()


def split(names: list[str], number: int, among: str, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Of the images the rows that are labelled, and those that are judged by."""
    eligible = np.array([fnmatch.fnmatch(name, among) for name in names])
    few = np.sort(np.random.default_rng(seed).choice(np.flatnonzero(eligible), number, replace=False))
    rest = np.ones(len(names), bool) if eligible.all() else ~eligible
    rest[few] = False
    return few, np.flatnonzero(rest)


def main():
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("model", nargs="?")
    parser.add_argument("images", type=Path, nargs="?")
    parser.add_argument("labels", type=Path, nargs="?")
    out_option(parser, __file__)
    parser.add_argument("--number", type=int, default=10, help="of labelled images (%(default)s)")
    parser.add_argument("--among", default="*", help="a pattern of the names that they are drawn from")
    parser.add_argument("--classes", nargs="+", help="all that are labelled where not given")
    parser.add_argument("--preset", choices=tuple(PRESETS), default="quick")
    parser.add_argument("--learn", choices=(STRUCTURE, BOTH), default=STRUCTURE)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--min-height", type=float, default=0.0, help="of boxes that are counted, pixels")
    args = parser.parse_args()
    needed(args.labels, "a model, a folder of images, and their labels")
    tune_malloc()
    model = load_model(args.model)
    folder = ImageFolder(args.images, model.canvas, model.channels)
    every = read_labels(args.labels, model, folder, min_height=args.min_height)
    labelled = [model.classes[c] for c in every.columns(model)]
    classes = tuple(name for name in labelled if name in (args.classes or labelled))
    counts = every.structures.counts[:, [labelled.index(name) for name in classes]]
    names, rows = [path.name for path in folder.paths], []
    for seed in args.seeds:
        few, rest = split(names, args.number, args.among, seed)
        out = make_folder(args.out) / f"few-{seed}.csv"
        write_counts(out, [names[i] for i in few], counts[few], classes)
        seen = [folder.paths[i] for i in sorted({*few, *rest})]
        start = time.monotonic()
        config = configuration(preset(args.preset), COUNTS, parameters=parameter_choice(args.learn, None))
        run = fit(
            args.model,
            seen,
            config,
            out=args.out / f"run-{seed}",
            seed=seed,
            labels=out if args.number else None,
            resume=True,
            execution=Execution(cache=False),
        )
        judged = ImageFolder([folder.paths[i] for i in rest], model.canvas, model.channels)
        truth = Labels(StructureCounts(counts[rest], {}), None, classes, every.notes, every.min_height)
        found = evaluate(run, judged, truth, lambda *_: None, num=SCENES)
        row = {"seed": seed, "labelled": len(few), "judged": len(rest), "seconds": round(time.monotonic() - start)}
        row |= {"unread": list(run.unread), "means": {}, "distances": {}}
        for c, name in enumerate(classes):
            column = found.classes.index(name)
            each = {
                s: source.counts[:, column] for s, source in found.sources.items() if s in (*SAMPLED_SOURCES, "truth")
            }
            row["means"][name] = {s: round(float(x.mean()), 2) for s, x in each.items()}
            row["distances"][name] = {s: apart(x, counts[rest, c]) for s, x in each.items() if s != "truth"}
            if len(few):
                row["distances"][name]["labels alone"] = apart(counts[few, c], counts[rest, c])
            row["distances"][name]["floor"] = floor(counts[rest, c])
        rows.append(row)
        print(json.dumps(row), flush=True)
        write_json(args.out / "results.json", {"command": command(__file__), "version": ps.__version__, "rows": rows})


if __name__ == "__main__":
    main()
