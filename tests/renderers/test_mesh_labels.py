"""Boxes, depth, truncation and classes of the mesh renderer, against OpenCV and cases worked out by hand."""

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from probscene.renderers.meshes import MeshRenderer
from probscene.world import KITTI_FOCAL, Camera, Meshes

CANVAS = (94, 310)
RENDERER = MeshRenderer(CANVAS, threads=1)


def corners(box: torch.Tensor) -> np.ndarray:
    """The eight corners of a 3D box in the camera's axes, as KITTI's tools compute them."""
    height, width, length, x, y, z, turn = box.tolist()
    cos, sin = np.cos(turn), np.sin(turn)
    ends = np.array([[a * length / 2, b, c * width / 2] for a in (-1, 1) for b in (0, -height) for c in (-1, 1)])
    return ends @ np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]]).T + [x, y, z]


def camera(**pose) -> Camera:
    return Camera.kitti(CANVAS, **pose)


def wall(shapes, x=10.0, y=0.0, width=2.0, height=2.0, **more):
    """A thin box across the road, its near side at x."""
    return Meshes("car", (shapes.box(0.02, width, height),), 0, x + 0.01, y, **more)


@given(
    st.floats(14, 60), st.floats(-0.6, 0.6), st.floats(-1, 1), st.floats(-4, 4), st.floats(-0.5, 0.5),
    st.lists(st.floats(0.3, 2), min_size=3, max_size=3),
)  # fmt: skip
def test_3d_boxes_project_to_the_amodal_boxes(shapes, x, side, z, yaw, turned, scale):
    car = Meshes("car", (shapes.box(4, 1.8, 1.5),), 0, x, side * x, z, yaw, torch.tensor(scale))
    batch = RENDERER(shapes.world(car, camera=camera(yaw=turned)))
    points, _ = cv2.projectPoints(
        corners(batch.space.box[0, 0]), np.zeros(3), np.zeros(3), batch.space.intrinsics[0].double().numpy(), None
    )
    expected = np.concatenate([points.min((0, 1)), points.max((0, 1))]) + 0.5
    np.testing.assert_allclose(batch.amodal_box[0, 0].numpy(), expected, atol=5e-2, rtol=1e-4)
    np.testing.assert_allclose(
        batch.space.box[0, 0, :3], np.array([1.5, 1.8, 4]) * np.array(scale)[[2, 1, 0]], rtol=1e-5
    )
    if batch.pixels[0, 0]:
        seen, whole = batch.box[0, 0], batch.amodal_box[0, 0]
        assert (seen[:2] >= whole[:2] - 0.5).all() and (seen[2:] <= whole[2:] + 0.5).all()


@given(st.floats(-0.3, 0.3), st.floats(-0.2, 0.2), st.floats(-0.5, 0.5))
def test_the_camera_turns_left_down_and_clockwise(shapes, yaw, pitch, roll):
    """A small cube far ahead, against OpenCV's rotations about the camera's own axes."""
    cube = Meshes("car", (shapes.box(0.5, 0.5, 0.5),), 0, 30.0, 1.0, 1.4)
    batch = RENDERER(shapes.world(cube, camera=camera(yaw=yaw, pitch=pitch, roll=roll)))
    turns = [cv2.Rodrigues(np.array(axis))[0] for axis in ((0, -yaw, 0.0), (-pitch, 0, 0.0), (0, 0, roll))]
    axes = turns[0] @ turns[1] @ turns[2]  # columns: the turned camera's in the straight one's
    point = np.array([-1.0, 0.0, 30.0]) @ axes
    pixel, _ = cv2.projectPoints(
        point[None], np.zeros(3), np.zeros(3), batch.space.intrinsics[0].double().numpy(), None
    )
    box = batch.amodal_box[0, 0].numpy()
    np.testing.assert_allclose((box[:2] + box[2:]) / 2, pixel.ravel() + 0.5, atol=0.15)


def test_intrinsics_and_depth_of_a_wall(shapes):
    batch = RENDERER(shapes.world(wall(shapes), camera=camera()))
    scale = 310 / 1242
    expected = [[KITTI_FOCAL * scale, 0, 610.0593 * scale - 0.5], [0, KITTI_FOCAL * scale, 173.354 * 94 / 375 - 0.5]]
    np.testing.assert_allclose(batch.space.intrinsics[0], [*expected, [0, 0, 1]], rtol=1e-6)
    mask = batch.instance[0] == 1
    assert torch.isclose(batch.space.depth[0][mask], torch.tensor(10.0)).all()
    assert mask.sum() == batch.pixels[0, 0] and torch.isinf(batch.space.depth[0][~mask]).all()
    focal, (u, v) = KITTI_FOCAL * scale, np.array(expected)[:, 2] + 0.5
    edges = [u - focal / 10, v - 0.35 * focal / 10, u + focal / 10, v + 1.65 * focal / 10]  # 1 m aside, 2 m high
    np.testing.assert_allclose(batch.amodal_box[0, 0], edges, rtol=1e-5)
    np.testing.assert_allclose(batch.box[0, 0], np.round(edges))


