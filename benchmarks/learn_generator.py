"""Whether a fit learns structure through a generator, Panda3D or Blender, by images alone.

    python benchmarks/learn_generator.py [--out FOLDER] [--example panda3d] [--seeds 0] [--images 2000]
        [--preset quick] [--features count=efficientnet] [--set key=value]

Each seed has a target of its own, drawn to a folder by ``generate``, in processes of its own: pallets with hidden
structures and the same looks, or a table with hidden structures that another Blender script draws with other materials
and light. The fit sees the folder alone. Printed are total variations from 20,000 structures of the truth of the number
of each class, and of what stands on the first and on each other pallet; for the prior, the start, what was learnt, and
a second sample of the truth as large as the target, the floor. Then the seconds of each stage, and how many images were
drawn at most.
"""

import argparse
import json
from pathlib import Path

import numpy as np
from given import command, out_option

from probscene.app.api.fit import fit
from probscene.app.datasets.generate import generate_scenes
from probscene.app.files import write_json
from probscene.app.fitting.config import configuration
from probscene.app.fitting.pipeline import Execution
from probscene.app.fitting.presets import preset
from probscene.app.fitting.store import timing
from probscene.app.loading import load_model
from probscene.derive import derive_complete
from probscene.inference.statistics.count_metrics import histogram, total_variation
from probscene.model import SceneModel
from probscene.policy import Policy
from probscene.relations import per_parent
from probscene.sampling import seed_everything

EXAMPLES = Path(__file__).parents[1] / "examples" / "generators"
MODELS = {"panda3d": EXAMPLES / "panda3d" / "pallets.py", "blender": EXAMPLES / "blender" / "table.py"}
STRUCTURES = 20_000


def structures(model: SceneModel, policy: Policy, number: int, seed: int) -> dict[str, np.ndarray]:
    """Histograms of a policy's structures: how many there are of each class; and on pallets, by their order."""
    seed_everything(seed)
    derivation, _ = derive_complete(model.grammar, policy, number, model.max_steps)
    counts = derivation.counts(len(model.grammar.kinds))
    each = {name: histogram(counts[:, model.grammar.kind(name)]) for name in model.classes}
    if model.groups is None:
        return each
    group = model.grammar.kind(model.groups.kind)
    others = [name for name in model.classes if name != model.groups.kind]
    found = [per_parent(derivation, group, model.grammar.kind(name)) for name in others]
    inside, first = sum(some.count for some in found), found[0].rank == 0
    return {**each, "on the first": histogram(inside[first]), "on others": histogram(inside[~first])}


def apart(one: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> dict[str, float]:
    """Total variations, and their mean."""
    each = {name: float(total_variation(one[name], other[name])) for name in one}
    return {**each, "mean": float(np.mean(list(each.values())))}


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    out_option(parser, __file__)
    parser.add_argument("--example", choices=MODELS, default="panda3d")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--images", type=int, default=2000)
    parser.add_argument("--preset", default="quick")
    parser.add_argument("--features", help="as of probscene fit")
    parser.add_argument("--set", action="append", default=[], dest="settings", help="as of probscene fit")
    args = parser.parse_args()
    file, rows = str(MODELS[args.example]), []
    model = load_model(file)
    for seed in args.seeds:
        truth = model.target(seed)
        folder = args.out / f"target-{args.example}-{seed}"
        generate_scenes(truth, truth.prior, args.images, folder, seed=1000 + seed, format="images")
        config = configuration(preset(args.preset), args.features, parameters="none", settings=args.settings)
        path = args.out / f"run-{args.example}-{args.preset}-{seed}"
        execution = Execution(cache=args.out / "cache")
        run = fit(file, folder / "images", config, out=path, seed=seed, resume=True, execution=execution)
        expected = structures(model, truth.prior, STRUCTURES, 99)
        sources = {"prior": model.prior, "start": model.pretraining_policy, "learnt": run.guide}
        row = {name: apart(structures(model, policy, STRUCTURES, 98), expected) for name, policy in sources.items()}
        row["floor"] = apart(structures(model, truth.prior, args.images, 97), expected)
        rows.append({"seed": seed, **row, "seconds": timing(run), "images": run.config.images})
        print(json.dumps(rows[-1]), flush=True)
        write_json(args.out / "results.json", {"command": command(__file__), "rows": rows})


if __name__ == "__main__":
    main()
