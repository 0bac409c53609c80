"""Depth as KITTI's depth benchmark has it.

    depth/000000.png ...   16 bits: 256 * metres along the camera's z, rounded; 0 where it is unknown

The sky is unknown, and what is 256 metres away or farther. What is nearer than 2 millimetres is taken to be at 4.
"""

import cv2
import numpy as np
from torch import Tensor

from probscene.batch import RenderBatch
from probscene.errors import ProbsceneError
from probscene.model import SceneModel

from .provenance import stem

_METRE, _MOST = 256, 2**16 - 1


def file_name(index: int, flat: bool = True) -> str:
    """The file of image number ``index``, relative to the dataset's folder; see ``stem``."""
    return f"depth/{stem(index, flat)}.png"


def depth_of(batch: RenderBatch) -> Tensor | None:
    """``(N, H, W)`` float32, metres, infinity where there is sky; None where the renderer does not know it."""
    return batch.depth if batch.space is None else batch.space.depth


def files(model: SceneModel, batch: RenderBatch) -> list[bytes]:
    """The files of rendered scenes.

    Raises:
        ProbsceneError: the renderer does not know depth.
    """
    depth = depth_of(batch)
    if depth is None:
        raise ProbsceneError(
            f"expected renders of model {model.name!r} to have depth, for format depth, got none; choose other "
            "formats, or let its generator return depth."
        )
    steps = np.rint(depth.double().numpy() * _METRE)
    known = np.where(steps <= _MOST, np.maximum(steps, 1), 0).astype(np.uint16)
    return [cv2.imencode(".png", each)[1].tobytes() for each in known]
