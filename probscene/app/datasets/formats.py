"""Which formats a dataset is written in: those asked for, and those that a finished folder holds.

    coco        annotations.json
    panoptic    panoptic.json, and panoptic/000000.png ...
    yolo        labels/000000.txt ... and data.yaml
    yolo-seg    yolo-seg/ with images, labels and data.yaml
    yolo-obb    yolo-obb/ likewise
    yolo-pose   yolo-pose/ likewise, of renders with keypoints
    kitti       Kitti/raw/training/ with image_2, label_2 and instance, and calib of 3D scenes
    webdataset  shard-000000.tar ..., images and labels together
    depth       depth/000000.png ..., of renders that have it
    images      no labels

All are written from the same renders and share ``images/``: the image files of KITTI, of ``yolo-seg/`` and the like are
hard links to those there, copies where the file system has none. Shards hold images of their own; for them alone, no
``images/`` is written.
"""

from collections.abc import Callable, Iterable

from probscene.errors import ProbsceneError

FORMATS = ("coco", "panoptic", "yolo", "yolo-seg", "yolo-obb", "yolo-pose", "kitti", "webdataset", "depth", "images")
# By which a finished dataset is known to have a format: without one a second call would see other settings.
MARKER_FILES = {
    "coco": "annotations.json",
    "panoptic": "panoptic.json",
    "yolo": "data.yaml",
    "yolo-seg": "yolo-seg",
    "yolo-obb": "yolo-obb",
    "yolo-pose": "yolo-pose",
    "kitti": "Kitti",
    "webdataset": "shard-000000.tar",
    "depth": "depth",
}


def parse_formats(format: str | Iterable[str]) -> tuple[str, ...]:
    """The formats that are asked for, each once, in the order of ``FORMATS``.

    Args:
        format: names, each of which may be several with commas between them.

    Raises:
        ProbsceneError: an unknown name, or none.
    """
    names = [name.strip() for part in ([format] if isinstance(format, str) else format) for name in part.split(",")]
    unknown = [name for name in names if name not in FORMATS]
    if unknown or not names:
        actual = repr(unknown[0]) if unknown else "none"
        raise ProbsceneError(f"expected formats among {', '.join(FORMATS)}, got {actual}.")
    return _normal(names)


def detect_formats(exists: Callable[[str], bool]) -> tuple[str, ...]:
    """The formats of a finished dataset, as ``parse_formats`` gives them.

    Args:
        exists: whether the dataset has a file or folder of a name.
    """
    names = [name for name, mark in MARKER_FILES.items() if exists(mark)]
    return _normal([*names, *(["images"] if exists("images") else [])])


def _normal(names: list[str]) -> tuple[str, ...]:
    """``images`` adds something to shards alone: the other formats have that folder anyway."""
    implied = set(names) - {"webdataset", "images"}
    return tuple(name for name in FORMATS if name in names and not (name == "images" and implied))
