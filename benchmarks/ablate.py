"""What each part of the method is worth: a fit with one thing changed at a time, on targets with hidden structures.

    python benchmarks/ablate.py [--model multi_mnist] [--preset quick] [--seeds 0] [--only NAME ...] [--workers N]
                                [--images 5000] [--out FOLDER]

Each seed's target is drawn by the model itself with another distribution of structures (``SceneModel.target``), and
fits see its images alone. Figures are of 20,000 learnt structures against 20,000 of the target's: the total variation
of the number of objects of each class, averaged over classes, and log q of 5,000 held-out structures, nats a scene,
with the share of them that the guide cannot derive. Beside the fits are the prior, the start and the floor: as many
structures of the target as it has images. Fits are of one thread each, as many at a time as there are cores.
FOLDER holds the runs, ``results.json``, ``results.csv`` and a figure, ``ablation.png``. An interrupted run goes on.
"""

import argparse
import csv
import json
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import matplotlib
import numpy as np
import torch
from given import command, out_option
from learn_driving import FLOOR, counted, sampled_anew

from probscene.app.api.fit import fit
from probscene.app.datasets.generate import generate_scenes
from probscene.app.evaluation.sources import PRIOR, START, baseline_policies
from probscene.app.files import write_json
from probscene.app.fitting.pipeline import Execution
from probscene.app.fitting.presets import preset
from probscene.app.loading import load_model
from probscene.app.memory import tune_malloc
from probscene.derivation import Derivation
from probscene.derive import derive_complete
from probscene.inference.statistics.count_metrics import histogram, total_variation
from probscene.model import SceneModel
from probscene.policy import Policy
from probscene.sampling import seed_everything
from probscene.threads import cores, use_threads

matplotlib.use("Agg")
import matplotlib.pyplot as plt

AS_IT_IS = "as it is"
HELD_OUT = 5000
COLUMNS = ("variant", "settings", "seed", "total_variation", "log_q", "impossible", "seconds")


class Variant(NamedTuple):
    """A change.

    Attributes:
        settings: of the preset, as of ``probscene fit --set``.
        model: another model, or none.
        ungrouped: counts are of the whole image and not by group.
    """

    settings: tuple[str, ...] = ()
    model: str | None = None
    ungrouped: bool = False


VARIANTS = {
    AS_IT_IS: Variant(),
    "4 latent vectors": Variant(("guide.num_latents=4",)),
    "no index": Variant(("guide.index=false",)),
    "presence features": Variant(("features=presence",)),
    "EfficientNet features": Variant(("features=efficientnet",)),
    "objective js": Variant(("divergence=js",)),
    "objective witness": Variant(("divergence=witness",)),
    "objective mmd": Variant(("divergence=mmd",)),
    "no marginals": Variant(("divergence.marginal_variance=none",)),
    "the paper's bandwidth": Variant(("divergence.variance=none",)),
    "a scene in its own density": Variant(("divergence.leave_one_out=false",)),
    "one drawing a structure": Variant(("structure.draws_per_structure=1",)),
    "one update a batch": Variant(("structure.updates=1",)),
    "moving average as baseline": Variant(("structure.baseline=moving_average",)),
    "guide pcfg": Variant(("guide=pcfg",)),
    "guide grammar-vae": Variant(("guide=grammar-vae",)),
    "pretrained on the prior": Variant(("pretrain.on_prior=true",)),
    "no counts by group": Variant(ungrouped=True),
    "simple prior": Variant(model="driving_simple"),
}


def variants(model: SceneModel, only: list[str]) -> dict[str, Variant]:
    """Those that make a difference to a model: the first, and ``only`` some of the others where any is named."""
    drop = set() if model.groups is not None else {"no counts by group"}
    drop |= set() if model.name == "driving" else {"simple prior"}
    drop |= set() if model.pretraining is not None else {"pretrained on the prior"}
    return {n: v for n, v in VARIANTS.items() if n not in drop and (not only or n in (AS_IT_IS, *only))}


def changed(model: SceneModel, name: str, variant: Variant) -> str | SceneModel:
    """The model of a variant."""
    return replace(model, groups=None) if variant.ungrouped else variant.model or name


