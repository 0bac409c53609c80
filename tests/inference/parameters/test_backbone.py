"""What a reader sees of an image."""

import numpy as np
import pytest
import torch

from probscene.inference.features.counting.net import CountNet
from probscene.inference.features.photographs.net import PretrainedCountNet
from probscene.inference.features.presence import PresenceNet
from probscene.inference.parameters.backbone import WIDTH, Backbone, RenderBackbone, cell_colours
from probscene.inference.parameters.reader import Reader
from probscene.inference.parameters.reader_training import ReaderTraining

CLASSES = ("red", "blue")


def backbone_of(kind, canvas):
    net = CountNet(CLASSES, 3, canvas, width=(4, 8, 8)) if kind == "renders" else PretrainedCountNet(CLASSES, canvas)
    backbone = Backbone.from_feature_net(net)
    assert backbone is not None
    return backbone.eval()


@pytest.mark.parametrize("kind", ["renders", "photographs"])
@pytest.mark.parametrize("canvas", [(64, 64), (96, 128)])
def test_cells_cover_the_image(kind, canvas):
    backbone = backbone_of(kind, canvas)
    seen = backbone(backbone.enter(torch.randint(0, 256, (2, 3, *canvas), dtype=torch.uint8)))
    across, down = (seen.shape[3] * backbone.cell[0], seen.shape[2] * backbone.cell[1])
    assert seen.shape[:2] == (2, WIDTH)
    assert 0 <= float(across) - canvas[1] < 2 * backbone.cell[0] and 0 <= float(down) - canvas[0] < 2 * backbone.cell[1]


@pytest.mark.parametrize("kind", ["renders", "photographs"])
def test_what_is_found_does_not_depend_on_the_other_images(kind):
    torch.manual_seed(0)
    backbone = backbone_of(kind, (64, 64))
    reader = Reader(backbone, 2, 1, 1).eval()
    torch.nn.init.normal_(reader.class_head.weight, std=30.0)
    images = torch.randint(0, 256, (5, 3, 64, 64), dtype=torch.uint8)
    alone, together = reader.detect(images[3:4]), reader.detect(images)
    rows = together.image == 3
    assert len(alone.image) and torch.allclose(alone.centre, together.centre[rows], atol=1e-3)
    assert torch.allclose(alone.scene_raw[0], together.scene_raw[3], atol=1e-4)


@pytest.mark.parametrize("training", [False, True])
def test_grey_images_are_seen_by_the_layers_themselves(training):
    torch.manual_seed(0)
    net = CountNet(CLASSES, 1, (96, 128), width=(4, 8, 8))
    backbone = RenderBackbone(net).train(training)
    x = backbone.enter(torch.randint(0, 256, (3, 1, 96, 128), dtype=torch.uint8))
    fine = backbone.fine(x)
    coarse = torch.nn.functional.interpolate(backbone.down(backbone.coarse(fine)), scale_factor=2)
    assert torch.allclose(backbone(x), backbone.both(backbone.side(fine) + coarse), atol=1e-4)


@pytest.mark.parametrize("channels", [1, 3])
def test_colours_are_those_of_each_cell(channels):
    images = torch.randint(0, 256, (2, channels, 24, 32), dtype=torch.uint8)
    found = cell_colours(images, (6, 8))
    x = np.broadcast_to(images.numpy(), (2, 3, 24, 32)).reshape(2, 3, 6, 4, 8, 4) / 128.0 - 1
    assert np.allclose(found[:, :3], x.mean((3, 5)), atol=1e-5)
    assert np.allclose(found[:, 3:], 3 * x.std((3, 5)), atol=1e-2)


@pytest.mark.parametrize(("size", "images"), [(24, 12), (12, 7), (6, 4)])
def test_the_reader_is_shown_fewer_renders_that_are_larger(size, images):
    """Objects of 24 pixels may be reduced to a quarter, those of 6 not at all."""
    counts = CountNet(CLASSES, 3, (188, 600), width=(4, 8, 8))
    counts.fit_to(size)

    reader = Reader(RenderBackbone(counts), 2, 1, 1)
    assert ReaderTraining(reader, lambda: None, images=12).images == images


def test_features_without_places_give_no_eye():
    assert Backbone.from_feature_net(PresenceNet(CLASSES)) is None
    assert isinstance(Backbone.from_feature_net(CountNet(CLASSES, 3, (64, 64))), RenderBackbone)
