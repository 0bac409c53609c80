"""Meshes and 3D scenes: what is checked before a renderer sees it."""

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch

from probscene.camera_effects import CameraEffects
from probscene.derive import derive
from probscene.errors import ModelError
from probscene.grammar import Grammar
from probscene.mesh import Mesh, Surface
from probscene.scene import SceneGraph
from probscene.structure import StructurePrior, counts
from probscene.world import KITTI_FOCAL, Camera, Ground, Light, Meshes

LOTS = Grammar("Scene -> Lots\nLots -> lot(Cars) Lots | ε\nCars -> car Cars | ε")
PRIOR = StructurePrior(LOTS, Lots=counts(0, 0, 1), Cars=counts(0, 1, 1))
TRIANGLE = {"positions": np.eye(3), "triangles": np.array([[0, 1, 2]]), "colour": np.array([255, 0, 0])}
GREY = Surface("road", np.full((4, 4, 3), 90, np.uint8), (2.0, 2.0))


def built(num_scenes=5, camera=None, light=None, **more):
    """Worlds with two lots, each with one or two cars; ``more`` replaces fields of the cars."""
    mesh = Mesh(**TRIANGLE)
    pyro.set_rng_seed(0)
    with pyro.plate("scenes", num_scenes, dim=-2):
        scene = SceneGraph(LOTS, derive(LOTS, PRIOR, num_scenes, 16))
        with scene.nodes("car"):
            x = pyro.sample("car.x", dist.Uniform(5.0, 30.0))
    cars = {"kinds": "car", "meshes": (mesh,), "mesh": 0, "x": x, "y": 1.0, **more}
    return scene.build(Meshes(**cars), camera=camera or Camera(), light=light)


def test_a_world_holds_every_value_of_every_scene():
    world = built(camera=Camera(yaw=torch.linspace(0, 1, 5).unsqueeze(1)), tint=(0.5, 1.0, 0.25))
    layer = world.layers[0]
    M = world.kind.shape[1]
    assert layer.scale.shape == layer.tint.shape == (5, M, 3)
    assert torch.equal(layer.present, world.kind == LOTS.kind("car"))
    assert torch.equal(layer.tint[0, 0], torch.tensor([0.5, 1.0, 0.25]))
    assert world.camera.yaw.tolist() == pytest.approx([0, 0.25, 0.5, 0.75, 1.0])
    assert torch.equal(world.camera.focal, torch.full((5,), KITTI_FOCAL))
    assert world.light.zenith.shape == (5, 3) and world.photo.seed.dtype == torch.int64
    part = world[1:3]
    assert len(part) == 2 and torch.equal(part.camera.yaw, world.camera.yaw[1:3])
    assert torch.equal(part.layers[0].x, layer.x[1:3])


@pytest.mark.parametrize(
    "scale", [2.0, torch.full((5, 1), 2.0), torch.tensor([2.0, 2.0, 2.0]), torch.full((1, 1, 3), 2.0)]
)
def test_a_scale_is_one_number_or_one_for_each_axis(scale):
    assert (built(scale=scale).layers[0].scale == 2).all()


def test_kittis_camera_sees_the_same_on_half_of_the_pixels():
    """A point's place in an image of half the size is half as far from the image's outer corner."""
    whole, half = Camera.kitti((376, 1242)), Camera.kitti((188, 621))
    assert whole.focal == pytest.approx(721.5377) and whole.centre_x == pytest.approx(609.5593)
    for x, z in ((3.0, 10.0), (-8.0, 25.0)):
        full, small = (c.focal * x / z + c.centre_x + 0.5 for c in (whole, half))
        assert small == pytest.approx(full / 2)
    assert half.centre_y + 0.5 == pytest.approx((whole.centre_y + 0.5) / 2)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"triangles": np.zeros((0, 3), int)}, "got an empty one"),
        ({"triangles": np.array([[0, 1, 2, 2]])}, r"triangles of a mesh of shape \(1, 3\), got \(1, 4\)"),
        ({"triangles": np.array([[0, 1, 3]])}, r"vertices 0..2 .* got 0..3"),
        ({"positions": np.eye(3) * np.nan}, "finite positions"),
        ({"positions": np.eye(3) * 400}, "at most 200 m, got 400 m"),
        ({"texture": np.zeros((2, 2, 3), np.uint8)}, "texture coordinates"),
        ({"uv": np.zeros((1, 3, 3))}, r"uv of a mesh of shape \(1, 3, 2\)"),
        ({"colour": (0.8, 0.1, 0.0)}, r"colour of a mesh in 0..255, got 0.8; multiply by 255"),
        ({"colour": np.array([[0, 300, -2]])}, r"colour of a mesh in 0..255, got -2; clip it"),
        (
            {"texture": np.full((2, 2, 3), 0.5), "uv": np.zeros((1, 3, 2))},
            r"texture of a mesh in 0..255, got 0.5; multiply by 255",
        ),
    ],
)
def test_meshes_that_are_none(change, message):
    with pytest.raises(ModelError, match=message):
        Mesh(**{**TRIANGLE, **change})


