"""KITTI: labels of its object detection benchmark, and the instance masks of its semantics benchmark of 2015.

    Kitti/raw/training/image_2/000000.png ...
    Kitti/raw/training/label_2/000000.txt ...    one line an object, empty without objects
    Kitti/raw/training/instance/000000.png ...   16 bits: 256 * class + instance, 0 where there is no object

``torchvision.datasets.Kitti(out)`` reads the dataset's folder as it is. What KITTI measures in the world (alpha,
dimensions, location, rotation) has KITTI's own values for unknown: -10, -1, -1000, -10. Boxes are left, top, right,
bottom in pixels, ends exclusive. ``truncated`` is the share of the amodal box beyond the canvas. ``occluded`` goes by
the visible fraction over the share within the canvas: 0 from 0.9 on, 1 from 0.5 on, 2 below. Where the canvas cuts an
object, that share is its box's, not its silhouette's: what only the canvas cuts may come out as 1, seldom as 2.

Classes count from 1, and each class's instances from 1 in the order of its lines, as in the benchmark. A grammar's
names hold no space, so they are KITTI's types as they are.
"""

from typing import Any

import cv2
import numpy as np

from probscene.app.coco import labelled
from probscene.batch import RenderBatch
from probscene.errors import ProbsceneError
from probscene.model import SceneModel

MOST = 255  # classes, and instances of a class: 8 bits each
_UNKNOWN = "-1 -1 -1 -1000 -1000 -1000 -10"


def file_name(folder: str, index: int) -> str:
    """The file of image number ``index`` in ``image_2``, ``label_2`` or ``instance``, relative to the dataset."""
    return f"Kitti/raw/training/{folder}/{index:06d}.{'txt' if folder == 'label_2' else 'png'}"


def check(model: SceneModel) -> None:
    """See that the model's classes have a number.

    Raises:
        ProbsceneError: more than 255 of them.
    """
    if len(model.classes) > MOST:
        raise ProbsceneError(
            f"Expected at most {MOST} classes, for 8 bits of KITTI's masks, actual {len(model.classes)} in model "
            f"{model.name!r}; choose other formats."
        )


def label(model: SceneModel, annotations: list[dict[str, Any]]) -> str:
    """The lines of one image's COCO annotations, in their order."""
    lines = []
    for annotation in annotations:
        within = _share_within(annotation["amodal_bbox"], model.canvas)
        seen = annotation["visible_fraction"] / within
        x, y, w, h = annotation["bbox"]
        name = model.classes[annotation["category_id"] - 1]
        level = 0 if seen >= 0.9 else 1 if seen >= 0.5 else 2
        lines.append(f"{name} {1 - within:.2f} {level} -10 {x:.2f} {y:.2f} {x + w:.2f} {y + h:.2f} {_UNKNOWN}\n")
    return "".join(lines)


def instances(model: SceneModel, batch: RenderBatch, first: int) -> list[bytes]:
    """The mask files of rendered scenes.

    Args:
        batch: the renders, of images ``first``, ``first + 1``, ...

    Raises:
        ProbsceneError: more than 255 objects of a class in an image.
    """
    files = []
    for i, category in enumerate(labelled(model, batch).numpy()):
        of_node = np.zeros(len(category) + 1, np.uint16)  # by the renderer's ids: 0, then node index + 1
        for number in np.unique(category[category > 0]):
            nodes = np.flatnonzero(category == number)
            if len(nodes) > MOST:
                raise ProbsceneError(
                    f"Expected at most {MOST} objects of a class in an image, for 8 bits of KITTI's masks, actual "
                    f"{len(nodes)} of class {model.classes[number - 1]!r} in image {first + i}; write other formats to "
                    "another folder."
                )
            of_node[nodes + 1] = 256 * number + np.arange(1, len(nodes) + 1)
        files.append(cv2.imencode(".png", of_node[batch.instance[i].numpy()])[1].tobytes())
    return files


def _share_within(box: list[int], canvas: tuple[int, int]) -> float:
    """Which share of a box, corner and size, lies on the canvas of height and width."""
    x, y, w, h = box
    height, width = canvas
    return (min(x + w, width) - max(x, 0)) * (min(y + h, height) - max(y, 0)) / (w * h)
