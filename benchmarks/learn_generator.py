"""Whether a fit learns structure through a generator: pallets that Panda3D draws, by images alone.

    python benchmarks/learn_generator.py [--out FOLDER] [--seeds 0 1 2] [--images 2000] [--preset quick]
        [--set key=value]

Each seed has a target of its own: the example's model with hidden structures and the same looks, drawn to a folder by
``generate``, in processes of its own. The fit sees the folder alone. Printed are total variations from 20,000
structures of the truth: of the number of pallets, of what stands on the first and on each other pallet, and of the
number of drums in a scene; for the prior, the start, what was learnt, and a second sample of the truth as large as the
target, the floor. Then the seconds of each stage, and how many images were drawn at most.
"""

import argparse
import json
from pathlib import Path

import numpy as np
from given import command, out_option

from probscene.app.api.fit import fit
from probscene.app.datasets.generate import generate_scenes
from probscene.app.files import write_json
from probscene.app.fitting.overrides import override
from probscene.app.fitting.preset import STRUCTURE
from probscene.app.fitting.presets import preset
from probscene.app.fitting.session import timing
from probscene.app.loading import load_model
from probscene.derive import derive_complete
from probscene.inference.judging.metrics import histogram, total_variation
from probscene.model import SceneModel
from probscene.policy import Policy
from probscene.relations import per_parent
from probscene.sampling import seed_everything

MODEL = Path(__file__).parents[1] / "examples" / "generators" / "panda3d" / "pallets.py"
STRUCTURES = 20_000


def structures(model: SceneModel, policy: Policy, number: int, seed: int) -> dict[str, np.ndarray]:
    """Histograms of a policy's structures."""
    seed_everything(seed)
    derivation, _ = derive_complete(model.grammar, policy, number, model.max_steps)
    counts = derivation.counts(len(model.grammar.kinds))
    pallet, crate, drum = (model.grammar.kind(name) for name in ("pallet", "crate", "drum"))
    on, drums = (per_parent(derivation, pallet, good) for good in (crate, drum))
    goods = on.count + drums.count
    return {
        "pallets": histogram(counts[:, pallet]),
        "first": histogram(goods[on.rank == 0]),
        "others": histogram(goods[on.rank > 0]),
        "drums": histogram(counts[:, drum]),
    }


def apart(one: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> dict[str, float]:
    """Total variations, and their mean."""
    each = {name: float(total_variation(one[name], other[name])) for name in one}
    return {**each, "mean": float(np.mean(list(each.values())))}


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    out_option(parser, __file__)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--images", type=int, default=2000)
    parser.add_argument("--preset", default="quick")
    parser.add_argument("--set", action="append", default=[], dest="settings", help="as of probscene fit")
    args = parser.parse_args()
    model, rows = load_model(str(MODEL)), []
    for seed in args.seeds:
        truth = model.target(seed)
        folder = args.out / f"target-{seed}"
        generate_scenes(truth, truth.prior, args.images, folder, seed=1000 + seed, format="images")
        chosen = override(preset(args.preset), [f"learn={STRUCTURE}", *args.settings])
        path = args.out / f"run-{args.preset}-{seed}"
        run = fit(str(MODEL), folder / "images", chosen, seed, out=path, resume=True, cache=args.out / "cache")
        expected = structures(model, truth.prior, STRUCTURES, 99)
        sources = {"prior": model.prior, "start": model.pretraining_policy, "learnt": run.guide}
        row = {name: apart(structures(model, policy, STRUCTURES, 98), expected) for name, policy in sources.items()}
        row["floor"] = apart(structures(model, truth.prior, args.images, 97), expected)
        rows.append({"seed": seed, **row, "seconds": timing(run), "images": run.preset.images})
        print(json.dumps(rows[-1]), flush=True)
        write_json(args.out / "results.json", {"command": command(__file__), "rows": rows})


if __name__ == "__main__":
    main()
