"""How near renders come to photographs by parameters that are learnt from these as wholes, structures left as they are.

    python benchmarks/learn_tilting.py MODEL IMAGES [--out FOLDER] [--seeds 0 1 2] [--images 1000] [--set rounds=20]

MODEL is a model's name or file, IMAGES a folder of photographs without labels. One in five judges, and is not learnt
from. Printed for each seed are squared energy distances of renders from these, by EfficientNet's features and by what
can plainly be said of an image (``image_statistics``), in units of how far the photographs are apart, without bias,
with the interval that holds 95 % of bootstraps over images; for the prior, the start (the structures that a fit begins
with, under the prior's parameters), what was learnt (the same structures, learnt parameters), and the floor, the
photographs that were learnt from. Then the sites that were moved, renders, and CPU seconds. FOLDER holds
``results.json``, and a picture of each seed, ``scenes-K.png``: start, learnt, photographs.
"""

import argparse
import json
import time
from pathlib import Path

import cv2
import numpy as np
import torch
from given import command, needed, out_option
from scipy.spatial.distance import cdist
from torch import Tensor

import probscene as ps
from probscene.app.files import make_folder, write_json
from probscene.app.fitting.parameter_stage import HELD
from probscene.app.fitting.presets import preset
from probscene.app.fitting.rendered_features import RENDERED_AT_ONCE, RenderedFeatures
from probscene.app.loading import load_model
from probscene.app.memory import tune_malloc
from probscene.app.progress import Display
from probscene.dataset import ImageFolder
from probscene.inference.features.pretrained import EfficientNetLite
from probscene.inference.parameters.tilting.image_statistics import image_statistics
from probscene.inference.parameters.tilting.learning import TiltingLearning
from probscene.inference.parameters.tilting.schedule import TiltingSchedule
from probscene.inference.statistics.count_metrics import bootstrap_interval, resamples
from probscene.inference.statistics.energy import Features
from probscene.model import SceneModel
from probscene.policy import Policy
from probscene.sampling import sample, seed_everything

RESAMPLES, SIDE = 200, 3  # pictures along a side of a panel


def squared(own: Features, real: Features) -> tuple[float, float, float]:
    """The squared energy distance of features ``(N, D)`` and ``(L, D)``, in units of the latter's spread, with its
    interval. Pairs of an image and its copy are left out."""
    across, theirs, within = cdist(own, real), cdist(own, own), cdist(real, real)

    def found(a: Features, b: Features) -> Features:
        """By weights ``(R, N)`` and ``(R, L)``, how often each image is there."""
        n, m = a.sum(1), b.sum(1)
        toward = ((a @ across) * b).sum(1) / (n * m)
        among, spread = (
            ((x @ apart) * x).sum(1) / (x.sum(1) ** 2 - np.square(x).sum(1)) for x, apart in ((a, theirs), (b, within))
        )
        return (2 * toward - among - spread) / spread

    whole = found(np.ones((1, len(own))), np.ones((1, len(real))))
    drawn = found(resamples(len(own), RESAMPLES, 0), resamples(len(real), RESAMPLES, 1))
    value, low, high = bootstrap_interval(float(whole[0]), drawn)
    return round(value, 4), round(low, 4), round(high, 4)


def picture(panels: list[Tensor], path: Path) -> None:
    """Panels ``(9, C, H, W)`` of pictures beside one another."""
    blocks = []
    for images in panels:
        framed = torch.nn.functional.pad(images.expand(-1, 3, -1, -1), (2, 2, 2, 2), value=90)
        grid = framed.unflatten(0, (SIDE, SIDE)).permute(0, 3, 1, 4, 2)
        blocks.append(grid.reshape(SIDE * framed.shape[2], -1, 3).numpy())
        blocks.append(np.full((len(blocks[-1]), 24, 3), 255, np.uint8))
    cv2.imwrite(str(path), np.concatenate(blocks[:-1], 1)[..., ::-1])


def renders(observer: RenderedFeatures, model: SceneModel, policy: Policy, number: int) -> Tensor:
    """Images ``(number, C, H, W)``, of one seed."""
    seed_everything(99)
    parts = [min(RENDERED_AT_ONCE, number - i) for i in range(0, number, RENDERED_AT_ONCE)]
    return torch.cat([observer.labelled(sample(model, policy, part)).image for part in parts])


def learn(
    model: SceneModel, observer: RenderedFeatures, photographs: Tensor, seed: int, settings: list[str]
) -> TiltingLearning:
    """Parameters, learnt from photographs."""
    given = (f"parameters.{setting}" for setting in settings)
    schedule = preset("quick").set("parameters=tilting", *given).parameters
    assert isinstance(schedule, TiltingSchedule)
    seen_by = EfficientNetLite(schedule.feature_size).embed, image_statistics
    real = tuple(embed(photographs) for embed in seen_by)
    learning = TiltingLearning(model, model.pretraining_policy, observer.labelled, seen_by, real, schedule, seed)
    with Display() as show:
        learning.run(lambda now, line: show("parameters", now.done, now.total, f"loss {line['loss']:.3f}", "rounds"))
    return learning


def main():
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("model", nargs="?")
    parser.add_argument("photographs", type=Path, nargs="?", metavar="IMAGES")
    out_option(parser, __file__)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--images", type=int, default=1000, help="renders that are judged (%(default)s)")
    parser.add_argument("--set", action="append", default=[], help="key=value, another value of the schedule's field")
    args = parser.parse_args()
    needed(args.photographs, "a model and a folder of photographs")
    tune_malloc()
    torch.set_num_threads(1)
    make_folder(args.out)
    model, rows = load_model(args.model), []
    folder = ImageFolder(args.photographs, model.canvas, model.channels)
    target = torch.stack([folder.load(i) for i in range(len(folder))])
    held = torch.arange(len(target)) % HELD == HELD - 1
    observer, start = RenderedFeatures(model, 1), model.pretraining_policy
    judges = {"efficientnet": EfficientNetLite().embed, "plain": image_statistics}

    def seen(images: Tensor) -> dict[str, Features]:
        return {judge: embed(images).double().numpy() for judge, embed in judges.items()}

    of_held = seen(target[held])

    def apart(images: Tensor) -> dict[str, tuple[float, float, float]]:
        return {judge: squared(features, of_held[judge]) for judge, features in seen(images).items()}

    began = renders(observer, model, start, args.images)
    same = {"prior": apart(renders(observer, model, model.prior, args.images)), "start": apart(began)}
    same["floor"] = apart(target[~held])
    for seed in args.seeds:
        before = time.process_time()
        learning = learn(model, observer, target[~held], seed, args.set)
        row: dict = {"seed": seed, "photographs": len(target), "judged": int(held.sum())}
        row |= {"moved": [site.name for site in learning.learnt], "renders": learning.schedule.drawn}
        row["seconds"] = round(time.process_time() - before)
        learnt = model if learning.guide is None else learning.guide.with_parameters(model)
        images = renders(observer, learnt, start, args.images)
        of_source = same | {"learnt": apart(images)}
        row |= {judge: {source: found[judge] for source, found in of_source.items()} for judge in judges}
        picture([some[: SIDE**2] for some in (began, images, target[held])], args.out / f"scenes-{seed}.png")
        rows.append(row)
        print(json.dumps(row), flush=True)
        write_json(args.out / "results.json", {"command": command(__file__), "version": ps.__version__, "rows": rows})


if __name__ == "__main__":
    main()
