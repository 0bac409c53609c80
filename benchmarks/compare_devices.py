"""Networks on one device beside another: seconds, memory, and whether what comes out agrees.

    python benchmarks/compare_devices.py [--devices cpu cuda] [--out FOLDER] [--tasks digits street heads trial train]

Each task runs in a process of its own on each device, on targets that are drawn here: ``digits`` is a quick fit of
Multi-MNIST, ``street`` trains the count network of the preset for streets (structure is learnt from two batches),
``heads`` those on EfficientNet's maps on Aerial 2D, ``trial`` a detector on 300 of the prior's digits, and ``train``
one that is kept. Printed are seconds of each stage, the process's largest memory, the GPU's, and a figure: of fits the
mean number of objects of the first class in 2,000 structures, of detectors the AP at IoU 0.5 on 200 images.
Two devices round differently, so their figures are no more equal than those of two seeds.
"""

import argparse
import json
import resource
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import torch
from given import out_option

import probscene as ps
from probscene.app.detectors.train import TrainOptions
from probscene.app.files import write_json
from probscene.app.fitting.store import timing
from probscene.app.trial.trial import TrainingBudget, TrialOptions
from probscene.sampling import seed_everything

FITS = {
    "digits": ("multi_mnist", "quick", {}),
    "street": ("driving_simple", "street", {"structure.batches": 2, "parameters": "none"}),
    "heads": ("aerial2d", "quick", {"features": "count=efficientnet", "structure.batches": 2, "parameters": "none"}),
}
TARGET, SHOWN, TESTED = 1000, 300, 200  # images


def fitted(task: str, device: str, out: Path) -> dict[str, Any]:
    """Seconds by stage and a figure."""
    name, chosen, settings = FITS[task]
    model = ps.load_model(name)
    target = out.parent / f"{name}-target"
    ps.generate(model.target(0), TARGET, target, format="images", progress=False)
    execution = ps.Execution(1, cache=False, device=device)
    run = ps.fit(name, target / "images", ps.preset(chosen).set(settings), out=out, execution=execution)
    seed_everything(0)
    kind = model.grammar.kind(model.classes[0])
    counts = ps.sample(run.model, run.guide, 2000).derivation.counts(len(model.grammar.kinds))[:, kind]
    return {"seconds": timing(run), f"{model.classes[0]} an image": float(counts.float().mean())}


def detected(task: str, device: str, out: Path) -> dict[str, Any]:
    """Of a detector of digits."""
    model, sets = ps.load_model("multi_mnist"), out.parent / "digits"
    for name, number, seed in (("train", SHOWN, 0), ("test", TESTED, 1)):
        ps.generate(model, number, sets / name, seed=seed, progress=False)
    budget = TrainingBudget(iterations=300, device=device)
    if task == "trial":
        options = TrialOptions(seeds=1, budget=budget)
        found = ps.trial(sets / "test", out, {"prior": sets / "train"}, options)
        return {"AP": found.precision("prior").value}
    options = TrainOptions(generate=SHOWN, test=sets / "test", budget=budget)
    scores = ps.train(model, None, None, out, options).scores
    return {"AP": scores["precision"]["AP50"]["mean"]["value"] if scores else None}


def measured(task: str, device: str, out: Path) -> dict[str, Any]:
    """The row of a task on a device."""
    began = time.monotonic()
    found = fitted(task, device, out) if task in FITS else detected(task, device, out)
    of_gpu = torch.cuda.max_memory_allocated() / 2**20 if device.startswith("cuda") else 0.0
    return {
        "task": task,
        "device": device,
        "seconds in all": time.monotonic() - began,
        "megabytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "megabytes of the GPU": of_gpu,
        **found,
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    out_option(parser, __file__)
    parser.add_argument("--devices", nargs="+", default=["cpu", "cuda"])
    parser.add_argument("--tasks", nargs="+", choices=(*FITS, "trial", "train"), default=[*FITS, "trial", "train"])
    parser.add_argument("--here", action="store_true", help=argparse.SUPPRESS)  # in this process
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    rows = []
    for task in args.tasks:
        for number, device in enumerate(args.devices):
            out = args.out / f"{task}-{number}-{device.replace(':', '')}"
            if args.here:
                print(json.dumps(measured(task, device, out)))
                continue
            words = [sys.executable, __file__, "--here", "--out", args.out, "--tasks", task, "--devices", device]
            done = subprocess.run([*map(str, words)], stdout=subprocess.PIPE, text=True, check=True)
            rows.append(json.loads(done.stdout.splitlines()[-1]))
            print(json.dumps(rows[-1]), flush=True)
            write_json(args.out / "results.json", rows)


if __name__ == "__main__":
    main()
