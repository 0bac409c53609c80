"""KITTI: labels of its object detection benchmarks, and the instance masks of its semantics benchmark of 2015.

    Kitti/raw/training/image_2/000000.png ...
    Kitti/raw/training/label_2/000000.txt ...    one line an object, empty without objects
    Kitti/raw/training/instance/000000.png ...   16 bits: 256 * class + instance, 0 where there is no object
    Kitti/raw/training/calib/000000.txt ...      of 3D scenes: P0 to P3, R0_rect, Tr_velo_to_cam, Tr_imu_to_velo

``torchvision.datasets.Kitti(out)`` reads the dataset's folder as it is. ``truncated`` is the share of the amodal box
beyond the canvas. Classes count from 1, and each class's instances from 1 in the order of its lines, as in the
benchmark. A grammar's names hold no space, so they are types as they are.

Of 2D scenes, what KITTI measures in the world (alpha, dimensions, location, rotation) has KITTI's own values for
unknown: -10, -1, -1000, -10. Boxes are left, top, right, bottom of what is visible, in pixels from the canvas's corner,
ends exclusive. ``occluded`` goes by the visible fraction over the share within the canvas: 0 from 0.9 on, 1 from 0.5
on, 2 below. Where the canvas cuts an object, that share is its box's, not its silhouette's: what only the canvas cuts
may come out as 1, seldom as 2. Where a generator does not tell them, ``truncated`` is -1 and ``occluded`` 3, unknown.

Of 3D scenes, everything is as in the benchmark. A class that one of KITTI's types counts as (``labels.kitti.TYPES``)
is written as that type. The 2D box is the whole silhouette's, what others cover included, within the image: KITTI's own
boxes of hidden cars are as near to their projected 3D boxes as those of free ones, half a pixel. (So its boxes of cars
are projections, a few pixels wider than a silhouette, which does not reach its 3D box's corners.) Its pixels are P2's,
the middle of the upper left one is (0, 0): 0.5 less than from the canvas's corner, and no end is beyond the middle of
the last pixel. ``occluded`` goes by the visible fraction, which is of the silhouette within the canvas. Location is the
middle of the 3D box's bottom in the camera's axes, ``rotation_y`` turns about the camera's y axis, so that under a
camera that is pitched or rolled the box stands as that camera does; ``alpha`` is ``rotation_y`` less the direction
``atan2(x, z)`` in which the object is seen. There is one camera, so that P0 to P3 are all ``[K | 0]``; the velodyne is
where the camera is, its axes forward, left and up, and the IMU where that is.
"""

import math
from typing import Any

import cv2
import numpy as np
from torch import Tensor

from probscene.batch import RenderBatch
from probscene.errors import ProbsceneError
from probscene.model import SceneModel

from ..labels.kitti import TYPES
from .coco import labelled

MAX_INSTANCES = 255  # classes, and instances of a class: 8 bits each
_UNSEEN = 3  # level of occlusion that is unknown
_UNKNOWN = "-1 -1 -1 -1000 -1000 -1000 -10"
_TYPE = {name: type for type, names in reversed(TYPES.items()) for name in names}
_VELO_TO_CAM = [[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0]]


def file_name(folder: str, index: int) -> str:
    """The file of image number ``index`` in ``image_2``, ``label_2``, ``instance`` or ``calib``, relative to the
    dataset."""
    return f"Kitti/raw/training/{folder}/{index:06d}.{'txt' if folder in ('label_2', 'calib') else 'png'}"


def check(model: SceneModel) -> None:
    """See that the model's classes have a number.

    Raises:
        ProbsceneError: more than 255 of them.
    """
    if len(model.classes) > MAX_INSTANCES:
        raise ProbsceneError(
            f"expected at most {MAX_INSTANCES} classes, for 8 bits of KITTI's masks, got {len(model.classes)} in model "
            f"{model.name!r}; choose other formats."
        )


def check_box_margin(model: SceneModel, batch: RenderBatch, box_margin: int | dict[str, int]) -> None:
    """See that boxes have no margin where KITTI's are of whole silhouettes.

    Raises:
        ProbsceneError: a margin in 3D.
    """
    if box_margin and batch.space is not None:
        raise ProbsceneError(
            f"expected no box_margin in KITTI's labels of the 3D model {model.name!r}, whose boxes there are of whole "
            f"silhouettes, got {box_margin}; leave it out, or choose other formats."
        )


