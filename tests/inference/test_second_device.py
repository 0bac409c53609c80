"""Networks and divergences on a second device: no operation is of two, and what is found is the CPU's, on the CPU.

Whole fits are in ``tests/app/fitting/test_device.py``.
"""

from functools import partial

import pytest
import torch
from second_device import SECOND, second_device

from probscene.device import CPU
from probscene.inference.divergence import MMD, Blockwise, JensenShannon, KDELogRatio
from probscene.inference.features.counting.net import CountNet
from probscene.inference.features.presence import PresenceNet
from probscene.inference.features.pretrained import EfficientNetLite
from probscene.inference.features.projection import Projected
from probscene.inference.parameters.backbone import RenderBackbone
from probscene.inference.parameters.global_head import GlobalHead
from probscene.inference.parameters.reader import Reader
from probscene.inference.parameters.reader_counts import ReaderCounts, counting_state
from probscene.model import Groups

IMAGES = torch.randint(0, 256, (3, 3, 48, 64), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
KINDS = ("road", "car", "bus")


def count_net(groups=None) -> CountNet:
    return CountNet(KINDS, 3, (48, 64), (4, 4, 8), groups=groups).eval()


def reader_counts() -> ReaderCounts:
    net = count_net()
    return ReaderCounts(net, counting_state(Reader(RenderBackbone(net), 3, 1, 0)))


NETS = {
    "count": count_net,
    "count by rows": partial(count_net, Groups("road", "y", 2)),
    "count by columns": partial(count_net, Groups("road", "x", 2)),
    "presence": lambda: PresenceNet(KINDS).eval(),
    "presence=counts": lambda: PresenceNet(KINDS, ways=4).eval(),
    "efficientnet": lambda: EfficientNetLite(96),
    "projected": lambda: Projected(EfficientNetLite(96), 2),
}


@pytest.mark.parametrize("name", NETS)
def test_features_are_those_of_the_cpu(name):
    torch.manual_seed(0)
    net = NETS[name]()
    methods = [net.embed] + [
        getattr(net, more) for more in ("cells", "looks", "places", "logits") if hasattr(net, more)
    ]
    expected = [method(IMAGES) for method in methods]
    with second_device():
        net.place(SECOND)
        found = [method(IMAGES) for method in methods]
    torch.testing.assert_close(found, expected, rtol=0, atol=0)


def test_a_reader_is_where_its_backbone_is_and_detects_for_the_cpu():
    torch.manual_seed(0)
    net, found = count_net(), []
    for device in (CPU, SECOND):
        with second_device():
            net.place(device)
            torch.manual_seed(1)
            reader = Reader(RenderBackbone(net), 3, 2, 1)
            reader.thresholds = (1e-3,)
            counts = ReaderCounts(net, counting_state(reader))
            assert {p.device for p in reader.parameters()} == {device}
            found.append((*reader.eval().detect_all(IMAGES), *reader.detect(IMAGES), counts.embed(IMAGES)))
    assert len(found[0][0]) > 0
    torch.testing.assert_close(found[1], found[0], rtol=0, atol=0)


def test_a_head_takes_its_scale_from_the_cpu():
    head, x = GlobalHead(2, 6).eval(), torch.rand(5, 1, 40, 40)
    expected = head(x)
    with second_device():
        head.to(SECOND)
        torch.testing.assert_close(head(x.to(SECOND)).cpu(), expected, rtol=0, atol=0)


@pytest.mark.parametrize(
    "divergence",
    [
        KDELogRatio(), KDELogRatio(leave_one_out=False, equal_sizes=True, anscombe=True), JensenShannon(), MMD(),
        MMD(shared=False), Blockwise((1, 2), (KDELogRatio(), MMD())),
    ],
    ids=str,
)  # fmt: skip
def test_costs_are_those_of_the_cpu(divergence):
    torch.manual_seed(0)
    generated, real = torch.rand(20, 3), torch.rand(30, 3)
    with second_device():
        found = divergence(generated.to(SECOND), real.to(SECOND)).cpu()
    torch.testing.assert_close(found, divergence(generated, real), rtol=0, atol=0)
