"""The reader of labels with boxes: which format a path has."""

from pathlib import Path

from probscene.errors import DataError

from .annotations import Annotated
from .coco import read_coco
from .kitti import read_kitti
from .yolo import names_file, read_yolo

ANNOTATIONS, KITTI = "annotations.json", "label_2"
YAML = (".yaml", ".yml")


def has_boxes(path: Path) -> bool:
    """Whether a path is of labels with boxes: a folder, a ``.json`` or a ``.yaml``."""
    return path.is_dir() or path.suffix.lower() in (".json", *YAML)


def read_annotations(path: Path) -> Annotated:
    """The labels with boxes at a path.

        FILE.json, or a folder with annotations.json        COCO
        a folder label_2, or one that has it                KITTI
        data.yaml, or a folder of YOLO's labels             YOLO
        another folder of text files                        KITTI

    Raises:
        DataError: see ``read_coco``, ``read_kitti`` and ``read_yolo``.
    """
    if not path.is_dir():
        if not path.exists():
            raise DataError(f"expected a file of labels at {path}, got none.")
        return read_yolo(path, path) if path.suffix.lower() in YAML else read_coco(path)
    if (path / ANNOTATIONS).is_file():
        return read_coco(path / ANNOTATIONS)
    if path.name == KITTI or (path / KITTI).is_dir():
        return read_kitti(path if path.name == KITTI else path / KITTI)
    names = names_file(path)
    return read_kitti(path) if names is None else read_yolo(path, names)


def label_files(path: Path) -> tuple[Path, ...]:
    """The files that labels of any kind are read from."""
    return read_annotations(path).files if path.is_dir() or path.suffix.lower() in YAML else (path,)
