"""Whether a fit finds a hidden distribution of street structures from images alone.

    python benchmarks/learn_driving.py [--out FOLDER] [--seeds 0] [--preset street] [--model driving]

Each seed's target is drawn by the driving models themselves with another, random distribution of structures
(``SceneModel.target``); fits see its images. Printed for each seed are total variation and Wasserstein-1 of the number
of objects of each class in a scene, 20,000 structures of the prior, the start and the learnt guide against 20,000 of
the target's, with the interval that holds 95 % of bootstraps over the former, and how long the fit took. The floor is
as many structures of the target as it has images. ``read`` is how the numbers of objects that the features read go with
those that can be seen, by correlation, in the start's scenes and in other ones of the target. FOLDER holds the runs and
``results.json``.
"""

import argparse
import json
import time

import numpy as np
import torch
from given import command, out_option
from torch.nn.functional import one_hot

from probscene.app.api.fit import fit
from probscene.app.datasets.generate import generate_scenes
from probscene.app.evaluation.sources import LEARNT, SAMPLED_SOURCES, START, baseline_policies
from probscene.app.files import write_json
from probscene.app.fitting.pipeline import Execution
from probscene.app.fitting.presets import preset
from probscene.app.fitting.rendered_features import RENDERED_AT_ONCE, RenderedFeatures
from probscene.app.fitting.store import timing
from probscene.app.loading import load_model
from probscene.app.memory import tune_malloc
from probscene.derive import derive_complete
from probscene.inference.features.base import FeatureNet
from probscene.inference.features.counting.training import CountFeatures
from probscene.inference.statistics.count_metrics import bootstrap_interval, histogram, total_variation, wasserstein
from probscene.model import SceneModel
from probscene.policy import Policy
from probscene.sampling import sample, seed_everything

FLOOR = "floor"
TRUTH = 20_000  # structures
READ = 1024  # scenes
RESAMPLES = 200


def counted(model: SceneModel, policy: Policy, num: int = TRUTH) -> np.ndarray:
    """``(num, classes)``, objects of each class in derivations of a policy."""
    seed_everything(99)
    derivation, _ = derive_complete(model.grammar, policy, num, model.max_steps)
    return derivation.counts(len(model.grammar.kinds))[:, [model.grammar.kind(name) for name in model.classes]].numpy()


def apart(counts: np.ndarray, truth: np.ndarray) -> dict[str, list[float]]:
    """Total variation and Wasserstein-1 of counts ``(N,)`` and ``(M,)``, each with its interval."""
    own, true, rng = histogram(counts), histogram(truth), np.random.default_rng(0)
    resampled = rng.multinomial(len(counts), own, RESAMPLES) / len(counts)
    distances = {"total_variation": total_variation, "wasserstein": wasserstein}
    return {
        name: [
            round(x, 4)
            for x in bootstrap_interval(distance(own, true), [distance(each, true) for each in resampled], 0.0)
        ]
        for name, distance in distances.items()
    }


def distances(model: SceneModel, counts: dict[str, np.ndarray], truth: np.ndarray) -> dict[str, dict]:
    """``apart`` of each class, by source, whose counts and the truth's are ``(N, classes)``."""
    return {
        name: {c: apart(found[:, i], truth[:, i]) for i, c in enumerate(model.classes)}
        for name, found in counts.items()
    }


def sampled_anew(model: SceneModel, num: int) -> np.ndarray:
    """``(num, classes)``, of structures of a target that ``counted`` has not drawn: the floor."""
    return counted(model, model.prior, TRUTH + num)[TRUTH:]


def correlations(model: SceneModel, policy: Policy, net: FeatureNet, least: float) -> dict[str, float]:
    """By class, of what the features read in scenes and what is seen there of ``least`` of its silhouette or more."""
    seed_everything(99)
    observer, parts = RenderedFeatures(model, 1), []
    for _ in range(0, READ, RENDERED_AT_ONCE):
        drawn = observer.labelled(sample(model, policy, RENDERED_AT_ONCE))
        label = drawn.label.masked_fill(drawn.visible < least, -1)
        parts.append((one_hot(label + 1, len(model.classes) + 1)[..., 1:].sum(1), net.embed(drawn.image)))
    seen, read = (torch.cat(part).numpy() for part in zip(*parts, strict=True))
    columns = {name: i for i, name in enumerate(net.names)}
    return {
        name: round(float(np.corrcoef(seen[:, c], read[:, columns[name]])[0, 1]), 3)
        for c, name in enumerate(model.classes)
        if name in columns
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    out_option(parser, __file__)
    parser.add_argument("--model", default="driving")
    parser.add_argument("--preset", default="street")
    parser.add_argument("--set", action="append", default=[], dest="settings", help="as of probscene fit")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--images", type=int, default=3000)
    args = parser.parse_args()
    tune_malloc()
    model, rows = load_model(args.model), []
    for seed in args.seeds:
        target = model.target(seed)
        folder = args.out / f"target-{seed}"
        generate_scenes(target, target.prior, args.images, folder, seed=1000 + seed, format="images")
        config = preset(args.preset).set("parameters=none", *args.settings)
        path = args.out / f"run-{seed}"
        began = path.exists()
        start = time.monotonic()
        execution = Execution(cache=args.out / "cache")
        run = fit(args.model, folder / "images", config, out=path, seed=seed, resume=True, execution=execution)
        truth = counted(model, target.prior)
        row = {"seed": seed, "seconds": round(time.monotonic() - start, 1), "stages": timing(run), "resumed": began}
        policies = {**baseline_policies(run.model), LEARNT: run.guide}
        counts = {name: counted(model, policy) for name, policy in policies.items()}
        counts[FLOOR] = sampled_anew(target, args.images)
        row |= distances(model, counts, truth)
        net = run.network()
        if net is not None:
            least = run.features.schedule.min_visible if isinstance(run.features, CountFeatures) else 0.0
            sides = {START: (run.model, run.model.pretraining_policy), "target": (target, target.prior)}
            row["read"] = {name: correlations(*side, net, least) for name, side in sides.items()}
        rows.append(row)
        print(json.dumps(row), flush=True)
        write_json(args.out / "results.json", {"command": command(__file__), "rows": rows})
    for name in (name for name in (*SAMPLED_SOURCES, FLOOR) if name in rows[0]):
        cars = [row[name]["car"]["total_variation"][0] for row in rows]
        print(f"{name:8} cars, total variation: mean {np.mean(cars):.3f}, {min(cars):.3f} to {max(cars):.3f}")


if __name__ == "__main__":
    main()
