"""Counts of what a reader finds, as features of a scene.

A count network adds up what each cell holds, and of objects that look a little different from its renders it adds up a
little less: 8.7 for nine digits. Objects that are found one by one are whole, however little of each is found.
"""

import torch
from torch import Tensor

from ..features.counting.net import CountNet
from .backbone import RenderBackbone
from .reader import Reader

COUNTING_PREFIXES = ("backbone.", "class_head.", "score_threshold")  # parts of a reader that find objects


class ReaderCounts:
    """A ``FeatureNet`` with the features of a count network without groups.

    Args:
        net: that count network, on whose convolutions the reader is.
        state: of the reader, see ``COUNTING_PREFIXES``.
    """

    def __init__(self, net: CountNet, state: dict[str, Tensor]):
        self.names = net.names
        self.reader = Reader(RenderBackbone(net), len(net.classes), 1, 0)
        self.reader.load_state_dict(state, strict=False)
        self.reader.eval()

    def embed(self, images: Tensor) -> Tensor:
        """See ``FeatureNet``."""
        counts = self.reader.count(images)
        return torch.cat([counts, counts.sum(1, keepdim=True)], 1)


def counting_state(reader: Reader) -> dict[str, Tensor]:
    """What ``ReaderCounts`` needs of a reader's state."""
    return {key: value for key, value in reader.state_dict().items() if key.startswith(COUNTING_PREFIXES)}
