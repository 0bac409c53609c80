"""Sprites from files, and their edges."""

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from probscene.drawing import Atlas, disc
from probscene.errors import DataError


def test_a_folders_pictures_are_sprites_in_the_order_of_their_names(tmp_path):
    rng = np.random.default_rng(0)
    pictures = {"b.png": rng.integers(0, 256, (3, 4, 4), np.uint8), "a.PNG": rng.integers(0, 256, (2, 5, 4), np.uint8)}
    for name, pixels in pictures.items():
        Image.fromarray(pixels).save(tmp_path / name)
    Image.fromarray(pictures["b.png"][..., :3]).save(tmp_path / "c.png")
    Image.fromarray(pictures["b.png"][..., 0]).save(tmp_path / "d.png")
    (tmp_path / "._b.png").write_bytes(b"of a file manager")
    (tmp_path / "notes.txt").write_text("none")
    found = Atlas.from_folder(tmp_path)
    assert len(found) == 4
    assert np.array_equal(found.sprites[0], pictures["a.PNG"]) and np.array_equal(found.sprites[1], pictures["b.png"])
    assert np.array_equal(found.sprites[2][..., :3], pictures["b.png"][..., :3])
    assert (found.sprites[2][..., 3] == 255).all() and (found.sprites[3][..., 1] == pictures["b.png"][..., 0]).all()
    (tmp_path / "e.png").write_bytes(b"no picture")
    with pytest.raises(DataError, match="expected a picture in .*e.png"):
        Atlas.from_folder(tmp_path)
    with pytest.raises(DataError, match="expected PNG files in"):
        Atlas.from_folder(tmp_path / "nowhere")


def test_fingerprints_are_of_the_pixels():
    one, other = Atlas((disc(16),)), Atlas((disc(16), disc(16)))
    assert one.fingerprint == Atlas((disc(16),)).fingerprint != other.fingerprint


def test_every_sprite_is_picked_as_often():
    atlas = Atlas((disc(4),) * 7)
    assert torch.equal(atlas.pick((torch.arange(7000) + 0.5) / 7000).bincount(), torch.full((7,), 1000))
    assert atlas.pick(torch.tensor([-0.1, 1.0])).tolist() == [0, 6]


def test_feathered_edges_stay_where_they_are():
    wide = cv2.copyMakeBorder(disc(40), 10, 10, 10, 10, cv2.BORDER_CONSTANT, value=(255, 255, 255, 0))
    sharp, soft, softer = Atlas((wide,)).feathered((0.0, 1.0, 2.0)).sprites
    assert np.array_equal(sharp, wide)
    there = [int((sprite[..., 3] > 127).sum()) for sprite in (sharp, soft, softer)]
    assert max(there) - min(there) < 0.03 * there[0]
    rim = [int(((sprite[..., 3] > 20) & (sprite[..., 3] < 235)).sum()) for sprite in (sharp, soft, softer)]
    assert rim[0] < rim[1] < rim[2]
    assert (softer[..., :3] == 255).all()
