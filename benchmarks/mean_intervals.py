"""Do intervals of mean counts hold the truth where a model does not look like its target?

    python benchmarks/mean_intervals.py [--targets 20] [--images 300] [--labelled 10] [--seed 0] [--out FOLDER]

A network is trained to count on renders of ``small_digits``. Each target has numbers and digits of its own, and a look
that no render has: darker, blurred and noisy. Some images are labelled. For each target are printed the true mean
number of each digit in an endless target, what the network reads in the mean, and the 90 % interval by labels and
readings together (``prediction_powered_mean``); at the end, how many of the intervals hold the truth, and how wide they
are beside those of the labels alone.
"""

import argparse

import cv2
import numpy as np
import torch
from given import out_option

import probscene as ps
from probscene.app.evaluation.estimate import class_counts
from probscene.app.fitting.run import RunFolder
from probscene.app.fitting.scene_features import own_net
from probscene.app.loading import load_model, renderer_for
from probscene.inference.features.base import objects_counted
from probscene.inference.statistics.prediction_powered import prediction_powered_mean
from probscene.sampling import sample, seed_everything


def otherwise(images: torch.Tensor, rng: np.random.Generator) -> torch.Tensor:
    """Images ``(N, C, H, W)`` in a look of their own."""
    contrast, blur, noise = rng.uniform(0.5, 1.0), rng.uniform(0.3, 1.2), rng.uniform(0, 8)
    x = contrast * images.numpy().transpose(0, 2, 3, 1).astype(np.float32)
    x = np.stack([cv2.GaussianBlur(one, (0, 0), blur).reshape(one.shape) for one in x])
    x = (x + rng.normal(0, noise, x.shape)).clip(0, 255).round().astype(np.uint8)
    return torch.from_numpy(x.transpose(0, 3, 1, 2))


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    out_option(parser, __file__)
    parser.add_argument("--targets", type=int, default=20)
    parser.add_argument("--images", type=int, default=300)
    parser.add_argument("--labelled", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    model = load_model("small_digits")
    if not (args.out / "run").is_dir():
        ps.generate(model, 100, args.out / "any", seed=args.seed, format="images")
        config = ps.preset("quick").set("features=count", "parameters=none", {"structure.batches": 1})
        ps.fit("small_digits", args.out / "any" / "images", config, out=args.out / "run", seed=args.seed)
    run = RunFolder.at(args.out / "run")
    net, render = own_net(run), renderer_for(model)
    held, widths, of_class, errors = [], [], [], []
    for number in range(args.targets):
        seed_everything(1000 * args.seed + number)
        rng, target = np.random.default_rng([args.seed, number]), model.target(number)
        kinds = torch.tensor([model.grammar.kind(name) for name in model.classes])

        def counted(scenes, kinds=kinds):
            return (scenes.derivation.kind.unsqueeze(-1) == kinds).sum(1).numpy()

        truth = counted(sample(target, target.prior, 20_000)).mean(0)
        scenes = sample(target, target.prior, args.images)
        counts, images = counted(scenes), otherwise(render(scenes.drawing).image, rng)
        with torch.no_grad():
            features = objects_counted(net, net.embed(images))
        read = class_counts(model, run.feature_names, features).double().numpy()
        print(f"target {number}")
        for c, name in enumerate(model.classes):
            y, f, others = counts[: args.labelled, c], read[: args.labelled, c], read[args.labelled :, c]
            found, alone = prediction_powered_mean(y, f, others), prediction_powered_mean(y, f, [])
            held.append(found.low <= truth[c] <= found.high)
            widths.append(found.high - found.low), of_class.append(alone.high - alone.low)
            errors.append(abs(read[:, c].mean() - truth[c]))
            interval = f"{found.value:.2f} ({found.low:.2f} to {found.high:.2f})"
            print(f"  {name}: {truth[c]:.2f}, read {read[:, c].mean():.2f}, {interval}", flush=True)
    each = np.array(held).reshape(args.targets, -1)
    print(f"intervals that hold the truth: {each.mean():.0%} of {each.size}; of each class {each.sum(0).tolist()} of "
          f"{args.targets}")  # fmt: skip
    print(f"readings are off by {np.mean(errors):.2f} in the mean; intervals are {np.mean(widths):.2f} wide, "
          f"{np.mean(of_class):.2f} by the labels alone")  # fmt: skip


if __name__ == "__main__":
    main()
