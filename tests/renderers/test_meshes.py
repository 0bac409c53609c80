"""Laws of the mesh renderer, against its numpy twin and against itself."""

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from probscene.renderers.mesh_reference import MeshReference
from probscene.renderers.meshes import MeshRenderer
from probscene.world import Camera, Light, Meshes, Photo

CANVAS = (40, 66)
RENDERER = MeshRenderer(CANVAS, threads=1)


def random_world(shapes, seed, sun=True, lying=True):
    """One scene or two: meshes before, behind, beside and around the camera, with nodes, a cover and decoration."""
    generator = np.random.default_rng(seed)
    number, nodes, spare = int(generator.integers(1, 3)), int(generator.integers(1, 5)), int(generator.integers(1, 3))
    texture = generator.integers(60, 256, (8, 16, 3)).astype(np.uint8)
    meshes = (
        shapes.box(*generator.uniform(0.5, 6, 3), (200, 180, 160), tinted=generator.random(12) < 0.5),
        shapes.box(60, 0.5, 4, (255, 255, 255), texture=texture),
        shapes.cylinder(1.5, 3, 8, (180, 160, 140)),
    )

    def uniform(low, high, *shape):
        return torch.from_numpy(generator.uniform(low, high, shape))

    def layer(kinds, count, **more):
        shape = (number, count)
        return Meshes(
            kinds, meshes, torch.from_numpy(generator.integers(0, 3, shape)), uniform(-8, 25, *shape),
            uniform(-12, 12, *shape), uniform(-1.5, 1, *shape), uniform(-4, 4, *shape), uniform(0.3, 1.5, *shape, 3),
            uniform(0.2, 1, *shape, 3), **more,
        )  # fmt: skip

    def some(count):
        return torch.from_numpy(generator.random((number, count)) < 0.8)

    camera = Camera(
        uniform(30, 80, number, 1), uniform(20, 45, number, 1), uniform(10, 30, number, 1), z=uniform(1, 4, number, 1),
        yaw=uniform(-3, 3, number, 1), pitch=uniform(-0.5, 0.7, number, 1), roll=uniform(-0.6, 0.6, number, 1),
    )  # fmt: skip
    light = Light(
        uniform(-3, 3, number, 1), uniform(0.3, 1.4, number, 1), 0.6 if sun else 0.0, haze=uniform(0, 0.03, number, 1)
    )
    photo = Photo(
        *(uniform(0.7, 1.3, number, 1) for _ in range(3)), noise=uniform(0, 9, number, 1), seed=seed % 1000
    )
    layers = [
        layer("car", nodes, present=some(nodes)),
        layer("car", nodes, present=some(nodes) & some(nodes), labelled=bool(generator.integers(0, 2))),
        layer((), spare, present=some(spare), labelled=False),
    ]
    ground = shapes.road(offset=uniform(-3, 3, number, 1)) if lying else None
    kind = torch.from_numpy(generator.integers(0, 2, (number, nodes)))
    return shapes.world(*layers, kind=kind, camera=camera, light=light, photo=photo, ground=ground)


@settings(max_examples=60)
@given(st.integers(0, 2**32 - 1), st.booleans())
def test_agrees_with_the_numpy_twin(shapes, seed, lying):
    world = random_world(shapes, seed, sun=False, lying=lying)
    ours, twin = RENDERER(world), MeshReference(CANVAS)(world)
    agrees(ours, twin)
    apart = (ours.image.int() - twin.image.int()).abs().amax(1)
    assert (apart > 3).float().mean() < 0.01


def agrees(ours, twin):
    """Labels are equal, but for what rounding may change."""
    assert [tensor.dtype for tensor in ours[:-1]] == [tensor.dtype for tensor in twin[:-1]]
    assert [tensor.shape for tensor in ours[:-1]] == [tensor.shape for tensor in twin[:-1]]
    assert ours.space.names == twin.space.names and torch.equal(ours.kind, twin.kind)
    same = (ours.instance == twin.instance) & (ours.space.semantic == twin.space.semantic)
    assert (~same).float().mean() <= 1e-3
    deep, depth = ours.space.depth[same], twin.space.depth[same]
    close = torch.isclose(deep, depth, rtol=1e-3)
    assert (~close).float().mean() <= 1e-3
    assert (ours.pixels - twin.pixels).abs().max() <= 3 and (ours.box - twin.box).abs().max() <= 40
    torch.testing.assert_close(ours.amodal_box, twin.amodal_box, rtol=1e-4, atol=1e-2)
    torch.testing.assert_close(ours.space.truncated, twin.space.truncated, rtol=0, atol=1e-3)
    torch.testing.assert_close(ours.space.box, twin.space.box, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(ours.space.intrinsics, twin.space.intrinsics)
