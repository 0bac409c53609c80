"""What is read in photographs with a few labels: counts against the labels of the others, in the mean of many draws.

    python benchmarks/read_photographs.py IMAGES LABELS RUN... [--number 10] [--draws 30] [--classes wbc platelet]

RUN are fits of these images whose heads read them (``count=efficientnet``); nothing is fitted here. Each draw labels
``--number`` of the images at random, lets them choose how each class is read as a fit does, and reads all others.
Printed for each run and class are total variation, Wasserstein-1 and correlation with the labels of the others, the
mean of all draws, and the first two of the labelled few's own histogram.
"""

import argparse
import json
from pathlib import Path

import numpy as np
import torch
from given import command, needed, out_option
from learn_labelled import apart

import probscene as ps
from probscene.app.evaluation.labels import read_labels
from probscene.app.files import make_folder, write_json
from probscene.app.fitting.run import RunFolder
from probscene.dataset import ImageFolder
from probscene.inference.features.photographs.net import PretrainedCountNet
from probscene.inference.features.photographs.readability import Read, with_labels
from probscene.inference.features.photographs.reading import by_steps

AT_ONCE = 64


def correlation(one: np.ndarray, other: np.ndarray) -> float:
    """Pearson's; 0 where one of them does not vary."""
    return float(np.corrcoef(one, other)[0, 1]) if one.std() > 0 and other.std() > 0 else 0.0


def drawn(read: Read, c: int, counts: np.ndarray, number: int, seed: int) -> dict:
    """What one draw of labelled images comes to."""
    few = np.random.default_rng(seed).choice(len(counts), number, replace=False)
    rest = np.setdiff1d(np.arange(len(counts)), few)
    found = with_labels(read._replace(labelled=read.photographs[few]), c, torch.from_numpy(counts[few]))
    seen = read.photographs[:, found.scope, list(found.rules), c].quantile(0.5, 1)
    if found.steps:
        seen = by_steps(seen[:, None], torch.tensor([found.steps]))[:, 0]
    seen = seen.round().long().numpy()
    few_alone = apart(counts[few], counts[rest])
    return {
        "read": [*apart(seen[rest], counts[rest]), correlation(seen[rest], counts[rest])],
        "labels alone": few_alone,
    }


def main():
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("images", type=Path, nargs="?")
    parser.add_argument("labels", type=Path, nargs="?")
    parser.add_argument("runs", type=Path, nargs="*")
    out_option(parser, __file__)
    parser.add_argument("--number", type=int, default=10, help="of labelled images (%(default)s)")
    parser.add_argument("--draws", type=int, default=30)
    parser.add_argument("--classes", nargs="+", help="all that are labelled where not given")
    parser.add_argument("--min-height", type=float, default=0.0, help="of boxes that are counted, pixels")
    args = parser.parse_args()
    needed(args.runs[0] if args.runs else None, "images, their labels, and runs that were fitted to them")
    rows = []
    for path in args.runs:
        run = RunFolder.at(path)
        net = run.network()
        if not isinstance(net, PretrainedCountNet):
            parser.error(f"expected runs with features count=efficientnet, got others in {path}")
        folder = ImageFolder(args.images, run.model.canvas, run.model.channels)
        every = read_labels(args.labels, run.model, folder, min_height=args.min_height)
        labelled = [run.model.classes[c] for c in every.columns(run.model)]
        parts = [torch.stack([folder.load(i) for i in range(k, min(k + AT_ONCE, len(folder)))])
                 for k in range(0, len(folder), AT_ONCE)]  # fmt: skip
        whole = torch.cat([net.readings(net.compute_maps(some))[0] for some in parts])
        read = Read(whole, whole[:0], net.apart, net.held_read, net.held_true)
        for name in (name for name in labelled if name in (args.classes or labelled)):
            counts = every.structures.counts[:, labelled.index(name)]
            found = [drawn(read, net.classes.index(name), counts, args.number, seed) for seed in range(args.draws)]
            means = {key: np.mean([one[key] for one in found], 0).round(3).tolist() for key in found[0]}
            rows.append({"run": str(path), "class": name, "images": len(folder), **means})
            print(json.dumps(rows[-1]), flush=True)
    record = {"command": command(__file__), "version": ps.__version__, "rows": rows}
    write_json(make_folder(args.out) / "results.json", record)


if __name__ == "__main__":
    main()
