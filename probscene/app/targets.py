"""The images that a fit learns from: a folder, a list of files, or images in memory."""

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeGuard

from probscene.dataset import ImageFolder, Images
from probscene.image_array import ImageArray
from probscene.model import SceneModel

from .progress import Display

Target = Path | str | Sequence[Path | str] | Any
"""A folder, a list of files, an array or a dataset of images, see ``open_images``."""


@dataclass(frozen=True)
class TargetImages:
    """Images, and how they are read.

    Args:
        source: a folder, a list of files, or images in memory, see ``open_images``.
        skip_bad: leave out files that do not decode.
        value_range: the values of images of 16 bits that are read as black and white, such as ``(0, 4095)``; where
            None, what is found in the images, see ``ImageFolder``. A run keeps it.
        readings: detections in all of the images, with scores, as COCO's ``.json``: any detector's, by which a fit
            counts in the place of a network that is trained on renders.
    """

    source: Target
    skip_bad: bool | None = None
    value_range: Sequence[float] | None = None
    readings: Path | str | None = None


def open_images(
    target: Target,
    model: SceneModel,
    skip_bad: bool,
    show: Display,
    value_range: Sequence[float] | None = None,
) -> Images:
    """Images as a model reads them; notes on them are shown.

    Args:
        target: a folder, a list of files, or images in memory, see ``ImageArray``; images that are open already.
        value_range: of images of 16 bits, see ``ImageFolder``.

    Raises:
        DataError: see ``ImageFolder`` and ``ImageArray``.
    """
    if isinstance(target, Images):
        return target
    if _is_folder(target) or _is_list_of_files(target):
        reading = show.stage("reading")
        images: Images = ImageFolder(target, model.canvas, model.channels, skip_bad, reading, value_range)
    else:
        images = ImageArray(target, model.canvas, model.channels, value_range)
    say_notes(images.notes, show)
    return images


def say_notes(notes: Iterable[str], show: Display) -> None:
    """Say what a person should know about images or labels."""
    for note in notes:
        show.say(f"Note: {note}")


def _is_folder(target: Target) -> TypeGuard[Path]:
    return isinstance(target, str | os.PathLike)


def _is_list_of_files(target: Target) -> TypeGuard[list[Path]]:
    return isinstance(target, list | tuple) and all(isinstance(file, str | os.PathLike) for file in target)


def lasting_target(target: Target) -> str | list[str] | None:
    """What a run records of its target: paths that mean the same from every folder; None for images in memory."""
    if isinstance(target, ImageFolder):
        target = target.paths if target.listed else target.path
    if _is_folder(target):
        return str(Path(target).resolve())
    return [str(Path(file).resolve()) for file in target] if _is_list_of_files(target) else None
