"""Is a target another domain, or has the model not learnt it yet? Targets of which one knows, as a verdict tells them.

    python benchmarks/tell_domain_shift.py [--images 40] [--scenes 160] [--seed 0] [--photographs FOLDER ...]

Printed for each is the share of its images that show what is unlike anything in the prior's scenes
(``patch_outliers``); from a half on the verdict is "domain shift". Beside it is the share of images that are farther
from every scene than two scenes are from one another, by features of whole images (``distance_outliers``), which
verdicts went by before. Nothing is fitted. Not learnt, but within the model's reach, are digits and roads in other
numbers and other places. Other domains are letters, and digits and roads that are turned, larger, blurred, noisy or in
other colours than the model draws; photographs in folders are held against the model of digits.
"""

import argparse
import math
import string
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pyro
import pyro.distributions as dist
import torch
import torch.nn.functional as F
from torch import Tensor

from probscene.app.fitting.scene_features import images_of
from probscene.app.loading import load_model
from probscene.dataset import ImageFolder
from probscene.derive import derive
from probscene.inference.features.pretrained import EfficientNetLite
from probscene.inference.statistics.domain_shift import distance_outliers, patch_outliers
from probscene.model import SceneModel
from probscene.models import multi_mnist
from probscene.models.digits import shipped
from probscene.policy import Policy
from probscene.scene import SceneGraph
from probscene.structure import StructurePrior, counts, weights

LOW, HIGH = multi_mnist.MARGIN, multi_mnist.CANVAS - multi_mnist.MARGIN
UNIFORM_NUMBER, UNIFORM_CLASS = (1,) * (multi_mnist.MAX_DIGITS + 1), (1,) * 10
FONTS = cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_COMPLEX, cv2.FONT_HERSHEY_TRIPLEX
WITHIN, BEYOND = "not learnt", "another domain"
Place = Callable[[Tensor, Tensor, Tensor, Tensor], tuple[Tensor | float, Tensor | float]]
"""Where digits stand, by rank, number and two uniform numbers."""


def anywhere(rank, number, u, v):
    return LOW + (HIGH - LOW) * u, LOW + (HIGH - LOW) * v


def along(rank, number):
    return LOW + (HIGH - LOW) * (rank + 0.5) / number.clamp(min=1)


def around(rank, number, u, v):
    turn = 2 * math.pi * rank / number.clamp(min=1)
    return 128 + 85 * turn.cos(), 128 + 85 * turn.sin()


