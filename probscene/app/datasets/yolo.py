"""YOLO: detection labels in the folder layout of Ultralytics.

    data.yaml               names of the classes, from 0
    images/000000.png ...
    labels/000000.txt ...   one line an object: class cx cy w h, as shares of width and height; empty without objects

Boxes alone: YOLO's masks are polygons, which hold neither holes nor parts, so a visible mask would not come back.
``data.yaml`` names the same images for training and validation; set another folder of images aside for the latter.
"""

import json
from typing import Any

from probscene.model import SceneModel

from .provenance import stem


def label_name(index: int, flat: bool = True) -> str:
    """The file of image number ``index``, relative to the dataset's folder; see ``stem``."""
    return f"labels/{stem(index, flat)}.txt"


def label(model: SceneModel, annotations: list[dict[str, Any]]) -> str:
    """The lines of one image's COCO annotations, in their order.

    Eight decimals: times a canvas of up to a million pixels and rounded, the corners are COCO's.
    """
    height, width = model.canvas
    lines = []
    for annotation in annotations:
        x, y, w, h = annotation["bbox"]
        numbers = ((x + w / 2) / width, (y + h / 2) / height, w / width, h / height)
        lines.append(" ".join([str(annotation["category_id"] - 1), *(f"{number:.8f}" for number in numbers)]) + "\n")
    return "".join(lines)


def data(model: SceneModel) -> str:
    """``data.yaml``; without ``path``, a reader looks beside the file."""
    names = "".join(f"  {i}: {json.dumps(name, ensure_ascii=False)}\n" for i, name in enumerate(model.classes))
    return f"train: images\nval: images\nnames:\n{names}"
