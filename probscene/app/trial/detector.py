"""The detectors that a trial trains: torchvision's, each from weights that were trained on photographs.

``efficientnet``
    FCOS [1] on EfficientNet-Lite0, whose ImageNet weights came with the install, with a feature pyramid [2] at strides
    8, 16 and 32. What is before stride 8, depthwise filters and all batch norms stay as they were on ImageNet. Small,
    so that a table of forty trainings is an afternoon on two cores.

``maskrcnn=FILE``
    Mask R-CNN's [3] box detector on ResNet-50 with a feature pyramid, which is Meta-Sim2's: weights of torchvision's
    ``maskrcnn_resnet50_fpn``, or of its ``resnet50``. Masks are neither learnt nor made.

References:
    [1] Tian et al., *FCOS*, ICCV 2019.
    [2] Lin et al., *Feature Pyramid Networks for Object Detection*, CVPR 2017.
    [3] He et al., *Mask R-CNN*, ICCV 2017.
"""

import hashlib
from collections import OrderedDict
from pathlib import Path
from typing import Any, NamedTuple, cast

from torch import Tensor, nn
from torchvision.models.detection.anchor_utils import AnchorGenerator
from torchvision.models.detection.backbone_utils import resnet_fpn_backbone
from torchvision.models.detection.faster_rcnn import FastRCNNPredictor
from torchvision.models.detection.fcos import FCOS, FCOSClassificationHead, FCOSRegressionHead
from torchvision.models.detection.mask_rcnn import MaskRCNN
from torchvision.ops import FeaturePyramidNetwork

from probscene.errors import DataError, ProbsceneError
from probscene.inference.features.pretrained import EfficientNetLite, read_tensors

STRIDES, CHANNELS, CONVOLUTIONS = (8, 16, 32), 64, 2
SIDES = (4, 8, 16)  # pixels: an object whose ends are up to eight times that from a place belongs to that level
START = 4.0  # in these sides, how far the ends of an object are from a place before anything is learnt
REACH = 3.0  # how far from an object's middle places learn it, in these sides
MIN_SCORE, MAX_DETECTIONS = 0.02, 100  # of what is detected; detections an image


class Recipe(NamedTuple):
    """How a detector is trained, where nothing else is asked for.

    Attributes:
        iterations: steps of the optimiser, in all.
        batch_size: images a step.
        learning_rate: of Adam, at its highest.
        backbone_factor: of the learning rate, for pretrained layers.
        first_label: the detector's first label; 1 where 0 is the background.
    """

    iterations: int
    batch_size: int
    learning_rate: float
    backbone_factor: float
    first_label: int

    @property
    def num_images(self) -> int:
        """How many images a training is shown."""
        return self.iterations * self.batch_size


RECIPES = {"efficientnet": Recipe(600, 4, 2e-3, 0.1, 0), "maskrcnn": Recipe(5000, 2, 1e-3, 1.0, 1)}


def checked(choice: str) -> str:
    """The detector's name, of ``RECIPES``.

    Raises:
        ProbsceneError: another word, or no file where one is needed.
        DataError: the file of weights is none, or of another network.
    """
    name, _, file = choice.partition("=")
    if name not in RECIPES or (name == "maskrcnn") != bool(file):
        raise ProbsceneError(f"expected a detector efficientnet or maskrcnn=FILE, got {choice!r}.")
    if file:
        build(choice, 1, (64, 64))
    return name


def fingerprint(choice: str) -> str:
    """What a choice stands for, for the trial's settings: its name and, of a file, what is in it."""
    name, _, file = choice.partition("=")
    return f"{name}={hashlib.sha256(Path(file).read_bytes()).hexdigest()[:16]}" if file else name


def build(choice: str, classes: int, size: tuple[int, int]) -> nn.Module:
    """A detector at its start; new layers draw from torch's random numbers.

    Args:
        choice: see ``checked``; of ``maskrcnn`` without a file all weights are by chance, for those of a trained one.
        size: height and width at which images come.

    Raises:
        DataError: see ``checked``.
    """
    name, _, file = choice.partition("=")
    return _mask_rcnn(Path(file) if file else None, classes, size) if name == "maskrcnn" else _fcos(classes, size)


def pretrained_part(detector: Any) -> nn.Module:
    """What has weights from photographs."""
    return detector.backbone.body


