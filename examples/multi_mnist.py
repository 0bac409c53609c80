"""Multi-MNIST, with the training loop in sight: learn how many digits, and which, from unlabelled images.

    python examples/multi_mnist.py --oracle           # true counts as features: optimisation alone, under a minute
    python examples/multi_mnist.py                    # from pixels: a few minutes

The target is drawn with digits that the model does not have, upright in a row, where the model scatters and turns them;
what is compared in the end is the learnt distribution of structures with the target's.

``probscene.fit`` takes the same steps; it also seeds each batch, keeps checkpoints, and draws each structure several
times.
"""

import argparse
import math

import torch
from pyro.infer import SVI
from pyro.optim.lr_scheduler import PyroLRScheduler
from torch.optim.lr_scheduler import LambdaLR

import probscene as ps
from probscene.derive import derive_complete
from probscene.inference.features.base import class_table, examples
from probscene.inference.features.counting.batches import CountSchedule
from probscene.inference.features.counting.net import CountNet
from probscene.inference.features.counting.training import CountTraining
from probscene.models.multi_mnist import CLASSES, GRAMMAR, MODEL, target
from probscene.renderers.sprites import SpriteRenderer


def true_counts(scenes):
    """Oracle features ``(N, D)``: the number of each digit, and of all."""
    counts = scenes.derivation.counts(len(GRAMMAR.kinds))[:, [GRAMMAR.kind(name) for name in CLASSES]].float()
    return torch.cat([counts, counts.sum(1, keepdim=True)], 1)


def seen_counts(steps):
    """Features from pixels: a count network trained on prior renders, whose labels come free."""
    render, classes = SpriteRenderer(MODEL.canvas), class_table(GRAMMAR.kinds, MODEL.classes)
    net = CountNet(MODEL.classes, MODEL.channels, MODEL.canvas)

    def draw(num):
        return examples(render(ps.sample(MODEL, MODEL.prior, num).drawing), classes)

    def report(training, told):
        print(f"features  step {training.done:5d}  loss {told['loss']:.3f}")

    CountTraining(net, draw, CountSchedule(steps=steps)).run(report)
    return lambda scenes: torch.cat([net.embed(render(part).image) for part in parts(scenes.drawing)])


def parts(drawing, size=64):
    """A drawing, a few scenes at a time, so that few images are in memory."""
    return (drawing[i : i + size] for i in range(0, len(drawing), size))


def histograms(policy, num=10_000):
    """Distributions of the number of digits ``(16,)`` and of their classes ``(10,)``."""
    derivation, _ = derive_complete(GRAMMAR, policy, num, MODEL.max_steps)
    counts = derivation.counts(len(GRAMMAR.kinds))[:, [GRAMMAR.kind(name) for name in CLASSES]]
    number = torch.bincount(counts.sum(1), minlength=16)
    return number / number.sum(), counts.sum(0) / counts.sum()


def main():
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--oracle", action="store_true", help="true counts as features")
    parser.add_argument("--seed", type=int, default=0, help="of the target and of everything random")
    parser.add_argument("--steps", type=int, default=2000, help="of the count network")
    parser.add_argument("--batches", type=int, default=60, help="rendered batches")
    parser.add_argument("--num-scenes", type=int, default=500, help="scenes a batch")
    parser.add_argument("--num-real", type=int, default=5000, help="target images")
    args = parser.parse_args()
    ps.seed_everything(args.seed)

    truth = target(args.seed)
    observe = true_counts if args.oracle else seen_counts(args.steps)
    chunks = [min(500, args.num_real - done) for done in range(0, args.num_real, 500)]
    real = torch.cat([observe(ps.sample(truth, truth.prior, size)) for size in chunks])

    guide = ps.LSTMGuide(GRAMMAR, MODEL.max_steps)
    ps.pretrain(guide, MODEL.prior)

    updates = 3
    cosine = {"lr_lambda": lambda step: 0.5 * (1 + math.cos(math.pi * step / (updates * args.batches)))}
    adam = PyroLRScheduler(LambdaLR, {"optimizer": torch.optim.Adam, "optim_args": {"lr": 1e-2}, **cosine})
    loss = ps.ScoreFunction(observe, ps.KDELogRatio(), ps.ScoreFunctionConfig(updates=updates))
    svi = SVI(MODEL, guide, adam, loss=loss)
    for step in range(updates * args.batches):
        cost = svi.step(args.num_scenes, real=real)
        adam.step()
        if step % (10 * updates) == 0:
            print(f"structure batch {step // updates:4d}  cost {cost:.3f}")

    wanted = histograms(truth.prior)
    for name, policy in (("prior", MODEL.prior), ("learnt", guide)):
        distance = [0.5 * (a - b).abs().sum().item() for a, b in zip(histograms(policy), wanted, strict=True)]
        print(f"total variation, {name}: number of digits {distance[0]:.3f}, classes {distance[1]:.3f}")


if __name__ == "__main__":
    main()
