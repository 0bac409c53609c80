"""Train a detector on labelled images, the same number of images whatever the set, and detect with it.

Everything random comes from the training's seed: the same bytes on one thread, whatever the number of processes, and
whether a training goes on from a checkpoint or was never interrupted.

Fine-tuning on few photographs forgets part of what many generated images have taught. So the weights after fine-tuning
are averaged with those before (WiSE-FT [1], with its mixing coefficient of 0.5).

Axis letters: N objects, H W.

References:
    [1] Wortsman et al., *Robust Fine-Tuning of Zero-Shot Models*, CVPR 2022.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from probscene.decoding import read_rgb
from probscene.device import device_of
from probscene.errors import ProbsceneError

from .detector import Recipe, pretrained_part
from .sets import Example

SCALES = (0.75, 1.33)  # images are shown at
SHIFT = 0.1  # of the image's sides
MIN_BOX_SIDE = 2.0  # pixels, and
MIN_BOX_FRACTION = 0.35  # of its box: objects of which the frame leaves less are dropped
COLOUR_JITTER = 0.25  # brightness, contrast and saturation change by so much
PADDING_VALUE = 127  # around the image
WARMUP_FRACTION = 0.05  # of the steps, in which the rate rises
MAX_GRAD_NORM = 10.0  # of the gradient's norm
IMAGE_CACHE_BYTES = 256 * 2**20  # bytes of images that are kept in memory


class Stage(NamedTuple):
    """A stage of a training: what is shown, and how long.

    Attributes:
        parts: examples by set; each part has the same share of the images shown.
        num_images: how many images are shown.
        rate_factor: of the recipe's learning rate.
        averages_weights: at its end the weights are the mean of those before and after it.
    """

    parts: tuple[tuple[Example, ...], ...]
    num_images: int
    rate_factor: float = 1.0
    averages_weights: bool = False


class Detections(NamedTuple):
    """What was found in one image: boxes ``(N, 4)`` in pixels of its file, left top right bottom; classes ``(N,)`` from
    0; scores ``(N,)``, from the highest."""

    boxes: NDArray[np.float32]
    classes: NDArray[np.int64]
    scores: NDArray[np.float32]


class Checkpoint(NamedTuple):
    """Where a training is, after a step.

    Attributes:
        stage: its number.
        steps: of this stage that are done.
        weights: the detector's state.
        weights_before: its state before this stage; empty where the stage does not average weights.
        optimizer: the state of this stage's.
        random: the state of torch's random numbers.
    """

    stage: int
    steps: int
    weights: dict[str, Tensor]
    weights_before: dict[str, Tensor]
    optimizer: dict[str, Any]
    random: Tensor


class Checkpoints(NamedTuple):
    """How an interrupted training goes on.

    Attributes:
        start: where it was interrupted.
        after_step: called after each step, with a function that gives a checkpoint; the tensors in it are those that
            are trained on, so write them before it returns.
    """

    start: Checkpoint | None = None
    after_step: Callable[[Callable[[], Checkpoint]], None] = lambda checkpoint: None


def train(
    detector: nn.Module,
    stages: Sequence[Stage],
    recipe: Recipe,
    size: tuple[int, int],
    seed: Sequence[int],
    shown: Callable[[int], None] = lambda number: None,
    value_range: tuple[float, float] | None = None,
    checkpoints: Checkpoints | None = None,
) -> None:
    """Train in place, stage after stage, each with an optimiser and a schedule of its own.

    Args:
        detector: on the device where it is trained.
        size: height and width at which images come.
        seed: words of it.
        shown: called with the number of images of each step; first, where there is a start, with those before it.
        value_range: of images of 16 bits, see ``read_rgb``.
        checkpoints: from its start the same training goes on to the same bytes.

    Raises:
        ProbsceneError: the loss is not finite.
    """
    checkpoints = checkpoints or Checkpoints()
    pictures, start = Pictures(size, value_range), checkpoints.start
    first = 0 if start is None else start.stage
    if start is not None:
        detector.load_state_dict(start.weights)
        torch.set_rng_state(start.random)
        here = min(start.steps * recipe.batch_size, stages[first].num_images)
        shown(here + sum(stage.num_images for stage in stages[:first]))
    for number, stage in enumerate(stages[first:], first):
        random = np.random.default_rng([*seed, number])
        _train_stage(detector, number, stage, recipe, pictures, random, shown, checkpoints)


def detect(
    detector: nn.Module,
    path: Path,
    size: tuple[int, int],
    first: int,
    value_range: tuple[float, float] | None = None,
) -> Detections:
    """What a trained detector finds in an image's file.

    Args:
        first: see ``Recipe``.
        value_range: see ``read_rgb``.
    """
    return detect_in(detector, read_rgb(path, value_range), size, first)


def detect_in(detector: nn.Module, image: NDArray[np.uint8], size: tuple[int, int], first: int) -> Detections:
    """``detect``, in an image ``(H, W, 3)``."""
    small, scale = fitted(image, size)
    with torch.no_grad():
        output = detector.eval()([_tensor(small).to(device_of(detector))])[0]
    found = {key: output[key].cpu().numpy() for key in ("boxes", "labels", "scores")}
    boxes = found["boxes"] / scale
    boxes = np.clip(boxes, 0, np.array([image.shape[1], image.shape[0]] * 2, np.float32))
    return Detections(boxes.astype(np.float32), found["labels"] - first, found["scores"])


def fitted(image: NDArray[np.uint8], size: tuple[int, int]) -> tuple[NDArray[np.uint8], float]:
    """An image ``(H, W, 3)`` at the top left of a frame of ``size``, as large as it goes in there, and its scale."""
    scale = min(size[0] / image.shape[0], size[1] / image.shape[1])
    height, width = (max(1, round(side * scale)) for side in image.shape[:2])
    frame = np.full((*size, 3), PADDING_VALUE, np.uint8)
    how = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    frame[:height, :width] = cv2.resize(image, (width, height), interpolation=how)
    return frame, scale


class Pictures:
    """Images as they are shown: each is read once, as far as memory goes."""

    def __init__(self, size: tuple[int, int], value_range: tuple[float, float] | None = None):
        self.size, self.value_range, self._kept = size, value_range, {}
        self._room = IMAGE_CACHE_BYTES // (3 * math.prod(size))

    def __call__(self, example: Example) -> tuple[NDArray[np.uint8], float]:
        """See ``fitted``."""
        if example.path not in self._kept:
            found = fitted(read_rgb(example.path, self.value_range), self.size)
            if len(self._kept) >= self._room:
                return found
            self._kept[example.path] = found
        return self._kept[example.path]


class Augmentation(NamedTuple):
    """How an image is shown once.

    Attributes:
        scale: times its size in the frame.
        mirrored: left and right are swapped.
        right, down: how far its middle moves, shares of the frame's sides.
        gain, contrast, colour: factors of brightness, contrast and saturation.
    """

    scale: float
    mirrored: bool
    right: float
    down: float
    gain: float
    contrast: float
    colour: float


def draw_augmentation(random: np.random.Generator) -> Augmentation:
    """One by chance, whatever the image."""
    scale = math.exp(random.uniform(math.log(SCALES[0]), math.log(SCALES[1])))
    mirrored = bool(random.random() < 0.5)
    right, down = random.uniform(-SHIFT, SHIFT), random.uniform(-SHIFT, SHIFT)
    return Augmentation(scale, mirrored, right, down, *random.uniform(1 - COLOUR_JITTER, 1 + COLOUR_JITTER, 3))


def augmented(
    example: Example, pictures: Pictures, how: Augmentation
) -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.int64]]:
    """An image ``(H, W, 3)`` as a training sees it once, mirrored, moved, scaled and lit, and the boxes ``(N, 4)`` and
    classes ``(N,)`` of its objects."""
    image, fit = pictures(example)
    height, width = pictures.size
    scale, across = how.scale, -how.scale if how.mirrored else how.scale
    # The frame's middle comes near the frame's middle.
    x = width / 2 + how.right * width - across * width / 2
    y = height / 2 + how.down * height - scale * height / 2
    move = np.array([[across, 0, x + (across - 1) / 2], [0, scale, y + (scale - 1) / 2]])  # of pixels' middles
    image = cv2.warpAffine(image, move, (width, height), flags=cv2.INTER_LINEAR, borderValue=(PADDING_VALUE,) * 3)
    boxes, classes = example.boxes[example.real] * fit, example.classes[example.real]
    ends = np.sort(boxes[:, [0, 2]] * across + x, 1), boxes[:, [1, 3]] * scale + y
    whole = np.stack([ends[0][:, 0], ends[1][:, 0], ends[0][:, 1], ends[1][:, 1]], 1)
    cut = np.clip(whole, 0, [width, height, width, height])
    sides, before = cut[:, 2:] - cut[:, :2], whole[:, 2:] - whole[:, :2]
    stay = (sides.min(1, initial=np.inf) >= MIN_BOX_SIDE) & (sides.prod(1) >= MIN_BOX_FRACTION * before.prod(1))
    return _lit(image, how), cut[stay].astype(np.float32), classes[stay]


def order(parts: tuple[tuple[Example, ...], ...], number: int, random: np.random.Generator) -> Iterator[Example]:
    """``number`` examples, the parts in turn, each part's again and again in an order by chance."""
    streams = [_again(part, random) for part in parts]
    for i in range(number):
        yield next(streams[i % len(streams)])


