"""What learning is worth to a detector, on targets that the models draw themselves.

    python benchmarks/trial_drawn.py [--out FOLDER] [--models multi_mnist] [--iterations 300] [--seeds 2]

For each model a target of another structure and layout (``SceneModel.target``) is drawn, a fit sees its images alone,
and ``probscene trial`` compares what is generated of the prior, of the start and of what was learnt, tested on 500 of
these images with their labels. Beside them is the ceiling: as many others of them, labelled. An interrupted run goes
on.
"""

import argparse

from given import out_option

from probscene.app.api.fit import fit
from probscene.app.datasets.generate import generate_scenes
from probscene.app.evaluation.labels import counts_of_dataset
from probscene.app.fitting.run import RunFolder
from probscene.app.loading import load_model
from probscene.app.progress import Display
from probscene.app.trial.tables import text
from probscene.app.trial.trial import GeneratedSets, TrainingBudget, TrialOptions, trial

TESTED, RARE = 500, 0.02  # images; objects of a class in an image, of which fewer are left out


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    out_option(parser, __file__)
    parser.add_argument("--models", nargs="+", default=["multi_mnist"])
    parser.add_argument("--preset", default="quick")
    parser.add_argument("--images", type=int, default=2000, help="of the target, for the fit")
    parser.add_argument("--generate", type=int, default=600)
    parser.add_argument("--iterations", type=int, default=300)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0, help="of the target and of all else")
    parser.add_argument("--workers", type=int, default=1)
    args = parser.parse_args()
    for name in args.models:
        out = args.out / name
        truth = load_model(name).target(args.seed)
        target = out / "target"
        generate_scenes(truth, truth.prior, args.images, target, args.seed)
        _, counts = counts_of_dataset(truth, target)
        # A target may lack a class, or have it in none of the images that are tested on.
        there = [name for name, mean in zip(truth.classes, counts.mean(0), strict=True) if mean >= RARE]
        fit(name, target / "images", args.preset, out=out / "run", seed=args.seed, resume=True)
        with Display() as show:
            options = TrialOptions(
                hold_out=TESTED,
                numbers=(args.generate,),
                classes=there,
                generated=GeneratedSets(RunFolder.at(out / "run"), number=args.generate),
                budget=TrainingBudget(iterations=args.iterations),
                seeds=args.seeds,
                seed=args.seed,
                baselines=("prior",),
            )
            found = trial(target, out / "trial", {}, options, workers=args.workers, show=show)
        print(f"{name}, {args.images} images of the target:\n{text(found)}", flush=True)


if __name__ == "__main__":
    main()
