"""What a detector has found in the photographs that a model is begun from: further grounds, and distractors."""

from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from probscene.dataset import ImageFolder

from ..labels.annotations import Annotated, Annotation
from ..labels.boxes import place_on_canvas
from ..labels.naming import composed, matched
from ..labels.reading import read_annotations
from .cutouts import MAX_COVERED, Object, covered, overlaps

MIN_SCORE = 0.3  # of what is found where no label is, to be a distractor


class Photograph(NamedTuple):
    """A photograph as the canvas has it: ``(H, W, 3)`` uint8, and where objects are ``(H, W)``."""

    image: NDArray[np.uint8]
    there: NDArray[np.bool_]


class PhotographDetections(NamedTuple):
    """What was found in photographs.

    Attributes:
        labels: the detections.
        entries: by the photograph's file the number of its entry.
        notes: what a person should know, one sentence each.
    """

    labels: Annotated
    entries: dict[Path, int]
    notes: tuple[str, ...]

    def objects(self, folder: ImageFolder, i: int, min_score: float = 0.0) -> list[Object]:
        """Those found in photograph i of a folder with a score of at least that."""
        if folder.paths[i] not in self.entries:
            return []
        each = self.labels.read(self.entries[folder.paths[i]], folder.sizes[i])
        found = [
            object_on_canvas(one, folder, i, self.labels) for one in each if one.score is None or one.score >= min_score
        ]
        return [one for one in found if one is not None]

    def distractors(self, folder: ImageFolder, i: int, labelled: list[Object], name: str) -> list[Object]:
        """Those found where no label is, as objects of a class of that name."""
        found = self.objects(folder, i, MIN_SCORE)
        number, shares = len(found), overlaps([*found, *labelled])
        most = np.maximum(shares[:number, number:], shares[number:, :number].T).max(1, initial=0.0)
        return [Object(name, one.box) for one, share in zip(found, most, strict=True) if share <= MAX_COVERED]

    def photographs(self, files: list[Path], like: ImageFolder) -> list[Photograph]:
        """Photographs on the canvas of others."""
        if not files:
            return []
        folder = ImageFolder(files, like.canvas, 3, value_range=like.value_range)
        images = [folder.load(i).permute(1, 2, 0).contiguous().numpy() for i in range(len(folder))]
        return [Photograph(image, covered(self.objects(folder, i), folder.canvas)) for i, image in enumerate(images)]


def read_detections(path: Path | str, files: list[Path], photos: Path) -> PhotographDetections:
    """Detections in photographs.

    Args:
        files: the photographs.
        photos: their folder, for messages.

    Raises:
        DataError: see ``read_annotations`` and ``matched``.
    """
    labels = read_annotations(Path(path))
    pairs = matched(labels.images, files, photos, stems=labels.stems)
    return PhotographDetections(labels, {files[i]: entry for i, entry in pairs.entries.items()}, pairs.notes)


def object_on_canvas(one: Annotation, folder: ImageFolder, i: int, labels: Annotated) -> Object | None:
    """An object of photograph i as the canvas has it; None where its middle is not on it."""
    box = place_on_canvas(one, folder, i, 1.0 if labels.kitti else 0.0)
    if box is None:
        return None
    mask = None
    if one.mask is not None:
        (H, W), (top, left, height, width) = folder.canvas, folder.windows[i] or (0, 0, *folder.sizes[i])
        part = one.mask()[top : top + height, left : left + width].astype(np.uint8)
        mask = cv2.resize(part, (W, H), interpolation=cv2.INTER_NEAREST).astype(bool)
        mask = mask if mask.any() else None
    return Object(composed(one.name), box, mask)
