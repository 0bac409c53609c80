"""How close light, camera and cars come to a hidden street's, learnt with structure from images alone.

    python benchmarks/learn_looks.py [--out FOLDER] [--seeds 0] [--images 2000] [--preset street] [--set key=value]

Each seed's target is drawn by ``driving`` with a hidden distribution of structures (``SceneModel.target``), and with
another camera pitch and height, light, weather, exposure, lateral place of the cars, makes and colours: of each of
these sites the values lie within a third of the prior's probability, where is drawn by the seed. Fits are told none of
it. Printed for each site that the fit has learnt, or that is hidden, are its skill and Wasserstein-1 distances from the
truth in the prior's CDF (0 to 1), for the prior, where parameters start, for what was learnt, and for a second sample
of the truth, the floor; with the interval that holds 95 % of bootstraps over scenes. Then the total variation of the
number of cars, and KID from 500 target images in EfficientNet-Lite0's features, with an interval; the target's own row
has that of another 500. FOLDER holds the runs, ``results.json`` and a picture for each seed, ``scenes-K.png``: prior,
structure alone, both, target.
"""

import argparse
import json
from copy import copy
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from given import command, out_option
from learn_driving import counted
from learn_parameters import IMAGES, drawn, with_interval
from pyro.poutine.messenger import Messenger
from scipy.stats import wasserstein_distance
from torch import Tensor

from probscene.app.api.fit import fit
from probscene.app.datasets.generate import generate_scenes
from probscene.app.files import write_json
from probscene.app.fitting.learnt_parameters import NAME, learnt_by, prefixed
from probscene.app.fitting.pipeline import Execution
from probscene.app.fitting.presets import preset
from probscene.app.fitting.store import timing
from probscene.app.loading import load_model
from probscene.app.memory import tune_malloc
from probscene.dataset import ImageFolder
from probscene.inference.features.pretrained import EfficientNetLite
from probscene.inference.parameters.sites import U_EPS, quantiles_of, site_name, with_handlers
from probscene.inference.statistics.count_metrics import histogram, total_variation
from probscene.inference.statistics.image_metrics import kid
from probscene.model import SceneModel
from probscene.policy import Policy
from probscene.sampling import sample, seed_everything

HIDDEN = ("camera.height", "camera.pitch", "camera.exposure", "sun.azimuth", "sun.elevation", "weather.cloud")
HIDDEN += ("weather.haze", "car.across", "car.make", "car.colour")
WIDTH = 1 / 3  # of the prior's probability that is left to a hidden site
SCENES, RESAMPLES, SHOWN = 1000, 200, 6


class Narrowed(Messenger):
    """Inside it hidden sites have values of a part of their prior alone.

    Args:
        model: whose program runs.
        lowest: by site, the least u.
    """

    def __init__(self, model: SceneModel, lowest: dict[str, float]):
        super().__init__()
        self.grammar, self.lowest = model.grammar, lowest

    def _pyro_sample(self, msg: Any) -> None:
        low = self.lowest.get(site_name(self.grammar, msg["name"]))
        if low is not None and msg["value"] is None:
            u = msg["fn"].cdf(msg["fn"].sample())
            msg["value"] = msg["fn"].icdf((low + WIDTH * u).clamp(U_EPS, 1 - U_EPS))


def hidden(model: SceneModel, seed: int) -> SceneModel:
    """The target of a seed."""
    assert model.target is not None
    truth, rng = model.target(seed), np.random.default_rng(seed)
    lowest = dict(zip(HIDDEN, rng.uniform(0, 1 - WIDTH, len(HIDDEN)).tolist(), strict=True))
    return with_handlers(truth, Narrowed(truth, lowest))


def quantiles(model: SceneModel, drawn_by: SceneModel, policy: Policy, seed: int) -> dict[str, list[np.ndarray]]:
    """u of each site, scene by scene."""
    seed_everything(seed)
    scenes = sample(drawn_by, policy, SCENES)
    values = {name: u.numpy() for name, u in quantiles_of(model, scenes).items()}
    return {name: [row[~np.isnan(row)] for row in u] for name, u in values.items()}


