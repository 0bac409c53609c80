"""Images in memory as a target: an array, or a torch dataset of images. Axis letters: L images, C H W."""

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from .dataset import Images, common_range, grey, part_of
from .decoding import eight_bit, fitted, largest, opaque, quiet, stored, turned, window
from .errors import DataError
from .image_bytes import ORIENTATION, Fault, orientation_of

_READ_AS_FILES = ("PNG", "JPEG", "MPO", "TIFF")  # formats of Pillow


class ImageArray(Images):
    """Images in memory, cut and resized to the canvas as those of an ``ImageFolder`` are.

    Args:
        images: ``(L, H, W, 1 or 3)`` or ``(L, H, W)`` in numpy; or anything that has a length and gives by number an
            image or a tuple that begins with one, such as a torch dataset: ``(H, W, 1 or 3)`` or ``(H, W)`` in numpy,
            uint8 or uint16; ``(1 or 3, H, W)`` in torch, uint8 or float from 0 to 1; or a Pillow image, which is turned
            upright by its EXIF tag.
        canvas: height and width, pixels.
        channels: 1 for grey (``grey``), 3 for RGB.
        value_range: see ``ImageFolder``.

    Raises:
        DataError: no image, or one of another type or shape; a single image, not in a list; a range that is none.
    """

    def __init__(
        self,
        images: Any,
        canvas: tuple[int, int],
        channels: int,
        value_range: Sequence[float] | None = None,
    ):
        self.canvas, self.channels, self.path = (canvas[0], canvas[1]), channels, Path("images in memory")
        with quiet():
            each = [_array(image, i) for i, image in enumerate(_items(images))]
        if not each:
            raise DataError("expected images to learn from, got none; give at least one.")
        peaks = [largest(image) if image.dtype == np.uint16 else None for image in each]
        self.value_range, of_range = common_range(peaks, value_range)
        each = [eight_bit(image, self.value_range) for image in each]
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
        self.notes = (*((note,) if others else ()), *of_range)

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
        raise DataError(f"expected an array of images (L, H, W, C) or (L, H, W), got shape {tuple(images.shape)}.")
    if isinstance(images, np.ndarray | Tensor) and images.ndim == 3 and _looks_like_one(images):
        raise DataError(
            f"expected an array of images (L, H, W, C) or (L, H, W), got shape {tuple(images.shape)}, which looks "
            "like one image. Give array[None] for one image, or a list of its images for several that are grey."
        )
    try:
        number = len(images)
    except (TypeError, NotImplementedError):
        number = -1
    if number < 0 or not hasattr(images, "__getitem__") or isinstance(images, Mapping):
        raise DataError(
            "expected as target a folder, a list of files, an array of images or a dataset with a length and images by "
            f"number, got {type(images).__name__}; make a list of it."
        )
    return (_item(images, i) for i in range(number))


def _looks_like_one(images: np.ndarray | Tensor) -> bool:
    """Whether what can be grey images ``(L, H, W)`` is as a single one in colour or grey is."""
    first, _, last = images.shape
    return last in (1, 3, 4) or (isinstance(images, Tensor) and first == 3)


def _item(images: Any, i: int) -> Any:
    try:
        return images[i]
    except NotImplementedError as error:
        raise DataError(
            f"expected a dataset that gives images by number, got {type(images).__name__}, which does not; make a "
            "list of its images."
        ) from error


def _array(image: Any, i: int) -> np.ndarray:
    """``(H, W)`` or ``(H, W, 3)`` uint8 or uint16; with opacity ``(H, W, 4)`` uint16."""
    if isinstance(image, tuple | list) and len(image):
        image = image[0]
    if isinstance(image, Tensor):
        if image.ndim == 3 and image.shape[0] in (1, 3):
            image = image.permute(1, 2, 0)
        if image.is_floating_point() and bool(((image >= 0) & (image <= 1)).all()):
            image = (image * 255).round().to(torch.uint8)
        image = image.detach().cpu().numpy()
    if isinstance(image, Image.Image):
        return _of_pillow(image, i)
    found = np.asarray(image)
    found = found[..., 0] if found.ndim == 3 and found.shape[2] == 1 else found
    if found.dtype not in (np.uint8, np.uint16) or (found.ndim != 2 and found.shape[2:] != (3,)) or not found.size:
        raise DataError(
            f"expected image {i} as (H, W), (H, W, 1) or (H, W, 3) of uint8 or uint16, or a torch tensor (1 or 3, H, "
            f"W) of uint8 or of floats from 0 to 1, got {found.dtype} {found.shape}; convert it before."
        )
    return found


def _of_pillow(image: Image.Image, i: int) -> np.ndarray:
    """See ``_array``.

    Raises:
        DataError: it does not decode, or has pixels of another kind.
    """
    try:
        file = getattr(image, "fp", None)
        undecoded = bool(getattr(image, "tile", None))
        if file is not None and image.format in _READ_AS_FILES and undecoded and not image.tell():
            # Nothing of it is decoded, so nothing is changed: it is read as any other file is.
            place = file.tell()
            file.seek(0)
            data = file.read()
            file.seek(place)
            return stored(data)[0]
        image.load()
        exif = image.info.get("exif")
        orientation = orientation_of(exif) if isinstance(exif, bytes) else image.getexif().get(ORIENTATION, 1)
        orientation = orientation if orientation in range(1, 9) else 1
        if image.mode == "F":
            raise Fault("has floating-point values")
        if not image.mode.startswith("I"):
            return turned(opaque(image), orientation)
        values = np.asarray(image)
        if values.min() < 0 or values.max() > 2**16 - 1:
            raise Fault(f"has values from {values.min()} to {values.max()}")
        return turned(values.astype(np.uint16), orientation)
    except (Fault, OSError, SyntaxError, ValueError) as error:
        fault = error if isinstance(error, Fault) else f"does not decode ({error})"
        raise DataError(f"expected image {i} to have pixels of 8 or 16 bits, got one that {fault}.") from error
