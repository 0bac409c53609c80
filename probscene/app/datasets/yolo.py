"""YOLO: labels in the folder layout of Ultralytics.

    data.yaml               names of the classes, from 0
    images/000000.png ...
    labels/000000.txt ...   one line an object: class cx cy w h, as shares of width and height; empty without objects

    yolo-seg/   data.yaml, images and labels likewise, a line: class x1 y1 x2 y2 ..., the corners of a polygon
    yolo-obb/   the same, a line: class x1 y1 x2 y2 x3 y3 x4 y4, the corners of an oriented box
    yolo-pose/  the same, a line: class cx cy w h x1 y1 v1 ..., keypoints with COCO's visibility; kpt_shape in data.yaml

A polygon holds the visible pixels and no others, see ``polygons``. Ultralytics draws its border too, which adds a pixel
to the right and below, and a line between the parts of an object that has several.

An oriented box is turned as the object's sprite is and touches what is visible; its corners are the sprite's upper left
one, then clockwise. Of meshes and of what a generator draws it is the smallest rectangle around the visible pixels.
Ultralytics refuses corners beyond the image, so these are moved to its border.

All lines with keypoints have as many of them; for classes that have fewer, zeros are added.

``data.yaml`` names the same images for training and validation; set another folder of images aside for the latter.
"""

import json
import math
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from probscene.batch import RenderBatch
from probscene.drawing import Drawing
from probscene.model import SceneModel
from probscene.request import Renderable

from .coco import labelled, node_margins
from .polygons import polygon
from .provenance import stem


def label_name(index: int, flat: bool = True) -> str:
    """The file of image number ``index``, relative to the dataset's folder; see ``stem``."""
    return f"labels/{stem(index, flat)}.txt"


def label(model: SceneModel, annotations: list[dict[str, Any]], keypoints: int = 0) -> str:
    """The lines of one image's COCO annotations, in their order, with so many keypoints each.

    Eight decimals: times a canvas of up to a million pixels and rounded, the corners are COCO's.
    """
    height, width = model.canvas
    lines = []
    for annotation in annotations:
        x, y, w, h = annotation["bbox"]
        line = _line(annotation["category_id"], ((x + w / 2) / width, (y + h / 2) / height, w / width, h / height))
        points = annotation.get("keypoints", []) if keypoints else []
        points = points + [0] * (3 * keypoints - len(points))
        for at in range(0, len(points), 3):
            line += f" {points[at] / width:.8f} {points[at + 1] / height:.8f} {points[at + 2]}"
        lines.append(line + "\n")
    return "".join(lines)


def polygons(model: SceneModel, batch: RenderBatch, min_visible: float = 0.0) -> list[str]:
    """The labels of rendered scenes with polygons.

    Args:
        min_visible: see ``coco.labelled``.
    """
    return _labels(model, batch, min_visible, lambda mask, i, node: polygon(mask))


def oriented(
    model: SceneModel,
    batch: RenderBatch,
    drawing: Renderable,
    min_visible: float = 0.0,
    box_margin: int | dict[str, int] = 0,
) -> list[str]:
    """The labels of rendered scenes with oriented boxes.

    Args:
        drawing: what was rendered.
        min_visible: see ``coco.labelled``.
        box_margin: pixels by which boxes are wider on each side, see ``checked_box_margin``.
    """
    angle, margin = _angles(drawing), node_margins(model, batch, box_margin)

    def corners(mask: np.ndarray, i: int, node: int) -> np.ndarray:
        return around(mask, float(angle[i, node]), float(margin[i, node]))

    return _labels(model, batch, min_visible, corners)


def around(mask: np.ndarray, angle: float, margin: float = 0.0) -> np.ndarray:
    """The corners ``(4, 2)`` of the oriented box around the pixels of ``mask (H, W)``, clockwise on the screen.

    Args:
        angle: of its upper edge, radians, anticlockwise as seen on the screen; of the smallest box where it is NaN.
        margin: pixels by which it is wider on each side.
    """
    points = np.argwhere(mask)[:, ::-1] + 0.5
    if math.isnan(angle):
        angle = -math.radians(cv2.minAreaRect(points.astype(np.float32))[2])
    axes = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])  # right and down
    turned = points @ axes.T
    reach = 0.5 + margin  # from the middle of a pixel
    (left, top), (right, bottom) = turned.min(0) - reach, turned.max(0) + reach
    return np.array([(left, top), (right, top), (right, bottom), (left, bottom)]) @ axes


def data(model: SceneModel, keypoints: int = 0) -> str:
    """``data.yaml``, of labels with so many keypoints; without ``path``, a reader looks beside the file."""
    names = "".join(f"  {i}: {json.dumps(name, ensure_ascii=False)}\n" for i, name in enumerate(model.classes))
    shape = f"kpt_shape: [{keypoints}, 3]\n" if keypoints else ""
    return f"train: images\nval: images\n{shape}names:\n{names}"


def _labels(model: SceneModel, batch: RenderBatch, min_visible: float, corners: Any) -> list[str]:
    """Labels whose lines are of ``corners(mask, scene, node)``, ``(K, 2)`` pixels."""
    category, found = labelled(model, batch, min_visible), []
    size = np.array(model.canvas[::-1])
    for i, instance in enumerate(batch.instance.numpy()):
        lines = []
        for node in category[i].nonzero()[:, 0].tolist():
            shares = np.clip(corners(instance == node + 1, i, node) / size, 0, 1) + 0.0  # no -0
            lines.append(_line(int(category[i, node]), shares.ravel()) + "\n")
        found.append("".join(lines))
    return found


def _line(category: int, numbers: Any) -> str:
    return " ".join([str(category - 1), *(f"{number:.8f}" for number in numbers)])


def _angles(drawing: Renderable) -> Tensor:
    """``(N, M)`` float32, how the nodes' sprites are turned, the first layer's of several; NaN where there is none."""
    angles = torch.full(drawing.kind.shape, torch.nan)
    for layer in drawing.layers if isinstance(drawing, Drawing) else ():
        if layer.labelled:
            angles = torch.where(angles.isnan() & layer.present, layer.angle, angles)
    return angles