class _Stages(nn.Module):
    """EfficientNet-Lite0's last maps at each of ``STRIDES``, 40, 112 and 320 channels."""

    def __init__(self):
        super().__init__()
        net = EfficientNetLite().net
        starts = [i for i, block in enumerate(net._blocks) if block._depthwise_conv.stride[0] == 2]  # at 4, 8, 16, 32
        self.stem, self.relu = net._conv_stem, net._swish
        ends = [*starts[1:], len(net._blocks)]
        self.stages = nn.ModuleList(
            nn.ModuleList(net._blocks[first:end]) for first, end in zip([0, *ends], ends, strict=False)
        )
        self.channels = [net._blocks[end - 1]._project_conv.out_channels for end in ends[1:]]
        self.stages[1:].requires_grad_(True)
        for block in net._blocks:  # on a CPU a quarter of a step, and hardly any of the weights
            block._depthwise_conv.requires_grad_(False)

    def train(self, mode: bool = True) -> "_Stages":
        """Stays in evaluation mode, without dropped connections."""
        return super().train(False)

    def forward(self, x: Tensor) -> OrderedDict[str, Tensor]:
        x = self.relu(self.stem(x))
        maps: OrderedDict[str, Tensor] = OrderedDict()
        for number, stage in enumerate(self.stages):
            for block in cast(nn.Sequential, stage):
                x = block(x)
            if number:
                maps[str(number)] = x
        return maps


class _Backbone(nn.Module):
    def __init__(self):
        super().__init__()
        self.body = _Stages()
        self.fpn = FeaturePyramidNetwork(self.body.channels, CHANNELS)
        self.out_channels = CHANNELS

    def forward(self, x: Tensor) -> OrderedDict[str, Tensor]:
        return self.fpn(self.body(x))


def _fcos(classes: int, size: tuple[int, int]) -> FCOS:
    detector = FCOS(
        _Backbone(),
        classes,
        min_size=min(size),
        max_size=max(size),
        image_mean=[127 / 255] * 3,
        image_std=[128 / 255] * 3,
        anchor_generator=AnchorGenerator(tuple((side,) for side in SIDES), ((1.0,),) * len(SIDES)),
        center_sampling_radius=REACH,
        score_thresh=MIN_SCORE,
        nms_thresh=0.5,
        detections_per_img=MAX_DETECTIONS,
    )
    detector.head.classification_head = FCOSClassificationHead(CHANNELS, 1, classes, CONVOLUTIONS)
    detector.head.regression_head = FCOSRegressionHead(CHANNELS, 1, CONVOLUTIONS)
    # Distances pass a ReLU: from 0, as torchvision has it, those to one side can die for good.
    nn.init.constant_(cast(Tensor, detector.head.regression_head.bbox_reg.bias), START)
    return detector


def _mask_rcnn(file: Path | None, classes: int, size: tuple[int, int]) -> nn.Module:
    tensors = None if file is None else read_tensors(file)
    # With batch norms that stay as they were, and the first two stages frozen, as torchvision fine-tunes it.
    detector: Any = MaskRCNN(
        resnet_fpn_backbone(backbone_name="resnet50", weights=None, trainable_layers=3),
        91,
        min_size=min(size),
        max_size=max(size),
        box_score_thresh=MIN_SCORE,
        box_detections_per_img=MAX_DETECTIONS,
    )
    if tensors is not None:
        _load_mask_rcnn(detector, tensors, file)
    heads = detector.roi_heads
    heads.box_predictor = FastRCNNPredictor(heads.box_predictor.cls_score.in_features, classes + 1)
    heads.mask_roi_pool = heads.mask_head = heads.mask_predictor = None  # torchvision: has_mask() is False then
    return detector


def _load_mask_rcnn(detector: Any, tensors: dict[str, Tensor], file: Path | None) -> None:
    whole = any(name.startswith("backbone.") for name in tensors)
    into = detector if whole else detector.backbone.body
    try:
        lacking, _ = into.load_state_dict(tensors, strict=whole)
        if not whole and len(lacking) > 0:
            raise RuntimeError(f"no {lacking[0]}")
    except RuntimeError as error:
        raise DataError(
            f"expected a state dict of torchvision's maskrcnn_resnet50_fpn or resnet50 in {file}, got another "
            f"network's ({' '.join(str(error).split())[:160]}...)."
        ) from error
