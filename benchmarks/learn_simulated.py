"""How well structure is learnt where reading is simulated: no network, no render, minutes a fit.

    python benchmarks/learn_simulated.py [--out FOLDER] [--model driving] [--seeds 0 1 2] [--again 1] [--preset street]
        [--set key=value]

It separates learning from reading. A seed's target is the model's own (``SceneModel.target``); what is read of
``--images`` of its structures, and of each that a guide derives, is the number of objects of each class through one
channel: some are hidden, the more of them there are, crowds are read as too few, and the rest is noise. The numbers of
the channel are about those of the count network of streets. With ``--again`` each target is learnt from several seeds.
Printed for each fit are total variation and Wasserstein-1 from the target of the number of objects of each class, of
the prior, the start, the learnt guide and the floor, as ``learn_driving.py`` has them, and how far what is read of both
is apart (``read``). FOLDER holds ``results.json``.
"""

import argparse
import json
import time

import numpy as np
import torch
from given import command, out_option
from learn_driving import FLOOR, counted, distances, sampled_anew
from torch import Tensor

from probscene.app.evaluation.sources import LEARNT, SAMPLED_SOURCES, baseline_policies
from probscene.app.files import make_folder, write_json
from probscene.app.fitting.config import FitConfig
from probscene.app.fitting.presets import preset
from probscene.app.fitting.structure_stage import score_function
from probscene.app.loading import load_model
from probscene.derivation import Derivation
from probscene.derive import derive_complete
from probscene.inference.guides.base import Guide
from probscene.inference.guides.scenario import guide_of
from probscene.inference.pretrain import pretrain
from probscene.inference.structure_training import StructureSchedule, StructureTraining
from probscene.inference.training import batch_seed
from probscene.model import SceneModel
from probscene.policy import Policy
from probscene.sampling import Scenes, seed_everything

HIDDEN = 0.02  # share of a class's objects that is hidden, for each that there is
CROWD, BEYOND = 6.0, 0.75  # what is more than the former is read as so much of it
NOISE, MORE = 0.25, 0.12  # standard deviation of what is read, and how much more for each object


class Channel:
    """Simulated readings of derivations, ``(N, classes)``."""

    def __init__(self, model: SceneModel):
        self.grammar = model.grammar
        self.numbers = [model.grammar.kind(name) for name in model.classes]

    def read(self, derivation: Derivation) -> Tensor:
        """As a network would."""
        there = derivation.counts(len(self.grammar.kinds))[:, self.numbers].float()
        seen = torch.binomial(there, 1 / (1 + HIDDEN * there))
        crowded = seen.clamp(max=CROWD) + BEYOND * (seen - CROWD).clamp(min=0)
        return (crowded + torch.randn_like(seen) * (NOISE + MORE * seen)).clamp(min=0)

    def __call__(self, scenes: Scenes) -> Tensor:
        return self.read(scenes.derivation)

    def sample(self, model: SceneModel, policy: Policy, num: int, seed: int) -> Tensor:
        """Readings of ``num`` structures of a policy."""
        seed_everything(seed)
        with torch.no_grad():
            return self.read(derive_complete(self.grammar, policy, num, model.max_steps)[0])


def learn(model: SceneModel, channel: Channel, real: Tensor, config: FitConfig, seed: int) -> Guide:
    """A guide, by what a fit of the preset does."""
    seed_everything(batch_seed(seed, 2))
    guide, start = guide_of(model.grammar, model.max_steps, make=config.guide_maker()), model.pretraining_policy
    guide.bind(model.support)
    objective = score_function(config.structure, model, channel, config.make_divergence(), guide)
    first, then = config.pretrain, config.structure
    pretrain(guide, start, first.derivations, first.epochs, learning_rate=first.learning_rate)
    scenes, images, rate = then.num_scenes, then.num_real, then.learning_rate
    seeds = batch_seed(seed, 3)
    StructureTraining(
        model,
        guide,
        objective,
        real,
        StructureSchedule(
            batches=then.batches, num_scenes=scenes, num_real=images, learning_rate=rate, cosine=then.cosine
        ),
        seed=seeds,
    ).run()
    return guide


def measured(model: SceneModel, seed: int, again: int, args: argparse.Namespace) -> dict:
    """The row of one fit."""
    config = preset(args.preset).set("parameters=none", *args.set)
    target, channel, began = model.target(seed), Channel(model), time.monotonic()
    guide = learn(model, channel, channel.sample(target, target.prior, args.images, 1000 + seed), config, again)
    truth = counted(model, target.prior)
    counts = {name: counted(model, policy) for name, policy in {**baseline_policies(model), LEARNT: guide}.items()}
    counts[FLOOR] = sampled_anew(target, args.images)
    row = {"seed": seed, "again": again, "seconds": round(time.monotonic() - began, 1)}
    sides = (model, guide), (target, target.prior)
    own, other = (channel.sample(*side, args.images, 98).round().long().numpy() for side in sides)
    return row | distances(model, counts, truth) | distances(model, {"read": own}, other)


def main():
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    out_option(parser, __file__)
    parser.add_argument("--model", default="driving")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--again", type=int, default=1, help="seeds of learning for each target (%(default)s)")
    parser.add_argument("--images", type=int, default=3000)
    parser.add_argument("--preset", default="street")
    parser.add_argument("--set", action="append", default=[], help="as of probscene fit")
    args = parser.parse_args()
    torch.set_num_threads(1)
    make_folder(args.out)
    model, rows = load_model(args.model), []
    for seed in args.seeds:
        for again in range(args.again):
            rows.append(measured(model, seed, again, args))
            print(json.dumps(rows[-1]), flush=True)
            write_json(args.out / "results.json", {"command": command(__file__), "rows": rows})
    first = model.classes[0]
    for name in (name for name in (*SAMPLED_SOURCES, FLOOR, "read") if name in rows[0]):
        each = [row[name][first]["total_variation"][0] for row in rows]
        print(f"{name:8} {first}, total variation: mean {np.mean(each):.3f}, {min(each):.3f} to {max(each):.3f}")


if __name__ == "__main__":
    main()
