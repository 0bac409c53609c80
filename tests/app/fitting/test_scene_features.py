"""Scenes as a feature network sees them: those that ``generate`` writes, and the target as the fit has seen it."""

import cv2
import numpy as np
import pytest
import torch
from matplotlib.cbook import get_sample_data

from probscene.app.datasets.generate import generate
from probscene.app.fitting import scene_features as seen
from probscene.app.fitting.run import RunFolder
from probscene.app.loading import load_model
from probscene.dataset import ImageFolder
from probscene.errors import DataError, ProbsceneError, RunError
from probscene.image_array import ImageArray
from probscene.inference.features.base import embed_all
from probscene.inference.features.pretrained import EfficientNetLite


@pytest.fixture(scope="module")
def run(fitted) -> RunFolder:
    return RunFolder.at(fitted)


def test_scenes_are_those_that_generate_writes(run, tmp_path):
    generate(run, 70, tmp_path / "data", seed=3, format="images")
    files = sorted((tmp_path / "data" / "images").iterdir())
    written = np.stack([cv2.cvtColor(cv2.imread(str(file)), cv2.COLOR_BGR2RGB) for file in files])
    batches = list(seen.images_of(run.model, run.guide, 70, seed=3))
    drawn = torch.cat(batches)
    assert drawn.dtype == torch.uint8 and max(map(len, batches)) <= 64
    assert np.array_equal(drawn.permute(0, 2, 3, 1).numpy(), written)


def test_features_are_of_those_scenes_and_the_same_for_the_same_seed(run):
    net, told, before = seen.own_net(run), [], torch.get_num_threads()
    state = torch.get_rng_state()
    features = seen.features_of(run, run.model.prior, 100, net, 5, told.append)
    assert torch.equal(torch.get_rng_state(), state) and torch.get_num_threads() == before
    assert features.shape == (100, len(net.names)) and sum(told) == 100
    assert torch.allclose(features, embed_all(net, seen.images_of(run.model, run.model.prior, 100, 5)), atol=1e-4)
    assert torch.equal(seen.features_of(run, run.model.prior, 100, net, 5), features)
    assert torch.allclose(seen.features_of(run, run.model.prior, 10, net, 5), features[:10], atol=1e-4)
    assert not torch.allclose(seen.features_of(run, run.model.prior, 100, net, 6), features)


def test_the_target_is_seen_as_the_fit_has_seen_it(run, target):
    images = ImageFolder(target.images, run.model.canvas, run.model.channels)
    kept = run.read_tensors("real")["features"]
    assert torch.allclose(seen.features_in(run, images, seen.own_net(run)), kept, atol=1e-4)


@pytest.mark.parametrize("name", ["multi_mnist", "aerial2d"])
def test_other_structures_and_layouts_do_not_look_unlike_and_photographs_do(name, monkeypatch):
    """Of these rows of upright digits each image's nearest neighbour is another one, not a render."""
    monkeypatch.setattr(EfficientNetLite.__init__, "__defaults__", (224,))
    model = load_model(name)
    target = model.target(0)
    drawn = torch.cat(list(seen.images_of(target, target.prior, seen.ASKED, seed=2)))
    same = ImageArray(drawn.permute(0, 2, 3, 1).numpy(), model.canvas, model.channels)
    assert seen.domain_shift(model, same) < seen.DOMAIN_SHIFT_SHARE
    side, rng = 200, np.random.default_rng(0)
    photograph = cv2.imread(get_sample_data("grace_hopper.jpg", asfileobj=False))[..., ::-1]
    corners = rng.integers(0, np.subtract(photograph.shape[:2], side), (12, 2))
    parts = np.stack([photograph[y : y + side, x : x + side] for y, x in corners])
    assert seen.domain_shift(model, ImageArray(parts, model.canvas, model.channels)) > seen.DOMAIN_SHIFT_SHARE


def test_networks_by_their_words(run, tmp_path):
    name, net = seen.network("run", run)
    assert name == "run" and "red" in net.names
    name, net = seen.network("efficientnet", run)
    assert name == "efficientnet-lite0" and len(net.names) == 1280
    for word in ("vgg", "resnet", "inception=", "efficientnet=x", ""):
        with pytest.raises(ProbsceneError, match="inception=FILE"):
            seen.network(word, run)
    with pytest.raises(DataError, match="expected a file of weights"):
        seen.network(f"inception={tmp_path / 'none.pth'}", run)
    with pytest.raises(RunError, match="--resume"):
        seen.network("run", RunFolder(tmp_path, run.record))
