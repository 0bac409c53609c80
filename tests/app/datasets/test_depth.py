"""Depth on disk is KITTI's, and what the renderer gave."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from probscene.app.datasets import depth
from probscene.app.datasets.generate import generate_scenes
from probscene.app.datasets.scene_dataset import SceneDataset
from probscene.app.loading import load_model, renderer_for
from probscene.errors import ProbsceneError
from probscene.sampling import sample

LEAST, MOST = 1 / 512, 256 - 1 / 512  # metres that come back as they are


def read(data):
    """Metres as KITTI's development kit reads them, with NaN where there are none."""
    png = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert png.dtype == np.uint16 and png.ndim == 2
    return np.where(png > 0, png / 256, np.nan)


@pytest.fixture(scope="module")
def boxes():
    return load_model(str(Path(__file__).parents[1] / "generators" / "boxes.py"))


@pytest.fixture(scope="module")
def street():
    return replace(load_model("driving_simple"), canvas=(32, 104))


def with_depth(metres):
    """A generator that draws nothing, so far away."""

    def render(scene):
        size = scene.height, scene.width
        blank = {"image": np.zeros((*size, 3), np.uint8), "instance": np.zeros(size, np.uint8)}
        return blank if metres is None else {**blank, "depth": metres}

    return render


METRES = st.one_of(st.floats(0, 300, width=32), st.just(np.float32(np.inf)), st.floats(256, 2.0**100, width=32))


@given(arrays(np.float32, (32, 40), elements=METRES))
def test_what_is_read_back_is_what_was_rendered(boxes, metres):
    model = replace(boxes, generator=with_depth(metres))
    batch = renderer_for(model, threads=1)(sample(model, model.prior, 1).drawing)
    found = read(depth.files(model, batch)[0])
    kept = (metres >= LEAST) & (metres < MOST)
    assert (np.abs(found - metres)[kept] <= 1 / 512).all()
    assert np.isnan(found[metres >= MOST]).all() and (found[metres < LEAST] == 1 / 256).all()


def test_a_dataset_has_the_depth_of_its_renders(street, tmp_path):
    generate_scenes(street, street.prior, 6, tmp_path / "out", seed=2, format="coco,depth")
    generate_scenes(street, street.prior, 6, tmp_path / "out", seed=2, format="coco,depth")  # it is seen to be finished
    some = False
    for image, target in SceneDataset(street, num=6, seed=2):
        found = read((tmp_path / "out" / depth.file_name(target["image_id"])).read_bytes())
        assert target["depth"].dtype == torch.float32 and target["depth"].shape == image.shape[1:]
        metres = target["depth"].numpy()
        seen = np.isfinite(metres) & (metres < MOST)
        assert np.array_equal(np.isfinite(found), seen) and np.allclose(found[seen], metres[seen], atol=1 / 511, rtol=0)
        some |= seen.any() and not seen.all()
    assert some


def test_a_generators_depth_is_written_where_it_has_some(boxes, tmp_path):
    far = replace(boxes, generator=with_depth(np.full((32, 40), 7.5, np.float32)))
    generate_scenes(far, far.prior, 2, tmp_path / "far", format="depth")
    assert sorted(path.name for path in (tmp_path / "far").iterdir()) == ["depth", "images", "provenance.jsonl"]
    assert (read((tmp_path / "far" / "depth" / "000001.png").read_bytes()) == 7.5).all()
    flat = replace(boxes, generator=with_depth(None))
    with pytest.raises(ProbsceneError, match="of model 'boxes' to have depth, for format depth, got none; choose"):
        generate_scenes(flat, flat.prior, 2, tmp_path / "flat", format="coco,depth")
    assert not (tmp_path / "flat").exists()
    assert all("depth" not in target for _, target in SceneDataset(flat, num=2))