def figures(model: SceneModel, policy: Policy, truth: np.ndarray, held_out: Derivation) -> dict[str, float]:
    """How far a policy's structures are from the target's."""
    found = counted(model, policy)
    each = [total_variation(histogram(found[:, i]), histogram(truth[:, i])) for i in range(len(model.classes))]
    with torch.no_grad():
        log_q = policy.log_prob(held_out)
    possible = torch.isfinite(log_q)
    return {
        "total_variation": round(float(np.mean(each)), 4),
        "log_q": round(float(log_q[possible].mean()), 3) if possible.any() else float("nan"),
        "impossible": round(float((~possible).double().mean()), 4),
    }


def of_variant(args, seed: int, truth: np.ndarray, held_out: Derivation, name: str) -> dict:
    """The row of a variant, which is fitted in a process of its own; the others are as of ``figures``."""
    tune_malloc()
    use_threads(1)
    start, variant = time.monotonic(), VARIANTS[name]
    other = changed(load_model(args.model), args.model, variant)
    base = preset(args.preset).set("parameters=none", "fallback_to_prior=false")
    images, path = args.out / f"target-{seed}" / "images", args.out / f"{name.replace(' ', '-')}-{seed}"
    execution = Execution(1, cache=args.out / "cache")
    run = fit(other, images, base.set(*variant.settings), out=path, seed=seed, resume=True, execution=execution)
    took, found = round(time.monotonic() - start, 1), figures(run.model, run.guide, truth, held_out)
    return {"variant": name, "settings": " ".join(variant.settings), "seed": seed, **found, "seconds": took}


def of_seed(args, seed: int) -> list[dict]:
    """The rows of a seed, one for each variant."""
    model = load_model(args.model)
    target, images = model.target(seed), args.out / f"target-{seed}"
    generate_scenes(target, target.prior, args.images, images, seed=1000 + seed, format="images")
    truth = counted(target, target.prior)
    seed_everything(98)
    held_out, _ = derive_complete(target.grammar, target.prior, HELD_OUT, target.max_steps)
    sample = sampled_anew(target, args.images)
    floor = [total_variation(histogram(sample[:, i]), histogram(truth[:, i])) for i in range(len(target.classes))]
    own = figures(target, target.prior, truth, held_out) | {"total_variation": round(float(np.mean(floor)), 4)}
    rows = [{"variant": FLOOR, "settings": "", "seed": seed, **own, "seconds": 0.0}]
    for name, policy in baseline_policies(model).items():
        rows.append(
            {"variant": name, "settings": "", "seed": seed, **figures(model, policy, truth, held_out), "seconds": 0.0}
        )
    with ProcessPoolExecutor(args.workers, get_context("spawn")) as pool:
        _, *others = variants(model, args.only)
        fitted = partial(of_variant, args, seed, truth, held_out)
        first = pool.submit(fitted, AS_IT_IS).result()  # alone: its network is most others', too
        for row in (first, *pool.map(fitted, others)):
            print(json.dumps(row), flush=True)
            rows.append(row)
    return rows


def picture(rows: list[dict], path: Path) -> None:
    """Mean and range over the seeds, a line for each variant."""
    names = list(dict.fromkeys(row["variant"] for row in rows))
    plt.figure(figsize=(7, 0.3 * len(names) + 1))
    for i, name in enumerate(names):
        each = [row["total_variation"] for row in rows if row["variant"] == name]
        colour = "tab:grey" if name in (FLOOR, PRIOR, START) else "tab:blue"
        plt.plot([min(each), max(each)], [i, i], color=colour)
        plt.plot(np.mean(each), i, "o", color=colour)
    plt.yticks(range(len(names)), names)
    plt.gca().invert_yaxis()
    plt.xlim(left=0)
    plt.grid(axis="x", alpha=0.3)
    plt.xlabel("total variation of the number of objects, mean of the classes")
    plt.tight_layout()
    plt.savefig(path, dpi=120)
    plt.close()


def main():
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    out_option(parser, __file__)
    parser.add_argument("--model", default="multi_mnist")
    parser.add_argument("--preset", default="quick")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--images", type=int, default=5000)
    parser.add_argument("--only", nargs="*", default=[], choices=VARIANTS, help="of the variants")
    parser.add_argument("--workers", type=int, default=cores(), help="fits at a time (%(default)s)")
    args = parser.parse_args()
    args.out /= args.model
    tune_malloc()
    rows = []
    for seed in args.seeds:
        rows += of_seed(args, seed)
        write_json(args.out / "results.json", {"command": command(__file__), "rows": rows})
        with (args.out / "results.csv").open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, COLUMNS)
            writer.writeheader()
            writer.writerows(rows)
        picture(rows, args.out / "ablation.png")


if __name__ == "__main__":
    main()
