import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from probscene.inference.statistics.box_margin import MIN_BOXES, EdgeProfiles, edge_profiles, estimate_margin

SIDE, CELL = 192, 64  # pixels of an image, and of the place of each object in it
TOLERATED = 0.5  # pixels


def profiles(
    room: float, radius: float = 10.0, light: float = 60.0, images: int = 6, noise: float = 3.0, seed: int = 0
) -> EdgeProfiles:
    """Of images of nine rings with a bright middle, in boxes with ``room`` pixels around them on each side."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:SIDE, :SIDE] + 0.5
    pictures = np.full((images, SIDE, SIDE), 120.0) + noise * rng.standard_normal((images, SIDE, SIDE))
    box = np.zeros((images, 9, 4))
    for i in range(images):
        for k in range(9):
            r = radius * rng.uniform(0.9, 1.1)
            at = np.array([k % 3, k // 3]) * CELL + CELL / 2 + rng.uniform(-4, 4, 2)
            far = np.hypot(x - at[0], y - at[1])
            inside = np.clip(r - far, 0, 1)
            pictures[i] += inside * (np.where(far < 0.5 * r, light, -0.7 * light))
            box[i, k] = [*(at - r - room), *(at + r + room)]
    image = torch.from_numpy(pictures.clip(0, 255)).to(torch.uint8)[:, None]
    return edge_profiles(image, torch.from_numpy(box).float(), torch.zeros(images, 9, dtype=torch.int64))


TOUCHING = profiles(0.0, seed=1)


@settings(max_examples=20, deadline=None)
@given(st.floats(1.5, 5), st.floats(8, 16), st.floats(20, 120), st.integers(2, 1000))
def test_the_room_is_found_whatever_the_size_and_the_contrast(room, radius, light, seed):
    found = estimate_margin(profiles(room, radius, light, seed=seed), TOUCHING, 0)
    assert found is not None and abs(found.pixels - room) < TOLERATED
    assert found.low <= found.pixels <= found.high
    assert found.scale == pytest.approx((radius + room) / radius, rel=0.1)


@settings(max_examples=20, deadline=None)
@given(st.floats(8, 16), st.floats(20, 120), st.integers(2, 1000))
def test_boxes_that_touch_have_none(radius, light, seed):
    assert estimate_margin(profiles(0.0, radius, light, seed=seed), TOUCHING, 0) is None


def test_nothing_is_said_of_what_looks_different_or_of_few_or_of_another_class():
    loose = profiles(4.0)
    assert estimate_margin(loose, TOUCHING, 0) is not None
    assert estimate_margin(profiles(4.0, light=0.0), TOUCHING, 0) is None
    assert estimate_margin(EdgeProfiles(*(part[: MIN_BOXES - 1] for part in loose)), TOUCHING, 0) is None
    assert estimate_margin(loose, TOUCHING, 1) is None


def test_boxes_at_the_edge_of_the_image_or_that_cover_one_another_are_left_out():
    image = torch.randint(0, 255, (1, 3, 50, 80), dtype=torch.uint8)
    box = torch.tensor([[[0, 5, 20, 20], [30, 10, 50, 30], [45, 10, 65, 30], [5, 25, 20, 45], [70.0, 5, 75, 9]]])
    label = torch.tensor([[0, 0, 0, 1, -1]])
    found = edge_profiles(image, box, label)
    assert found.label.tolist() == [1] and found.side.tolist() == pytest.approx([(15 * 20) ** 0.5])
    nothing = edge_profiles(image, box[:, :0], label[:, :0])
    assert len(nothing.image) == 0 and nothing.contrast.shape == TOUCHING.contrast[:0].shape