def test_a_mesh_does_not_change_with_its_source():
    positions = np.eye(3)
    mesh = Mesh(positions, np.array([[0, 1, 2]]), (1, 2, 3))
    positions[:] = 7
    assert mesh.positions.max() == 1 and mesh.size.tolist() == [1, 1, 1] and mesh.tinted.all()
    with pytest.raises(ValueError, match="read-only"):
        mesh.positions[0] = 2


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"mesh": 1}, r"mesh in 0..0, got 1..1"),
        ({"x": torch.zeros(3)}, r"x to broadcast to \(5, "),
        ({"yaw": float("nan")}, "finite values in Meshes\\('car'\\).yaw"),
        ({"scale": 0.0}, "positive Meshes\\('car'\\).scale, got 0"),
        ({"tint": (255, 0, 0)}, r"expected Meshes\('car'\).tint in 0..1, got 255; divide by 255"),
        ({"tint": torch.tensor([0.5, 1.0, 300.0])}, r"tint in 0..1, got 300; .* clamp it"),
        ({"light": Light(zenith=(90, 140, 220))}, r"expected Light.zenith in 0..1, got 220; divide by 255"),
        ({"light": Light(horizon=torch.full((5, 3), 200.0))}, r"Light.horizon in 0..1, got 200; divide by 255"),
        ({"camera": Camera(focal=-700.0)}, "positive focal length in pixels, got -700"),
        ({"camera": Camera(pitch=torch.zeros(4, 1))}, r"Camera.pitch to broadcast to \(5, 1\), got shape \(4, 1\)"),
    ],
)
def test_worlds_that_cannot_be(more, message):
    with pytest.raises(ModelError, match=message):
        built(**more)


def test_grounds_that_cannot_be():
    mesh = Mesh(**TRIANGLE)
    pyro.set_rng_seed(0)
    with pyro.plate("scenes", 2, dim=-2):
        scene = SceneGraph(LOTS, derive(LOTS, PRIOR, 2, 16))
    cars = Meshes("car", (mesh,), 0, 5.0, 0.0)

    def build(edges, surface):
        return scene.build(cars, camera=Camera(), ground=Ground((GREY,), torch.tensor(edges), torch.tensor(surface)))

    assert build([[-1.0, 1.0]], [[0, 0, 0]]).ground.edges.shape == (2, 2)
    with pytest.raises(ModelError, match="ascending"):
        build([[1.0, -1.0]], [[0, 0, 0]])
    with pytest.raises(ModelError, match=r"Ground.edges to broadcast to \(2, 2\)"):
        build([[-1.0, 0.0, 1.0]], [[0, 0, 0]])
    with pytest.raises(ModelError, match=r"surface in 0..0, got 0..1"):
        build([[-1.0, 1.0]], [[0, 1, 0]])
    assert Light().sun > 0 and CameraEffects().noise == 0


def test_surfaces_that_are_none():
    with pytest.raises(ModelError, match=r"uint8 \(h, w, 3\)"):
        Surface("road", np.zeros((2, 2), np.uint8), (1.0, 1.0))
    with pytest.raises(ModelError, match="with extent"):
        Surface("road", np.zeros((2, 2, 3), np.uint8), (1.0, 0.0))
