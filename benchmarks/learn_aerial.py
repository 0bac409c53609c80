"""Whether a fit learns structure that depends on context, on Aerial 2D, and what the baselines learn in the same time.

    python benchmarks/learn_aerial.py [--out FOLDER] [--presets quick] [--fits lstm pcfg] [--seeds 0]

The target's images are drawn by the model's own target program with its own sprites, as in the paper: well spaced cars,
nine on the first road and three on the others, in the mean. Each seed has a target of its own, and fits see the folder
alone. Printed is the total variation of 20,000 learnt structures from the distributions that the target was drawn from,
the mean numbers of cars, and log q of 5,000 structures that no image shows, in nats a scene: its bound is the target's
own log p. Beside them are the prior, the start, and the floor: as many structures of the target as it has images. The
fits of one preset and seed share their feature network, whose training counts as the first one's time.
"""

import argparse
import json
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from given import out_option
from torch import Tensor

from probscene.app.api.fit import fit
from probscene.app.datasets.generate import generate_scenes
from probscene.app.files import write_json
from probscene.app.fitting.config import FitConfig
from probscene.app.fitting.pipeline import Execution
from probscene.app.fitting.presets import DEFAULT, PAPER_AERIAL, QUICK
from probscene.app.fitting.store import timing
from probscene.derive import derive_complete
from probscene.inference.statistics.count_metrics import total_variation
from probscene.models.aerial2d import GRAMMAR, MODEL, TARGET, poisson
from probscene.policy import Policy
from probscene.relations import per_parent
from probscene.sampling import seed_everything
from probscene.structure import StructurePrior, counts, ranked

PRESETS = {"quick": QUICK, "default": DEFAULT, "paper": PAPER_AERIAL}
FITS = ("lstm", "pcfg", "grammar-vae", "mmd", "witness", "js")
COLUMNS = ("roads", "first", "others", "mean_first", "mean_others", "log_q")


def chosen(preset: str, fit: str) -> FitConfig:
    """The preset with another guide or divergence, for structure alone."""
    base = PRESETS[preset].set("parameters=none")
    if fit in ("lstm", "pcfg", "grammar-vae"):
        return base.with_guide(fit)
    return base.with_divergence(fit)


class Truth(NamedTuple):
    """What structures are drawn from: P(0, 1, ... roads), and mean cars on the first road and on each other."""

    roads: tuple[float, ...] = (0, 0.05, 0.15, 0.4, 0.4)
    first: float = 9.0
    others: float = 3.0

    @property
    def policy(self) -> StructurePrior:
        return StructurePrior(
            GRAMMAR, Roads=counts(*self.roads), Cars=ranked(poisson(self.first), poisson(self.others))
        )


def shares(mean: float) -> np.ndarray:
    """Cars on a road, cut where it is full."""
    probs = np.array(poisson(mean).probs)
    return probs / probs.sum()


def judged(policy: Policy, truth: Truth, num: int = 20_000) -> dict[str, float]:
    """How far ``num`` structures of a policy are from the target's distributions."""
    seed_everything(99)
    derivation, _ = derive_complete(GRAMMAR, policy, num, MODEL.max_steps)
    found = per_parent(derivation, GRAMMAR.kind("road"), GRAMMAR.kind("car"))
    first, others = found.count[found.rank == 0], found.count[found.rank > 0]
    roads = derivation.counts(len(GRAMMAR.kinds))[:, GRAMMAR.kind("road")]
    held_out, _ = derive_complete(GRAMMAR, truth.policy, 5_000, MODEL.max_steps)
    with torch.no_grad():
        log_q = policy.log_prob(held_out).mean().item()

    def apart(found: Tensor, expected: np.ndarray) -> float:
        return total_variation(np.bincount(found.numpy()) / len(found), expected)

    return {
        "roads": apart(roads, np.array(truth.roads)),
        "first": apart(first, shares(truth.first)),
        "others": apart(others, shares(truth.others)),
        "mean_first": first.double().mean().item(),
        "mean_others": others.double().mean().item(),
        "log_q": log_q,
    }


def show(table: dict[str, list[dict]]) -> None:
    """Print a line for each name: the mean and range of each column over its rows."""
    print(f"\n{'':22}" + "".join(f"{column:>26}" for column in COLUMNS))
    for name, rows in table.items():
        cells = []
        for column in COLUMNS:
            each = [row[column] for row in rows]
            cells.append(f"{np.mean(each):7.3f} {min(each):6.3f}..{max(each):6.3f}")
        print(f"{name:22}" + "".join(f"{cell:>26}" for cell in cells))


def fit_images(preset: str, name: str, seed: int, out: Path) -> tuple[Policy, dict[str, float]]:
    """A fit from images, resumed if it was begun."""
    images, path = out / f"target-{seed}" / "images", out / f"{preset}-{name}-{seed}"
    execution = Execution(cache=out / "cache")
    run = fit("aerial2d", images, chosen(preset, name), out=path, seed=seed, resume=True, execution=execution)
    return run.guide, timing(run)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    out_option(parser, __file__)
    parser.add_argument("--presets", nargs="+", choices=PRESETS, default=["quick"])
    parser.add_argument("--fits", nargs="+", choices=FITS, default=["lstm", "pcfg"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--images", type=int, default=5000)
    args = parser.parse_args()
    rows = [
        {"fit": "prior", **judged(MODEL.prior, Truth())},
        {"fit": "start", **judged(MODEL.pretraining_policy, Truth())},
        {"fit": "floor", **judged(TARGET, Truth(), args.images)},
    ]
    for seed in args.seeds:
        target = MODEL.target(0)
        images = args.out / f"target-{seed}"
        generate_scenes(target, target.prior, args.images, images, seed=1000 + seed, format="images")
        for preset in args.presets:
            for name in args.fits:
                guide, took = fit_images(preset, name, seed, args.out)
                rows.append({"preset": preset, "fit": name, "seed": seed, **judged(guide, Truth()), "seconds": took})
                print(json.dumps(rows[-1]), flush=True)
                write_json(args.out / "results.json", rows)
    table: dict[str, list[dict]] = {}
    for row in rows:
        table.setdefault(f"{row.get('preset', ''):8}{row['fit']}", []).append(row)
    show(table)


if __name__ == "__main__":
    main()