def test_truncation_is_the_share_outside_the_image(shapes):
    focal, left = KITTI_FOCAL * 310 / 1242, (610.0593 * 310 / 1242)
    middle = left / focal * 10  # the image's left border, 10 m ahead
    batch = RENDERER(shapes.world(wall(shapes, y=middle), camera=camera()))
    assert batch.space.truncated.item() == pytest.approx(0.5, abs=5e-3) and batch.visible.item() == 1
    batch = RENDERER(shapes.world(wall(shapes, y=middle + 3), camera=camera()))
    assert batch.space.truncated.item() == 1 and batch.visible.item() == 0 and batch.pixels.item() == 0
    assert not batch.box.any() and batch.amodal_box[0, 0, 2] < 0


def test_a_long_box_beside_the_camera_is_cut_at_the_near_plane(shapes):
    train = Meshes("car", (shapes.box(200, 3, 4),), 0, 0.0, 3.5)  # its right side is 2 m to the left
    batch = RENDERER(shapes.world(train, camera=camera()))
    focal, (u, v) = batch.space.intrinsics[0, 0, 0], batch.space.intrinsics[0, :2, 2] + 0.5
    expected = [u - focal * 2 / 0.1, v - focal * 2.35 / 0.1, u - focal * 2 / 100, v + focal * 1.65 / 0.1]
    np.testing.assert_allclose(batch.amodal_box[0, 0], expected, rtol=1e-3)
    assert batch.box[0, 0, 0] == 0 and batch.space.truncated.item() > 0.99 and batch.visible.item() == 1
    depth = batch.space.depth[0][batch.instance[0] == 1]
    assert depth.min() == pytest.approx(2 / float(u - 0.5) * float(focal), rel=1e-2) and 90 < depth.max() < 100


def test_around_the_camera_only_insides_face_it(shapes):
    batch = RENDERER(shapes.world(Meshes("car", (shapes.box(20, 20, 20),), 0, 0.0, 0.0, -5.0), camera=camera()))
    assert batch.pixels.item() == 0 and not batch.amodal_box.any() and batch.kind.item() == 0


def test_nearer_things_hide_others_and_covers_have_no_label(shapes):
    kind = torch.tensor([[0, 1]])
    two = wall(shapes, x=torch.tensor([[20.0, 10.0]]), y=torch.tensor([[0.0, -1.0]]), width=2.0)
    batch = RENDERER(shapes.world(two, kind=kind, camera=camera()))
    height, far, near = 2 * KITTI_FOCAL * 310 / 1242 / 20, batch.pixels[0, 0], batch.pixels[0, 1]
    assert 0.4 < batch.visible[0, 0] < 0.6 and batch.visible[0, 1] == 1
    assert near == pytest.approx(4 * height**2, rel=0.1) and far == pytest.approx(0.5 * height**2, rel=0.15)
    assert set(batch.space.semantic.unique().tolist()) == {0, 1, 2}
    cover = wall(shapes, x=5.0, y=-0.5, width=1.2, labelled=False)
    hidden = RENDERER(shapes.world(two, cover, kind=kind, camera=camera()))
    assert hidden.space.names == ("sky", "car", "tree", "decoration")
    assert (hidden.space.semantic[hidden.space.depth < 6] == 3).all()
    assert (hidden.instance[hidden.space.depth < 6] == 0).all()
    assert (hidden.visible < batch.visible).all() and torch.equal(hidden.amodal_box, batch.amodal_box)
    assert torch.equal(hidden.kind, kind)


def test_several_layers_of_a_node_are_one_thing(shapes):
    """A rider on a bike, the rider turned against it."""
    bike, rider = shapes.box(2, 0.4, 1), shapes.box(0.6, 0.6, 1)
    both = (
        Meshes("car", (bike,), 0, 12.0, 1.0, yaw=0.3),
        Meshes("car", (rider,), 0, 12.0, 1.0, 0.8, yaw=0.3 + np.pi / 2),
    )
    batch = RENDERER(shapes.world(*both, camera=camera()))
    apart = [RENDERER(shapes.world(layer, camera=camera())) for layer in both]
    assert batch.pixels == (batch.instance == 1).sum() and batch.visible.item() == 1  # what overlaps counts once
    assert batch.pixels < apart[0].pixels + apart[1].pixels
    low = torch.minimum(*(one.amodal_box[..., :2] for one in apart))
    high = torch.maximum(*(one.amodal_box[..., 2:] for one in apart))
    assert torch.equal(batch.amodal_box, torch.cat([low, high], -1))
    np.testing.assert_allclose(batch.space.box[0, 0, :3], [1.8, 0.6, 2], rtol=1e-5)
    torch.testing.assert_close(batch.space.box[0, 0, 3:], apart[0].space.box[0, 0, 3:])


def test_the_ground_hides_what_is_below_it_and_names_its_surfaces(shapes):
    deep = wall(shapes, height=1.0, z=-0.5)
    batch = RENDERER(shapes.world(deep, camera=camera(), ground=shapes.road()))
    assert batch.space.names == ("sky", "car", "tree", "road", "grass", "decoration")
    assert batch.visible.item() == pytest.approx(0.5, abs=0.1)
    semantic, columns = batch.space.semantic[0, -1].tolist(), np.arange(310)
    y = 1.65 * (batch.space.intrinsics[0, 0, 2].item() - columns) / (93 - batch.space.intrinsics[0, 1, 2].item())
    assert semantic == [3 if -4 <= side < 0.3 else 4 for side in y] or abs(np.diff(semantic)).sum() <= 2
    assert batch.space.depth[0, -1, 0] == pytest.approx(
        1.65 * batch.space.intrinsics[0, 1, 1].item() / (93 - batch.space.intrinsics[0, 1, 2].item()), rel=1e-4
    )
