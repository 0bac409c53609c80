"""How well the room that labels leave around objects is found: in renders whose boxes were widened, and in photographs.

    python benchmarks/box_margins.py MODEL LABELLED [--scenes 300] [--margins 0 1 2 4 6]

MODEL is a model's name or file, LABELLED a labelled set of photographs, as a trial takes it. Of each class are printed,
in pixels of the model's canvas, the margins that are found in scenes of the prior whose boxes were widened by so many
pixels on each side, beside other scenes whose boxes touch; and the photographs' own, with its 90 % interval. A dash
stands where no room is found.
"""

import argparse
import math
import tempfile
from pathlib import Path

from given import command, needed

from probscene.app.datasets.generate import DatasetOptions, generate_scenes
from probscene.app.loading import load_model
from probscene.app.memory import tune_malloc
from probscene.app.trial.margins import set_profiles
from probscene.app.trial.sets import LabelledSet
from probscene.app.trial.trial import read_labelled
from probscene.inference.statistics.box_margin import EdgeProfiles, MarginEstimate, estimate_margin
from probscene.model import SceneModel


def rendered(model: SceneModel, scenes: int, margin: int, seed: int) -> EdgeProfiles:
    """Of scenes of the prior, with boxes that are wider by ``margin`` pixels on each side."""
    with tempfile.TemporaryDirectory() as folder:
        options = DatasetOptions(min_visible=0.2, box_margin=margin)
        generate_scenes(model, model.prior, scenes, Path(folder) / "set", seed, options=options)
        return set_profiles(read_labelled(Path(folder) / "set", model.classes, lambda *_: None))


def line(name: str, found: dict[str, MarginEstimate | None], scale: float = 1.0) -> str:
    words = [f"{of} {'-' if margin is None else margin.resized(scale)}" for of, margin in found.items()]
    return f"{name}: {', '.join(words)}"


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("model", nargs="?", help="a model's name or file")
    parser.add_argument("labelled", nargs="?", type=Path, help="a labelled set of photographs; PATH@LIST for some")
    parser.add_argument("--scenes", type=int, default=300)
    parser.add_argument("--margins", type=int, nargs="+", default=[0, 1, 2, 4, 6])
    args = parser.parse_args()
    tune_malloc()
    model = load_model(str(needed(args.model, "a model")))
    photographs: LabelledSet = read_labelled(needed(args.labelled, "a labelled set"), model.classes, lambda *_: None)
    touching, names = rendered(model, args.scenes, 0, 0), photographs.classes  # sorted
    print(command(__file__))
    for margin in args.margins:
        own = rendered(model, args.scenes, margin, 1)
        print(
            line(f"widened by {margin}", {n: estimate_margin(own, touching, c) for c, n in enumerate(names)}),
            flush=True,
        )
    own, scale = set_profiles(photographs), math.sqrt(math.prod(model.canvas) / math.prod(photographs.examples[0].size))
    print(line("photographs", {n: estimate_margin(own, touching, c) for c, n in enumerate(names)}, scale))


if __name__ == "__main__":
    main()
