"""How far Meta-Sim's two losses come on Multi-MNIST where the structures are known.

    python benchmarks/learn_meta_sim.py --mnist FOLDER [--out FOLDER] [--losses mmd task] [--target 0] [--set steps=100]

The target is that of ``learn_parameters.py``, and so are the figures that are printed as it learns: how far digits are
from an upright, evenly spaced row. Structures are drawn from the target's own distributions, so that parameters are all
that there is to learn. ``mmd`` matches features of the target's images. ``task`` trains a small network on generated
scenes to tell which digits an image shows, and raises its score on a few labelled rows that the model's own target
program draws. With both, the second goes on from the first. FOLDER holds the target, ``meta-sim.json`` and a picture,
``meta-sim.png``: prior, what each loss has learnt, target.
"""

import argparse
import json
import time

import torch
from given import mnist_option, needed_mnist, out_option
from learn_multi_mnist import distributions, draw_target
from learn_parameters import SIDE, picture, row_errors
from torch import Tensor

from probscene.app.files import write_json
from probscene.app.fitting.presets import QUICK
from probscene.app.fitting.rendered_features import RenderedFeatures
from probscene.dataset import ImageFolder
from probscene.inference.features.pretrained import EfficientNetLite
from probscene.inference.parameters.meta_sim.learning import MetaSimLearning
from probscene.inference.parameters.meta_sim.presence_task import PresenceTask
from probscene.inference.parameters.meta_sim.schedule import MetaSimSchedule
from probscene.inference.parameters.meta_sim.task import TaskLearning
from probscene.inference.parameters.meta_sim.transform import ParameterTransform
from probscene.inference.training import Training
from probscene.models.multi_mnist import CLASSES, GRAMMAR, MODEL
from probscene.policy import Policy
from probscene.sampling import sample, seed_everything
from probscene.structure import StructurePrior, counts, weights

IMAGES, TRIED, TOLD = 1000, 500, 10  # of the target; scenes that figures are of; steps between them


def figures(transform: ParameterTransform | None, structure: Policy) -> tuple[dict[str, float], Tensor]:
    """Of new scenes, how far they are from rows; and images of some of them."""
    model = MODEL if transform is None else transform.with_parameters(MODEL)
    seed_everything(1)
    with torch.no_grad():
        scenes = sample(model, structure, TRIED)
    return row_errors([scenes]), RenderedFeatures(MODEL, 1).labelled(scenes, slice(0, SIDE**2)).image


def task_of(target: int, structure: Policy, labelled: int) -> PresenceTask:
    """The task, with so many labelled images."""
    assert MODEL.target is not None
    truth = MODEL.target(target)
    seed_everything(2)
    drawn = RenderedFeatures(truth, 1).labelled(sample(truth, structure, labelled))
    shown = torch.stack([(drawn.label == c).any(1) for c in range(len(CLASSES))], 1)
    return PresenceTask(RenderedFeatures(MODEL, 1).labelled, drawn.image, shown)


def learnt(name: str, training: Training, transform: ParameterTransform, structure: Policy) -> dict:
    """Run a training; what it reaches, and in what time."""
    start, losses, log = time.process_time(), [], []

    def each(now: Training, line: dict[str, float]) -> None:
        losses.append(line["loss"])
        if now.done % TOLD == 0 or now.done == now.total:
            mean = sum(losses[-TOLD:]) / len(losses[-TOLD:])
            about = {"step": now.done, "seconds": time.process_time() - start, "loss": mean}
            log.append(about | figures(transform, structure)[0])
            print(name, json.dumps(log[-1]), flush=True)

    training.run(each)
    return {"loss": name, "log": log}


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    mnist_option(parser)
    out_option(parser, __file__)
    parser.add_argument("--target", type=int, default=0)
    parser.add_argument("--losses", nargs="+", choices=("mmd", "task"), default=["mmd", "task"])
    parser.add_argument("--set", action="append", default=[], help="key=value, of the schedule of mmd")
    parser.add_argument("--task-steps", type=int, default=40)
    parser.add_argument("--labelled", type=int, default=40, help="labelled images, of task")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    args.mnist = needed_mnist(args.mnist)
    torch.set_num_threads(1)
    args.out.mkdir(parents=True, exist_ok=True)
    folder = args.out / f"target-{args.target}"
    draw_target(args.mnist, args.target, folder, IMAGES)
    real = ImageFolder(folder, MODEL.canvas, MODEL.channels)
    images = torch.stack([real.load(i) for i in range(IMAGES)])
    number, share = distributions(args.target)
    structure = StructurePrior(GRAMMAR, Digits=counts(*number), Digit=weights(*share))
    given = (f"parameters.{setting}" for setting in args.set)
    schedule = QUICK.set("parameters=meta-sim", *given).parameters
    assert isinstance(schedule, MetaSimSchedule)
    look = EfficientNetLite(schedule.feature_size)
    seen = RenderedFeatures(MODEL, 1).observe(look)
    matching = MetaSimLearning(MODEL, structure, seen, look.embed(images), schedule, args.seed)
    transform = matching.guide
    assert transform is not None
    before, pictures = figures(None, structure)
    results, panels = [{"loss": "none", **before}], [pictures]
    print(json.dumps(results[0]), flush=True)
    for name in args.losses:
        training: Training = matching
        if name == "task":
            task = task_of(args.target, structure, args.labelled)
            training = TaskLearning(transform, task, args.task_steps, seed=args.seed)
        results.append(learnt(name, training, transform, structure))
        panels.append(figures(transform, structure)[1])
        write_json(args.out / "meta-sim.json", results)
    picture([*panels, images[: SIDE**2]], args.out / "meta-sim.png")


if __name__ == "__main__":
    main()
