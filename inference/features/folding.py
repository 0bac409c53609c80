"""A frozen EfficientNet-Lite in fewer passes over memory: the same function, but for rounding.

Batch normalisation goes into the convolution before it, a convolution pads by itself and not by a module, which would
copy the maps, one of single pixels is a product of matrices, and what is clipped is written over.
"""

import torch
import torch.nn.functional as F
from efficientnet_lite_pytorch import EfficientNet
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

PAIRS = (("_conv_stem", "_bn0"), ("_conv_head", "_bn1"))
PAIRS_OF_BLOCKS = (("_expand_conv", "_bn0"), ("_depthwise_conv", "_bn1"), ("_project_conv", "_bn2"))


@torch.no_grad()
def fold(net: EfficientNet) -> None:
    """Fold in place; the network cannot be trained any more."""
    net.eval()
    for part, pairs in ((net, PAIRS), *((block, PAIRS_OF_BLOCKS) for block in net._blocks)):
        part._swish = nn.ReLU6(inplace=True)
        for convolution, norm in pairs:
            if hasattr(part, convolution):  # the first block does not expand
                _pad_alone(getattr(part, convolution))
                fused = fuse_conv_bn_eval(getattr(part, convolution), getattr(part, norm))
                setattr(part, convolution, Pointwise(fused) if fused.kernel_size == (1, 1) else fused)
                setattr(part, norm, nn.Identity())


class Pointwise(nn.Module):
    """A 1 x 1 convolution of images that lie in memory with their channels last. torch takes each image apart for it
    where one thread is given few of them.

    Args:
        convolution: the same function.
    """

    def __init__(self, convolution: nn.Conv2d):
        super().__init__()
        self.weight, self.bias = nn.Parameter(convolution.weight.flatten(1)), convolution.bias
        self.out_channels = convolution.out_channels

    def forward(self, x: Tensor) -> Tensor:
        """``(N, out_channels, H, W)``."""
        return F.linear(x.permute(0, 2, 3, 1), self.weight, self.bias).permute(0, 3, 1, 2)


def _pad_alone(convolution: nn.Conv2d) -> None:
    left, right, *others = getattr(convolution.static_padding, "padding", (0, 0, 0, 0))
    if others != [left, right] or right - left not in (0, 1):
        return
    if left < right:  # those that halve: after a row and a column of zeros in the kernel both sides are alike
        convolution.weight = nn.Parameter(F.pad(convolution.weight, (1, 0, 1, 0)))
        convolution.kernel_size = (convolution.weight.shape[2], convolution.weight.shape[3])
    convolution.padding, convolution.static_padding = (right, right), nn.Identity()
