"""Scenes in chunks of 64, each drawn from the seed and its own number alone, so that neither the number of images nor
that of the workers changes an image. Axis letters: N scenes, H W.
"""

from collections.abc import Iterator
from contextlib import contextmanager

import cv2
import numpy as np
import torch
from pyro.util import get_rng_state, set_rng_state
from torch import Tensor

from probscene.dataset import grey
from probscene.model import SceneModel
from probscene.policy import Policy
from probscene.sampling import Scenes, sample, seed_everything
from probscene.threads import threads

CHUNK = 64


@contextmanager
def chunk_randomness(seed: int, chunk: int) -> Iterator[None]:
    """The random numbers of one chunk; the generators' state from before is put back afterwards."""
    before = get_rng_state()
    words = [int(word) for word in np.random.SeedSequence(seed, spawn_key=(chunk,)).generate_state(3)]
    seed_everything(words[0])
    torch.manual_seed(words[1] << 32 | words[2])  # numpy's seed has 32 bits, in which many chunks would collide
    try:
        yield
    finally:
        set_rng_state(before)


def draw_chunk(model: SceneModel, policy: Policy, seed: int, chunk: int) -> Scenes:
    """The scenes of a chunk, all 64, without their ``log_prob``; the same whatever else the process does.

    Raises:
        SamplingError, ModelError: see ``sample``.
    """
    with threads(1), chunk_randomness(seed, chunk):
        return sample(model, policy, CHUNK, density=False)


def as_written(model: SceneModel, image: Tensor) -> Tensor:
    """What is written of renders ``(N, 3, H, W)``: themselves, or grey ``(N, 1, H, W)`` where colour carries nothing.

    A grey PNG is a third of the size, and readers that ask for colour (OpenCV's ``imread``, Pillow's
    ``convert("RGB")``, COCO loaders) give its three equal channels.
    """
    return grey(image) if model.channels == 1 else image


def png(image: Tensor) -> bytes:
    """The bytes of a file for ``image (C, H, W)`` uint8, grey or RGB."""
    pixels = image.permute(1, 2, 0).numpy()
    if pixels.shape[2] == 3:
        pixels = cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR)
    return cv2.imencode(".png", pixels)[1].tobytes()
