"""How close a site of a user's own model comes to the truth, learnt from images of another program.

    python benchmarks/learn_tabletop.py [--out FOLDER] [--seeds 0] [--images 2000] [--preset quick]

The model is that of ``examples/parameter_guide.py``: mugs stand anywhere around the middle of their plate. In the
target, which numpy and OpenCV draw, they stand to the right of it. No line of the model says so. Printed are
Wasserstein-1 distances, pixels, of ``mug.dx`` and ``mug.dy`` from the truth, for the prior, the start, what was learnt,
and a second sample of the truth as large, which is the floor; each with the interval that holds 95 % of bootstraps over
scenes.
"""

import argparse
import json
from pathlib import Path

import cv2
import numpy as np
from given import out_option
from scipy.stats import wasserstein_distance

import probscene as ps
from probscene.app.files import write_json
from probscene.app.loading import load_model

MODEL = Path(__file__).parents[1] / "examples" / "parameter_guide.py"
SIDE, SCENES, RESAMPLES = 256, 1000, 200


def draw_target(images: int, folder: Path, seed: int) -> None:
    """Images of one to three plates in a row, most with a mug or two to the right of their middle."""
    rng = np.random.default_rng(seed)
    folder.mkdir(parents=True, exist_ok=True)
    for i in range(images):
        canvas = np.full((SIDE, SIDE, 3), (51, 76, 102), np.uint8)
        plates = rng.integers(1, 4)
        places = [(SIDE * (k + rng.uniform(0.4, 0.6)) / plates, rng.uniform(70, 186)) for k in range(plates)]
        for place in places:
            cv2.circle(canvas, _fixed(place), 30 * 16, (255, 255, 255), -1, cv2.LINE_AA, 4)
        for place in places:
            for away in truth(rng, rng.choice(3, p=(0.2, 0.5, 0.3))):
                cv2.circle(canvas, _fixed(np.add(place, away)), 9 * 16, (51, 76, 204), -1, cv2.LINE_AA, 4)
        cv2.imwrite(str(folder / f"{i:06d}.png"), canvas)


def truth(rng: np.random.Generator, mugs: int) -> np.ndarray:
    """``(mugs, 2)`` dx and dy of the target's mugs, pixels."""
    return rng.normal((16.0, 0.0), (3.0, 6.0), (mugs, 2))


def _fixed(place) -> tuple[int, int]:
    """In sixteenths of a pixel, as OpenCV draws them; its middles of pixels are at whole numbers."""
    x, y = np.rint(16 * (np.asarray(place) - 0.5)).astype(int)
    return int(x), int(y)


def drawn(tabletop: ps.SceneModel, policy: ps.Policy, seed: int) -> list[np.ndarray]:
    """dx and dy of each scene's mugs, ``(mugs, 2)`` each."""
    ps.seed_everything(seed)
    scenes = ps.sample(tabletop, policy, SCENES)
    has, sites = scenes.site_mask["mug.dx"], ("mug.dx", "mug.dy")
    values = np.stack([scenes.parameters[name].numpy() for name in sites], -1)
    return [some[there] for some, there in zip(values, has.numpy(), strict=True)]


def distances(scenes: list[np.ndarray], true: np.ndarray) -> dict[str, list[float]]:
    """By site, Wasserstein-1 distance, and the interval of 95 % of bootstraps."""
    rng, found = np.random.default_rng(0), {}
    for i, name in enumerate(("mug.dx", "mug.dy")):
        whole = wasserstein_distance(np.concatenate(scenes)[:, i], true[:, i])
        each = []
        for _ in range(RESAMPLES):
            some = np.concatenate([scenes[j] for j in rng.integers(len(scenes), size=len(scenes))])
            each.append(wasserstein_distance(some[:, i], true[:, i]))
        found[name] = [float(whole), *np.quantile(each, (0.025, 0.975)).tolist()]
    return found


def main():
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    out_option(parser, __file__)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--images", type=int, default=2000)
    parser.add_argument("--preset", default="quick")
    args = parser.parse_args()
    target, rng, rows = args.out / "target", np.random.default_rng(1), []
    if not target.is_dir():
        draw_target(args.images, target, 0)
    true = truth(rng, 20_000)
    tabletop = load_model(str(MODEL))
    for seed in args.seeds:
        out, execution = args.out / f"run-{seed}", ps.Execution(threads=1)
        run = ps.fit(str(MODEL), target, args.preset, out=out, seed=seed, execution=execution)
        policies = {"prior": tabletop.prior, "start": tabletop.pretraining_policy, "learnt": run.guide}
        sources = {name: drawn(tabletop, policy, seed) for name, policy in policies.items()}
        sources["floor"] = [truth(rng, len(some)) for some in sources["learnt"]]
        rows.append({"seed": seed} | {name: distances(scenes, true) for name, scenes in sources.items()})
        print(json.dumps(rows[-1]), flush=True)
        write_json(args.out / "results.json", rows)


if __name__ == "__main__":
    main()
