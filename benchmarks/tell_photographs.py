"""How surely photographs are told from targets that a model could draw: what decides which features a fit takes.

    python benchmarks/tell_photographs.py [--models multi_mnist aerial2d driving] [--targets 5]
        [--photographs MODEL=FOLDER ...]

Printed for each is the share of its images that look like no render of the model, see ``domain_shift``, which asks for
fewer renders where most do. From ``DOMAIN_SHIFT_SHARE`` on a fit takes features for photographs. Drawn targets have
other structures and layouts and, those of ``driving``, other light, weather and camera (``SceneModel.target``,
``learn_looks.hidden``).
"""

import argparse
from pathlib import Path

import torch
from learn_looks import hidden

from probscene.app.fitting.scene_features import ASKED, DOMAIN_SHIFT_SHARE, domain_shift, images_of
from probscene.app.loading import load_model
from probscene.dataset import ImageFolder
from probscene.image_array import ImageArray
from probscene.model import SceneModel


def drawn(model: SceneModel, seed: int) -> float:
    """Of a target that the model draws itself."""
    assert model.target is not None
    truth = hidden(model, seed) if model.name == "driving" else model.target(seed)
    images = torch.cat(list(images_of(truth, truth.prior, ASKED, 1000 + seed)))
    return domain_shift(model, ImageArray(images.permute(0, 2, 3, 1).numpy(), model.canvas, model.channels))


def main():
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--models", nargs="*", default=["multi_mnist", "aerial2d", "driving"])
    parser.add_argument("--targets", type=int, default=5, help="of each model")
    parser.add_argument("--photographs", nargs="*", default=[], metavar="MODEL=FOLDER")
    args = parser.parse_args()
    for name in args.models:
        model = load_model(name)
        shares = [drawn(model, seed) for seed in range(args.targets)]
        print(f"{name}, drawn: " + " ".join(f"{share:.2f}" for share in shares), flush=True)
    for given in args.photographs:
        name, _, folder = given.partition("=")
        model = load_model(name)
        share = domain_shift(model, ImageFolder(Path(folder), model.canvas, model.channels, skip_bad=True))
        print(f"{name}, photographs in {folder}: {share:.2f}", flush=True)
    print(f"Unlike from {DOMAIN_SHIFT_SHARE} on.")


if __name__ == "__main__":
    main()