def distance(scenes: list[np.ndarray], truth: list[np.ndarray]) -> list[float]:
    """Wasserstein-1, and the interval of 95 % of bootstraps."""
    true, values, rng = np.concatenate(truth), np.concatenate(scenes), np.random.default_rng(0)
    which = np.repeat(np.arange(len(scenes)), [len(some) for some in scenes])
    each = []
    for _ in range(RESAMPLES):
        drawn = rng.multinomial(len(scenes), np.full(len(scenes), 1 / len(scenes)))
        each.append(wasserstein_distance(values, true, drawn[which]))
    return [float(wasserstein_distance(values, true)), *np.quantile(each, (0.025, 0.975)).tolist()]


def measured(model: SceneModel, seed: int, args: argparse.Namespace) -> dict:
    """One seed's rows."""
    folder, truth = args.out / f"target-{seed}", hidden(model, seed)
    generate_scenes(truth, truth.prior, args.images, folder, seed=1000 + seed, format="images")
    config = preset(args.preset).set("parameters=any", *args.set)
    execution = Execution(args.threads, cache=args.out / "cache")
    out = args.out / f"run-{seed}"
    run = fit(args.model, folder / "images", config, out=out, seed=seed, resume=True, execution=execution)
    tensors = run.read_tensors(NAME)
    learnt = (
        learnt_by(model, run.config, run.parameters, run.guide, prefixed(tensors)).with_parameters(model)
        if tensors
        else model
    )
    structure = copy(run.guide)
    structure.with_parameters = None
    true = quantiles(model, truth, truth.prior, 1)
    others = {
        "prior": quantiles(model, model, structure, 2),
        "learnt": quantiles(model, learnt, structure, 2),
        "floor": quantiles(model, truth, truth.prior, 3),
    }
    of_site = {site["name"]: site for site in run.parameters["sites"]}
    named = [name for name, site in of_site.items() if site["learnt"] or name in HIDDEN]
    row: dict = {"seed": seed, "kept": run.parameters["kept"], "seconds": timing(run), "sites": {}, "kid": {}}
    for name in named:
        about = {"hidden": name in HIDDEN, "skill": of_site[name].get("skill"), "is_learnt": of_site[name]["learnt"]}
        row["sites"][name] = about | {source: distance(u[name], true[name]) for source, u in others.items()}
    cars = {name: histogram(counted(model, policy)[:, 0]) for name, policy in (
        ("truth", truth.prior), ("prior", model.prior), ("start", model.pretraining_policy), ("learnt", structure)
    )}  # fmt: skip
    row["cars"] = {name: float(total_variation(each, cars["truth"])) for name, each in cars.items() if name != "truth"}
    look, real = EfficientNetLite(), ImageFolder(folder / "images", model.canvas, model.channels)
    of_real = look.embed(torch.stack([real.load(i) for i in range(2 * IMAGES)]))
    row["kid"]["floor"] = with_interval(kid(of_real[:IMAGES], of_real[IMAGES:], "efficientnet"))
    panels = []
    for source in ("prior", "start", "structure", "both"):
        policy = copy({"prior": model.prior, "start": model.pretraining_policy}.get(source, run.guide))
        policy.with_parameters = (lambda _: learnt) if source == "both" else None
        _, pictures = drawn(run, policy, 1)
        row["kid"][source] = with_interval(kid(of_real[:IMAGES], look.embed(pictures), "efficientnet"))
        panels += [pictures] if source != "start" else []
    picture([*panels, torch.stack([real.load(i) for i in range(SHOWN)])], args.out / f"scenes-{seed}.png")
    return row


def picture(sources: list[Tensor], path: Path) -> None:
    """A column of images of each source, ``(N, 3, H, W)``."""
    columns = [np.concatenate(list(images[:SHOWN].permute(0, 2, 3, 1).numpy())) for images in sources]
    white = [np.pad(column, ((0, 0), (0, 20), (0, 0)), constant_values=255) for column in columns]
    whole = np.concatenate(white, 1)[:, :-20, ::-1]
    cv2.imwrite(str(path), cv2.resize(whole, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))


def main():
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    out_option(parser, __file__)
    parser.add_argument("--model", default="driving")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--images", type=int, default=2000)
    parser.add_argument("--preset", default="street")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--set", action="append", default=[], help="as of probscene fit")
    args = parser.parse_args()
    tune_malloc()
    model, rows = load_model(args.model), []
    for seed in args.seeds:
        rows.append(measured(model, seed, args))
        print(json.dumps(rows[-1]), flush=True)
        write_json(args.out / "results.json", {"command": command(__file__), "rows": rows})


if __name__ == "__main__":
    main()
