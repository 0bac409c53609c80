"""CPU time of training the count network, a step, with torch's Muon and with ours.

    python benchmarks/feature_training.py [MODEL] [--steps 64] [--repeats 3]

Torch's iterates in bfloat16. On a processor that has instructions for it, what one with AVX2 alone makes of it shows in

    ATEN_CPU_CAPABILITY=avx2 ONEDNN_MAX_CPU_ISA=AVX2 python benchmarks/feature_training.py

Trainings of the quick preset, but shorter, take turns; their time is the CPU's over all threads, the one that draws
included, and of each the least counts. "Muon" is the optimiser's part of it, on one thread.
"""

import argparse
import time

import torch

from probscene.app.fitting.presets import QUICK
from probscene.app.fitting.rendered_features import RenderedFeatures
from probscene.app.loading import load_model
from probscene.app.memory import tune_malloc
from probscene.inference.features.counting.batches import CountSchedule
from probscene.inference.features.counting.training import CountTraining
from probscene.sampling import seed_everything


def train(model, view, steps, theirs):
    """CPU milliseconds of a training, and of its Muon alone, a step; and the last loss."""
    seed_everything(0)
    net = QUICK.make_features().build(model)
    net.fit_to(view.object_size())
    training = CountTraining(net, view.draw, CountSchedule(steps=steps))
    muon = training.optimisers["muon"]
    if theirs:
        (group,) = muon.param_groups
        muon = torch.optim.Muon(group["params"], lr=group["lr"], momentum=group["momentum"], weight_decay=0.0)
        training.optimisers["muon"] = muon
    alone, losses, step = 0.0, [], muon.step

    def timed():
        nonlocal alone
        start = time.thread_time()
        step()
        alone += time.thread_time() - start

    muon.step = timed
    start = time.process_time()
    training.run(lambda _, figures: losses.append(figures["loss"]))
    return 1e3 * (time.process_time() - start) / steps, 1e3 * alone / steps, losses[-1]


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("model", nargs="?", default="multi_mnist")
    parser.add_argument("--steps", type=int, default=64)
    parser.add_argument("--repeats", type=int, default=3)
    args = parser.parse_args()
    torch.set_num_threads(1)
    tune_malloc()
    model = load_model(args.model)
    view = RenderedFeatures(model, 1)
    train(model, view, 16, False)  # compiles the renderer's kernels
    taken = {"torch": [], "ours": []}
    for _ in range(args.repeats):
        for name, runs in taken.items():
            runs.append(train(model, view, args.steps, name == "torch"))
    print(f"{model.name}, {torch.backends.cpu.get_cpu_capability()}, CPU ms a step, of {args.steps}")
    print(f"{'':10}{'training':>10}{'Muon':>10}{'last loss':>12}")
    best = {name: [min(column) for column in zip(*runs, strict=True)] for name, runs in taken.items()}
    for name, (whole, alone, loss) in best.items():
        print(f"{name:10}{whole:10.1f}{alone:10.2f}{loss:12.3f}")
    ratios = [ours / theirs for ours, theirs in zip(best["ours"], best["torch"], strict=True)]
    print(f"{'ratio':10}{ratios[0]:10.2f}{ratios[1]:10.3f}")


if __name__ == "__main__":
    main()
