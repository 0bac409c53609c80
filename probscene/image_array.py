"""Images in memory as a target: an array, or a torch dataset of images. Axis letters: L images, C H W."""

import hashlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from .dataset import Images, grey, part_of
from .decoding import eight_bit, fitted, window
from .errors import DataError


class ImageArray(Images):
    """Images in memory, cut and resized to the canvas as those of an ``ImageFolder`` are.

    Args:
        images: ``(L, H, W, 1 or 3)`` or ``(L, H, W)`` uint8 in numpy; or anything that has a length and gives by number
            an image or a tuple that begins with one, such as a torch dataset: ``(H, W, 1 or 3)`` or ``(H, W)`` uint8 in
            numpy, ``(1 or 3, H, W)`` uint8 in torch or float from 0 to 1, or a Pillow image.
        canvas: height and width, pixels.
        channels: 1 for grey (``grey``), 3 for RGB.

    Raises:
        DataError: no image, or one of another type or shape.
    """

    def __init__(self, images: Any, canvas: tuple[int, int], channels: int):
        self.canvas, self.channels, self.path = (canvas[0], canvas[1]), channels, Path("images in memory")
        each = [_array(image, i) for i, image in enumerate(_items(images))]
        if not each:
            raise DataError("Expected images to learn from, actual none; give at least one.")
        self.sizes = [(image.shape[0], image.shape[1]) for image in each]
        self.windows = [window(size, self.canvas) for size in self.sizes]
        self.paths = [Path(f"image {i}") for i in range(len(each))]
        self._whole, self.bad = each, {}
        digest = hashlib.sha256(repr((self.canvas, channels)).encode())
        pictures = set()
        for image in each:
            one = hashlib.sha256(repr(image.shape).encode() + np.ascontiguousarray(image).tobytes()).digest()
            digest.update(one)
            pictures.add(one)
        self.fingerprint, self.distinct = digest.hexdigest(), len(pictures)
        others = sum(size != self.canvas for size in self.sizes)
        note = f"{others} of {len(each)} images have another size than {canvas[1]}x{canvas[0]}; they are resized."
        self.notes = (note,) if others else ()

    def load(self, i: int, view: int = 0) -> Tensor:
        """Image number ``i``, ``(C, H, W)`` uint8; see ``Images.load``."""
        # A copy: the array may be one that nobody may write.
        image = torch.tensor(fitted(self._whole[i], self.canvas, part_of(i, view) if view else None))
        return grey(image.expand(3, -1, -1)) if self.channels == 1 else image.expand(3, -1, -1).contiguous()


def _items(images: Any) -> Iterable[Any]:
    """The images one by one.

    Raises:
        DataError: an array of another shape, or what has no length or no items by number.
    """
    if isinstance(images, np.ndarray | Tensor) and images.ndim not in (3, 4):
        raise DataError(f"Expected an array of images (L, H, W, C) or (L, H, W), actual shape {tuple(images.shape)}.")
    try:
        number = len(images)
    except (TypeError, NotImplementedError):
        number = -1
    if number < 0 or not hasattr(images, "__getitem__") or isinstance(images, Mapping):
        raise DataError(
            "Expected as target a folder, a list of files, an array of images or a dataset with a length and images by "
            f"number, actual {type(images).__name__}; make a list of it."
        )
    return (_item(images, i) for i in range(number))


def _item(images: Any, i: int) -> Any:
    try:
        return images[i]
    except NotImplementedError as error:
        raise DataError(
            f"Expected a dataset that gives images by number, actual {type(images).__name__}, which does not; make a "
            "list of its images."
        ) from error


def _array(image: Any, i: int) -> np.ndarray:
    """``(H, W)`` or ``(H, W, 3)`` uint8."""
    if isinstance(image, tuple | list) and len(image):
        image = image[0]
    if isinstance(image, Tensor):
        if image.ndim == 3 and image.shape[0] in (1, 3):
            image = image.permute(1, 2, 0)
        if image.is_floating_point() and bool(((image >= 0) & (image <= 1)).all()):
            image = (image * 255).round().to(torch.uint8)
        image = image.detach().cpu().numpy()
    if isinstance(image, Image.Image):
        image = eight_bit(image)
    found = np.asarray(image)
    found = found[..., 0] if found.ndim == 3 and found.shape[2] == 1 else found
    if found.dtype != np.uint8 or (found.ndim != 2 and found.shape[2:] != (3,)) or not found.size:
        raise DataError(
            f"Expected image {i} as (H, W), (H, W, 1) or (H, W, 3) uint8, or a torch tensor (1 or 3, H, W) of uint8 or "
            f"of floats from 0 to 1, actual {found.dtype} {found.shape}; convert it before."
        )
    return found