def _again(part: tuple[Example, ...], random: np.random.Generator) -> Iterator[Example]:
    while True:
        for i in random.permutation(len(part)):
            yield part[i]


def _train_stage(
    detector: Any,
    number: int,
    stage: Stage,
    recipe: Recipe,
    pictures: Pictures,
    random: np.random.Generator,
    shown: Callable[[int], None],
    checkpoints: Checkpoints,
) -> None:
    body = {id(p) for p in pretrained_part(detector).parameters()}
    groups = [[p for p in detector.parameters() if p.requires_grad and (id(p) in body) == of] for of in (False, True)]
    rate = recipe.learning_rate * stage.rate_factor
    rates = (rate, rate * recipe.backbone_factor)
    adam = torch.optim.Adam([{"params": g, "lr": r} for g, r in zip(groups, rates, strict=True)], fused=True)
    steps = math.ceil(stage.num_images / recipe.batch_size)
    start, done_before, weights_before = checkpoints.start, 0, {}
    if stage.averages_weights:
        weights_before = {key: value.clone() for key, value in detector.state_dict().items()}
    if start is not None and start.stage == number:
        adam.load_state_dict(start.optimizer)
        done_before = start.steps
        weights_before = {key: value.to(device_of(detector)) for key, value in start.weights_before.items()}
    detector.train()
    device = device_of(detector)
    examples, left = order(stage.parts, stage.num_images, random), stage.num_images
    for step in range(steps):
        batch = [next(examples) for _ in range(min(recipe.batch_size, left))]
        how = [draw_augmentation(random) for _ in batch]
        left -= len(batch)
        if step < done_before:  # all that is drawn is drawn again
            continue
        for group, highest in zip(adam.param_groups, rates, strict=True):
            group["lr"] = highest * _schedule((step + 1) / steps)
        images, targets = [], []
        for example, each in zip(batch, how, strict=True):
            image, boxes, classes = augmented(example, pictures, each)
            images.append(_tensor(image).to(device))
            labels = torch.from_numpy(classes) + recipe.first_label
            target = {"boxes": torch.from_numpy(boxes).reshape(-1, 4), "labels": labels}
            targets.append({key: value.to(device) for key, value in target.items()})
        loss = torch.stack([*detector(images, targets).values()]).sum()
        if not torch.isfinite(loss):
            raise ProbsceneError("expected a finite loss of the detector, got one that is not; give a lower --rate.")
        adam.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_([p for group in groups for p in group], MAX_GRAD_NORM)
        adam.step()
        done = step + 1
        checkpoints.after_step(
            lambda done=done: Checkpoint(
                number, done, detector.state_dict(), weights_before, adam.state_dict(), torch.get_rng_state()
            )
        )
        shown(len(batch))
    for key, value in detector.state_dict().items():
        if key in weights_before and value.is_floating_point():
            value.lerp_(weights_before[key], 0.5)


def _schedule(progress: float) -> float:
    """The learning rate, as a share of its highest, at a share of the steps: linear warm-up, then a cosine."""
    if progress < WARMUP_FRACTION:
        return progress / WARMUP_FRACTION
    return 0.5 * (1 + math.cos(math.pi * (progress - WARMUP_FRACTION) / (1 - WARMUP_FRACTION)))


def _lit(image: NDArray, how: Augmentation) -> NDArray[np.uint8]:
    pixels = image.astype(np.float32) * how.gain
    pixels = (pixels - pixels.mean()) * how.contrast + pixels.mean()
    pale = pixels.mean(2, keepdims=True)
    return np.clip((pixels - pale) * how.colour + pale, 0, 255).astype(np.uint8)


def _tensor(image: NDArray[np.uint8]) -> Tensor:
    """``(3, H, W)`` in 0..1."""
    return torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1))).float() / 255
