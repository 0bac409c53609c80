"""A trained detector as ONNX, for programs without torch.

The file takes ``image (3, H, W)`` float32 in 0..1, RGB, at the detector's size, as ``training.fitted`` gives it, and
gives, from the highest score, ``boxes (D, 4)`` in its pixels, left top right bottom, ``labels (D,)``, from 0, and
``scores (D,)``, after non-maximum suppression. D is always the same number; scores are 0 where there are fewer
detections.

torchvision's own forward pass cannot be exported, as its shapes depend on what is found. What stands here keeps every
place of the detector to the end; where more than 1,000 places of one level pass the least score, torchvision drops some
of them before the suppression.
"""

import logging
import warnings
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torchvision.models.detection.fcos import FCOS
from torchvision.models.detection.image_list import ImageList
from torchvision.ops import clip_boxes_to_image, nms

from probscene.errors import MachineError, ProbsceneError

from ..files import write_whole


def check_can_export(choice: str) -> None:
    """See that a detector of a choice can be exported here, before it is trained.

    Raises:
        ProbsceneError: another detector than efficientnet.
        MachineError: a package that the export needs is not installed.
    """
    if choice.partition("=")[0] != "efficientnet":
        raise ProbsceneError(f"expected the detector efficientnet for --onnx, got {choice!r}; leave one of them out.")
    missing = [name for name in ("onnx", "onnxscript") if find_spec(name) is None]
    if missing:
        raise MachineError(
            f"expected the packages onnx and onnxscript for --onnx, got no {' and no '.join(missing)}; install them "
            "with pip install 'probscene[onnx]'."
        )


def export(detector: FCOS, size: tuple[int, int], out: Path) -> None:
    """Write a trained detector as ONNX.

    Args:
        size: height and width at which images come.

    Raises:
        MachineError: it cannot be written.
    """
    wrapped, image = _FixedShapes(detector, size).eval(), torch.zeros(3, *size)
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)  # of functions of torch's that nobody here calls
    try:
        with warnings.catch_warnings(), torch.no_grad():
            warnings.simplefilter("ignore")
            program: Any = torch.onnx.export(
                wrapped, (image,), input_names=["image"], output_names=["boxes", "labels", "scores"], dynamo=True,
                verbose=False,
            )  # fmt: skip
    finally:
        logging.disable(before)
    whole = program.model_proto
    for part in (whole.graph, *whole.functions):
        for node in part.node:
            del node.metadata_props[:]  # lines of this file, with its place on this machine
    write_whole(out, lambda temporary: temporary.write_bytes(whole.SerializeToString()))


class _FixedShapes(nn.Module):
    """``FCOS`` with as many candidates and detections whatever the image."""

    anchors: Tensor
    mean: Tensor
    std: Tensor

    def __init__(self, detector: FCOS, size: tuple[int, int]):
        super().__init__()
        self.detector, self.size = detector, size
        image, transform = torch.zeros(1, 3, *size), detector.transform
        with torch.no_grad():
            maps = list(detector.backbone(image).values())
            self.register_buffer("anchors", detector.anchor_generator(ImageList(image, [size]), maps)[0])
        self.register_buffer("mean", torch.tensor(transform.image_mean)[:, None, None])
        self.register_buffer("std", torch.tensor(transform.image_std)[:, None, None])

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        detector = self.detector
        found = detector.head(list(detector.backbone(((image - self.mean) / self.std)[None]).values()))
        score = (found["cls_logits"].sigmoid() * found["bbox_ctrness"].sigmoid()).sqrt()[0]
        places, classes = score.shape
        box = clip_boxes_to_image(detector.box_coder.decode(found["bbox_regression"][0], self.anchors), self.size)
        label, box, score = torch.arange(classes).repeat(places), box.repeat_interleave(classes, 0), score.flatten()
        apart = box + (label * (max(self.size) + 1)).to(box.dtype)[:, None]  # boxes of two classes never overlap
        kept = torch.zeros_like(score).index_fill(0, nms(apart, score, detector.nms_thresh), 1.0)
        kept = kept * (score > detector.score_thresh)
        top, at = (score * kept).topk(min(detector.detections_per_img, len(score)))
        return box[at], label[at], top