LAYOUTS: dict[str, Place] = {
    "in a column": lambda rank, number, u, v: (128.0, along(rank, number)),
    "in a row": lambda rank, number, u, v: (along(rank, number), 128.0),
    "in a diagonal": lambda rank, number, u, v: (along(rank, number), along(rank, number)),
    "in a grid": lambda rank, number, u, v: (48.0 + 53 * (rank % 4), 60.0 + 65 * (rank // 4)),
    "in a circle": around,
    "in a corner": lambda rank, number, u, v: (LOW + 70 * u, LOW + 70 * v),
}


def digits(place: Place = anywhere, number=UNIFORM_NUMBER, share=UNIFORM_CLASS, angle: float = 0.0) -> SceneModel:
    """Digits of exemplars that the prior does not have."""

    def program(num_scenes, structure):
        with pyro.plate("scenes", num_scenes, dim=-2):
            derived = derive(multi_mnist.GRAMMAR, structure, num_scenes, multi_mnist.MAX_STEPS)
            scene = SceneGraph(multi_mnist.GRAMMAR, derived)
            with scene.nodes(*multi_mnist.CLASSES):
                exemplar, u, v = (pyro.sample(name, dist.Uniform(0.0, 1.0)) for name in ("exemplar", "u", "v"))
        x, y = place(scene.rank(*multi_mnist.CLASSES), scene.count(*multi_mnist.CLASSES), u, v)
        return multi_mnist.draw(scene, shipped(True), exemplar, x, y, angle)

    prior = StructurePrior(multi_mnist.GRAMMAR, Digits=counts(*number), Digit=weights(*share))
    canvas, classes = (multi_mnist.CANVAS, multi_mnist.CANVAS), multi_mnist.CLASSES
    return SceneModel("digits", multi_mnist.GRAMMAR, prior, program, canvas, multi_mnist.MAX_STEPS, classes, channels=1)


def letters(number: int, seed: int, row: bool) -> Tensor:
    """Up to ten capital letters an image, of the digits' size."""
    rng = np.random.default_rng(seed)
    images = np.zeros((number, 1, multi_mnist.CANVAS, multi_mnist.CANVAS), np.uint8)
    for image in images[:, 0]:
        k = int(rng.integers(0, 11))
        for i in range(k):
            x, y = (int(LOW + (HIGH - LOW) * (i + 0.5) / k), 128) if row else map(int, rng.integers(LOW, HIGH, 2))
            sign, font = rng.choice(list(string.ascii_uppercase)), int(rng.choice(FONTS))
            (w, h), _ = cv2.getTextSize(sign, font, 0.8, 2)
            cv2.putText(image, sign, (x - w // 2, y + h // 2), font, 0.8, 255, 2, cv2.LINE_AA)
    return torch.from_numpy(images)


def render_scenes(model: SceneModel, number: int, seed: int, policy: Policy | None = None) -> Tensor:
    return torch.cat(list(images_of(model, policy or model.prior, number, seed)))


def changed(images: Tensor, seed: int) -> Iterator[tuple[str, Tensor]]:
    """As no model here draws them."""
    noise = np.random.default_rng(seed).normal(0, 25, images.shape)
    yield "inverted", 255 - images
    yield "noisy", (images + torch.from_numpy(noise)).clamp(0, 255).byte()
    yield "twice as large", F.interpolate(images[..., 64:192, 64:192].float(), scale_factor=2, mode="bilinear").byte()
    each = [cv2.GaussianBlur(x, (0, 0), 2.0) for x in images.permute(0, 2, 3, 1).numpy()]
    yield "blurred", torch.from_numpy(np.stack(each)).reshape(len(images), *images.shape[2:], -1).permute(0, 3, 1, 2)


def cases_of_digits(number: int, seed: int, folders: list[Path]) -> Iterator[tuple[str, str, Tensor]]:
    model = load_model("multi_mnist")
    assert model.target is not None
    yield WITHIN, "the model's own target", render_scenes(model.target(seed), number, seed)
    for name, place in LAYOUTS.items():
        yield WITHIN, name, render_scenes(digits(place), number, seed)
    yield WITHIN, "only sevens", render_scenes(digits(share=np.eye(10)[7]), number, seed)
    yield WITHIN, "nine or ten", render_scenes(digits(number=[0] * 9 + [1, 1]), number, seed)
    yield WITHIN, "one or two", render_scenes(digits(number=[0, 1, 1]), number, seed)
    yield WITHIN, "all turned by 30 degrees", render_scenes(digits(angle=multi_mnist.TURN), number, seed)
    yield BEYOND, "letters", letters(number, seed, False)
    yield BEYOND, "letters in a row", letters(number, seed, True)
    yield BEYOND, "all turned by 90 degrees", render_scenes(digits(angle=math.pi / 2), number, seed)
    images = render_scenes(model, number, seed + 1)
    yield BEYOND, "half as bright", images // 2
    for name, others in changed(images, seed):
        yield BEYOND, name, others
    yield (
        BEYOND,
        "aerial images",
        render_scenes(load_model("aerial2d"), number, seed).float().mean(1, keepdim=True).byte(),
    )
    for folder in folders:
        files = ImageFolder(folder, model.canvas, model.channels, skip_bad=True)
        yield BEYOND, folder.name, torch.stack([files.load(i) for i in range(min(number, len(files)))])


def cases_of_roads(number: int, seed: int) -> Iterator[tuple[str, str, Tensor]]:
    model = load_model("aerial2d")
    assert model.target is not None

    def roads(roads, cars) -> Tensor:
        return render_scenes(
            model, number, seed, StructurePrior(model.grammar, Roads=counts(*roads), Cars=counts(*cars))
        )

    yield WITHIN, "the model's own target", render_scenes(model.target(seed), number, seed)
    yield WITHIN, "one road without cars", roads([0, 1], [1])
    yield WITHIN, "three full roads", roads([0, 0, 0, 1], [0] * 7 + [1, 1])
    yield WITHIN, "four roads, a car each", roads([0, 0, 0, 0, 1], [0, 1])
    images = render_scenes(model, number, seed + 1)
    yield BEYOND, "red and blue exchanged", images.flip(1)
    yield BEYOND, "turned by 90 degrees", images.transpose(2, 3).contiguous()
    for name, others in changed(images, seed):
        yield BEYOND, name, others
    yield BEYOND, "digits", render_scenes(load_model("multi_mnist"), number, seed).expand(-1, 3, -1, -1).contiguous()


def main():
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--images", type=int, default=40, help="of each target")
    parser.add_argument("--scenes", type=int, default=160, help="of the prior")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--photographs", nargs="*", type=Path, default=[], metavar="FOLDER")
    args = parser.parse_args()
    look, right = EfficientNetLite(), []
    cases = {
        "multi_mnist": cases_of_digits(args.images, args.seed, args.photographs),
        "aerial2d": cases_of_roads(args.images, args.seed),
    }
    for name, each in cases.items():
        scenes = look.places(render_scenes(load_model(name), args.scenes, 100 + args.seed))
        for expected, case, images in each:
            sides = zip(look.places(images), scenes, (distance_outliers, patch_outliers), strict=True)
            shares = [float(by(real.numpy(), drawn.numpy()).mean()) for real, drawn, by in sides]
            right.append([expected == (BEYOND if share > 0.5 else WITHIN) for share in shares])
            wrong = "" if right[-1][1] else "  wrong"
            print(f"{name}, {expected}, {case}: {shares[1]:.2f} (whole images {shares[0]:.2f}){wrong}", flush=True)
    whole, what = np.sum(right, 0)
    print(f"Right: {what} of {len(right)}; by whole images {whole}.")


if __name__ == "__main__":
    main()