def label(model: SceneModel, annotations: list[dict[str, Any]]) -> str:
    """The lines of one image's COCO annotations, in their order."""
    return "".join(
        (_in_space if "box_3d" in annotation else _in_plane)(
            model.classes[annotation["category_id"] - 1], annotation, model.canvas
        )
        for annotation in annotations
    )


def calib(intrinsics: Tensor) -> str:
    """The calibration file of an image.

    Args:
        intrinsics: ``(3, 3)``.
    """
    projection = np.pad(intrinsics.double().numpy(), ((0, 0), (0, 1)))
    matrices = {f"P{i}": projection for i in range(4)} | {
        "R0_rect": np.eye(3),
        "Tr_velo_to_cam": np.array(_VELO_TO_CAM, float),
        "Tr_imu_to_velo": np.eye(3, 4),
    }
    return "".join(f"{name}: {' '.join(f'{v:.12e}' for v in m.ravel())}\n" for name, m in matrices.items())


def instances(model: SceneModel, batch: RenderBatch, first: int, min_visible: float = 0.0) -> list[bytes]:
    """The mask files of rendered scenes.

    Args:
        batch: the renders, of images ``first``, ``first + 1``, ...
        min_visible: see ``coco.labelled``.

    Raises:
        ProbsceneError: more than 255 objects of a class in an image.
    """
    files = []
    for i, category in enumerate(labelled(model, batch, min_visible).numpy()):
        of_node = np.zeros(len(category) + 1, np.uint16)  # by the renderer's ids: 0, then node index + 1
        for number in np.unique(category[category > 0]):
            nodes = np.flatnonzero(category == number)
            if len(nodes) > MAX_INSTANCES:
                raise ProbsceneError(
                    f"expected at most {MAX_INSTANCES} objects of a class in an image, for 8 bits of KITTI's masks, "
                    f"got {len(nodes)} of class {model.classes[number - 1]!r} in image {first + i}; write other "
                    "formats to another folder."
                )
            of_node[nodes + 1] = 256 * number + np.arange(1, len(nodes) + 1)
        files.append(cv2.imencode(".png", of_node[batch.instance[i].numpy()])[1].tobytes())
    return files


def _in_plane(name: str, annotation: dict[str, Any], canvas: tuple[int, int]) -> str:
    """The line of an object of a 2D scene."""
    truncated, level = "-1", _UNSEEN
    if "amodal_bbox" in annotation:
        within = _share_within(annotation["amodal_bbox"], canvas)
        truncated = f"{1 - within:.2f}"
        if "visible_fraction" in annotation:
            level = _occluded(annotation["visible_fraction"] / within)
    x, y, w, h = annotation["bbox"]
    return f"{name} {truncated} {level} -10 {x:.2f} {y:.2f} {x + w:.2f} {y + h:.2f} {_UNKNOWN}\n"


def _in_space(name: str, annotation: dict[str, Any], canvas: tuple[int, int]) -> str:
    """The line of an object of a 3D scene."""
    height, width = canvas
    x, y, w, h = annotation["amodal_bbox"]
    ends = ((x, width), (y, height), (x + w, width), (y + h, height))
    box = " ".join(f"{min(max(end - 0.5, 0), size - 1):.2f}" for end, size in ends)
    X, Z, rotation = (annotation["box_3d"][i] for i in (3, 5, 6))
    alpha = math.remainder(rotation - math.atan2(X, Z), 2 * math.pi)
    level = _occluded(annotation["visible_fraction"])
    measured = " ".join(f"{v:.4f}" for v in annotation["box_3d"])
    return f"{_TYPE.get(name.casefold(), name)} {annotation['truncated']:.2f} {level} {alpha:.4f} {box} {measured}\n"


def _occluded(seen: float) -> int:
    return 0 if seen >= 0.9 else 1 if seen >= 0.5 else 2


def _share_within(box: list[int], canvas: tuple[int, int]) -> float:
    """Which share of a box, corner and size, lies on the canvas of height and width."""
    x, y, w, h = box
    height, width = canvas
    return (min(x + w, width) - max(x, 0)) * (min(y + h, height) - max(y, 0)) / (w * h)
