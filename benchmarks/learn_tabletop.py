"""How close a site of a user's own model comes to the truth, learnt from images of another program.

    python benchmarks/learn_tabletop.py --out FOLDER [--seeds 0 1 2] [--images 2000] [--preset quick]

The model is that of ``docs/writing_models.md``: mugs stand anywhere around the middle of their plate. In the target,
which numpy and OpenCV draw, they stand to the right of it. No line of the model says so. Printed are Wasserstein-1
distances, pixels, of ``mug.dx`` and ``mug.dy`` from the truth, for the prior, what was learnt, and a second sample of
the truth as large, which is the floor; each with the interval that holds 95 % of bootstraps over scenes.
"""

import argparse
import json
from pathlib import Path

import cv2
import numpy as np
import pyro
import pyro.distributions as dist
from scipy.stats import wasserstein_distance

import probscene as ps
from probscene.app.files import write_json

GRAMMAR = ps.Grammar("""
    Scene  -> table(Plates)
    Plates -> plate(Mugs) Plates | ε
    Mugs   -> mug Mugs | ε
""")
PRIOR = ps.StructurePrior(GRAMMAR, Plates=ps.counts(0, 1, 1, 1), Mugs=ps.counts(1, 1, 1))
SIDE, SCENES, RESAMPLES = 256, 1000, 200


@ps.scene_model(GRAMMAR, PRIOR, canvas=(SIDE, SIDE), max_steps=60, classes=("plate", "mug"))
def tabletop(scene):
    """As a user would write it."""
    with scene.nodes("plate"):
        gap = pyro.sample("plate.gap", dist.Uniform(0.2, 0.8))
        y = pyro.sample("plate.y", dist.Uniform(50.0, 206.0))
    with scene.nodes("mug"):
        dx = pyro.sample("mug.dx", dist.Normal(0.0, 12.0))
        dy = pyro.sample("mug.dy", dist.Normal(0.0, 12.0))
    x = SIDE * (scene.rank("plate") + gap) / scene.count("plate").clamp(min=1)
    return scene.draw(
        ps.Sprites.disc("plate", x, y, radius=30.0),
        ps.Sprites.disc("mug", scene.of_parent(x) + dx, scene.of_parent(y) + dy, radius=9.0, tint=(0.8, 0.3, 0.2)),
        background=(0.4, 0.3, 0.2),
    )


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


def drawn(policy, seed: int) -> list[np.ndarray]:
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
    parser.add_argument("--out", type=Path, required=True, help="folder for the target and the runs")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--images", type=int, default=2000)
    parser.add_argument("--preset", default="quick")
    args = parser.parse_args()
    target, rng, rows = args.out / "target", np.random.default_rng(1), []
    if not target.is_dir():
        draw_target(args.images, target, 0)
    true = truth(rng, 20_000)
    for seed in args.seeds:
        run = ps.fit(
            tabletop, target, preset=args.preset, seed=seed, out=args.out / f"run-{seed}", features="count", threads=1
        )
        sources = {"prior": drawn(tabletop.prior, seed), "learnt": drawn(run.guide, seed)}
        sources["floor"] = [truth(rng, len(some)) for some in sources["learnt"]]
        rows.append({"seed": seed} | {name: distances(scenes, true) for name, scenes in sources.items()})
        print(json.dumps(rows[-1]), flush=True)
        write_json(args.out / "results.json", rows)


if __name__ == "__main__":
    main()
