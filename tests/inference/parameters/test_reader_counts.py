"""Counts of what a reader finds."""

import torch

from probscene.inference.features.counting.net import CountNet
from probscene.inference.parameters.backbone import RenderBackbone
from probscene.inference.parameters.reader import Reader
from probscene.inference.parameters.reader_counts import ReaderCounts, counting_state

CLASSES = ("red", "blue", "green")


def reader_of(net):
    """One that finds something in noise, however little of it."""
    torch.manual_seed(1)
    reader = Reader(RenderBackbone(net), len(CLASSES), 4, 2).eval()
    torch.nn.init.normal_(reader.class_head.weight, std=30.0)
    reader.score_threshold.fill_(0.3)
    return reader


def test_counts_are_of_what_is_found():
    torch.manual_seed(0)
    net = CountNet(CLASSES, 3, (64, 96), width=(4, 8, 8)).eval()
    reader = reader_of(net)
    images = torch.randint(0, 256, (70, 3, 64, 96), dtype=torch.uint8)
    found, counts = reader.detect(images), torch.zeros(70, len(CLASSES))
    for image, label in zip(found.image.tolist(), found.label.tolist(), strict=True):
        counts[image, label] += 1
    assert torch.equal(reader.count(images), counts) and len(counts.unique()) > 2
    seen = ReaderCounts(net, counting_state(reader)).embed(images)
    assert torch.equal(seen, torch.cat([counts, counts.sum(1, keepdim=True)], 1))
    assert seen.shape == net.embed(images).shape and not any(key.startswith("values") for key in counting_state(reader))


def test_no_images_have_no_counts():
    net = CountNet(CLASSES, 3, (64, 64), width=(4, 8, 8)).eval()
    assert ReaderCounts(net, counting_state(reader_of(net))).embed(
        torch.zeros(0, 3, 64, 64, dtype=torch.uint8)
    ).shape == (
        0,
        4,
    )
