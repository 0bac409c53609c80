"""Laws of the mesh renderer, against its numpy twin and against itself."""

import os
import resource
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from reference.meshes import MeshReference

from probscene.camera_effects import CameraEffects
from probscene.errors import ModelError
from probscene.renderers.meshes import MeshRenderer
from probscene.renderers.meshes import renderer as meshes_module
from probscene.world import KITTI_CANVAS, Camera, Light, Meshes, resolve_scene

CANVAS = (40, 66)
RENDERER, SMOOTH = (MeshRenderer(CANVAS, threads=1, samples=samples) for samples in (1, 4))


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
    photo = CameraEffects(
        *(uniform(0.7, 1.3, number, 1) for _ in range(3)), noise=uniform(0, 9, number, 1), seed=seed % 1000
    )
    gains = torch.from_numpy(np.random.default_rng(seed).uniform(0.8, 1.2, (2, number, 1)))
    photo = replace(photo, red_gain=gains[0], blue_gain=gains[1], vignette=1.5 * (1.2 - gains[0]))
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
    assert (apart > 3).float().mean() < 1e-3


def agrees(ours, twin):
    """Labels are equal, but for what rounding may change."""
    assert [tensor.dtype for tensor in ours[:7]] == [tensor.dtype for tensor in twin[:7]]
    assert [tensor.shape for tensor in ours[:7]] == [tensor.shape for tensor in twin[:7]]
    assert ours.space.names == twin.space.names and torch.equal(ours.kind, twin.kind)
    same = (ours.instance == twin.instance) & (ours.space.semantic == twin.space.semantic)
    assert (~same).float().mean() <= 1e-3
    deep, depth = ours.space.depth[same], twin.space.depth[same]
    close = torch.isclose(deep, depth, rtol=1e-3)
    assert (~close).float().mean() <= 1e-3
    if same.all():
        assert torch.equal(ours.pixels, twin.pixels) and torch.equal(ours.box, twin.box)
        torch.testing.assert_close(ours.visible, twin.visible, rtol=0, atol=0.02)
    torch.testing.assert_close(ours.amodal_box, twin.amodal_box, rtol=1e-4, atol=1e-2)
    torch.testing.assert_close(ours.space.truncated, twin.space.truncated, rtol=0, atol=1e-3)
    torch.testing.assert_close(ours.space.box, twin.space.box, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(ours.space.intrinsics, twin.space.intrinsics)


@pytest.mark.parametrize("seed", [0, 1])
def test_agrees_with_the_numpy_twin_at_full_size(shapes, seed):
    """As large as KITTI's images; lines are as long as 78 times what is shaded at once."""
    (height, width), world = KITTI_CANVAS, random_world(shapes, seed)[:1]
    camera = Camera.kitti(KITTI_CANVAS, z=2.0, pitch=0.1, roll=0.2)
    world = replace(world, camera=resolve_scene(camera, 1))
    ours = MeshRenderer(KITTI_CANVAS, threads=1)(world)
    assert ours.image.shape == (1, 3, height, width) and ours.pixels.any()
    agrees(ours, MeshReference(KITTI_CANVAS, colours=False)(world))


@settings(max_examples=6)
@given(st.integers(0, 2**32 - 1), st.booleans())
def test_agrees_with_the_numpy_twin_through_a_longer_lens(shapes, seed, thick):
    """Where what hardly changes is computed once for several pixels."""
    canvas = (30, 150)
    world = random_world(shapes, seed, sun=False)
    haze = torch.full((len(world),), 0.1 if thick else 0.002)
    parts = {"camera": Camera(600.0, 75.0, 12.0, pitch=0.03), "light": Light(sun=0.0)}
    parts = {name: resolve_scene(part, len(world)) for name, part in parts.items()}
    world = replace(world, camera=parts["camera"], light=replace(parts["light"], haze=haze))
    ours, twin = MeshRenderer(canvas, threads=1)(world), MeshReference(canvas)(world)
    agrees(ours, twin)
    apart = (ours.image.int() - twin.image.int()).abs().amax(1)
    assert (apart > 3).float().mean() < 0.01


@settings(max_examples=12)
@given(st.integers(0, 2**32 - 1))
def test_shadows_are_where_rays_to_the_sun_are_stopped(shapes, seed):
    world = random_world(shapes, seed)
    ours, twin = RENDERER(world), MeshReference(CANVAS)(world)
    agrees(ours, twin)
    apart = (ours.image.int() - twin.image.int()).abs().amax(1)
    assert (apart > 12).float().mean() < 0.1  # the map's texels are not rays, and are many pixels close by


@settings(max_examples=12)
@given(st.integers(0, 2**32 - 1))
def test_four_samples_are_the_mean_of_four_rays_and_leave_labels_alone(shapes, seed):
    world = random_world(shapes, seed, sun=False)
    smooth, plain = SMOOTH(world), RENDERER(world)
    assert shapes.same(smooth._replace(image=plain.image), plain)
    apart = (smooth.image.int() - MeshReference(CANVAS, 4)(world).image.int()).abs().amax(1)
    assert (apart > 8).float().mean() < 0.03  # where all four see one triangle, it is shaded once


@given(st.integers(0, 2**32 - 1), st.integers(0, 3), st.sampled_from([1, 4]))
def test_same_bytes_for_any_threads_and_any_batch(shapes, seed, cut, samples):
    world = random_world(shapes, seed)
    batch = (RENDERER if samples == 1 else SMOOTH)(world)
    assert shapes.same(batch, MeshRenderer(CANVAS, threads=2, samples=samples)(world))
    for part in (slice(0, cut), slice(cut, None), slice(cut, cut + 1)):
        again = (RENDERER if samples == 1 else SMOOTH)(world[part])
        space = batch.space._replace(**{k: v[part] for k, v in batch.space._asdict().items() if k != "names"})
        assert shapes.same(batch.__class__(*(tensor[part] for tensor in batch[:7]), space), again)


def many(shapes, number: int):
    """Worlds of two boxes, no two alike."""
    generator = np.random.default_rng(0)
    kind = torch.zeros(number, 2, dtype=torch.int64)
    x, y = (torch.from_numpy(generator.uniform(*limits, kind.shape)) for limits in ((5, 20), (-3, 3)))
    boxes = Meshes("car", (shapes.box(2, 1, 1),), 0, x, y)
    return shapes.world(boxes, kind=kind, ground=shapes.road(), camera=Camera.kitti(CANVAS))


def test_same_bytes_for_several_launches(shapes, monkeypatch):
    world = many(shapes, 150)  # more than one launch has
    batch = RENDERER(world)
    assert batch.pixels.gt(0).any(1).float().mean() > 0.9
    for name in ("_SCENES", "_CHUNK"):
        monkeypatch.setattr(meshes_module, name, 1)
        assert shapes.same(batch, MeshRenderer(CANVAS, threads=2)(world))


def test_nothing_is_left_of_the_world_before(shapes, monkeypatch):
    worlds = [random_world(shapes, seed) for seed in (3, 4, 5)]
    batches = [RENDERER(world) for world in worlds]
    renderer = MeshRenderer(CANVAS, threads=1)
    assert all(shapes.same(renderer(worlds[i]), batches[i]) for i in (0, 2, 1, 0))
    monkeypatch.setattr("probscene.renderers.meshes.tables.atlas._FACES", 0)  # forget the meshes at every call
    renderer = MeshRenderer(CANVAS, threads=1)
    assert all(shapes.same(renderer(worlds[i]), batches[i]) for i in (0, 2, 1, 0))


def test_the_batch_owns_its_memory(shapes):
    world = many(shapes, 2)
    first = RENDERER(world)
    kept = first.image.clone()
    RENDERER(random_world(shapes, 1)).image.zero_()
    assert torch.equal(first.image, kept)


def test_memory_stays_flat(shapes):
    """Meshes, textures and worlds of their own at each call."""
    renderer = MeshRenderer(CANVAS, threads=1)
    for i in range(320):
        renderer(many(shapes, 8))
        if i == 20:
            before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 30_000  # kB


@pytest.mark.parametrize("shape", [(0, 0), (0, 3), (2, 0), (2, 1)])
@pytest.mark.parametrize("layers", [0, 1])
@pytest.mark.parametrize("samples", [1, 4])
def test_empty_worlds(shapes, shape, layers, samples):
    nothing = torch.zeros(shape, dtype=torch.bool)
    layer = Meshes("car", (shapes.box(1, 1, 1),), 0, 5.0, 0.0)
    for ground in (None, shapes.road()):
        world = shapes.world(*(layer,) * layers, kind=torch.full(shape, -1), present=nothing, ground=ground)
        batch = MeshRenderer(CANVAS, 1, samples)(world)
        assert batch.image.shape == (shape[0], 3, *CANVAS) and not batch.instance.any()
        assert batch.box.shape == batch.amodal_box.shape == (*shape, 4) and batch.space.box.shape == (*shape, 7)
        assert (batch.kind == -1).all() and not batch.visible.any() and not batch.space.truncated.any()
        assert ground is not None or torch.isinf(batch.space.depth).all()


def test_where_nothing_is_visible_there_is_the_background(shapes):
    """A node behind the camera, one below the ground, and one too far to cover a pixel."""
    kind = torch.zeros(1, 3, dtype=torch.int64)
    x, z = torch.tensor([[-9.0, 9.0, 9e5]]), torch.tensor([[0.0, -3.0, 0.0]])
    hidden = shapes.world(Meshes("car", (shapes.box(1, 1, 1),), 0, x, 0.0, z), kind=kind, ground=shapes.road())
    batch, empty = RENDERER(hidden), RENDERER(shapes.world(ground=shapes.road()))
    assert torch.equal(batch.image, empty.image) and torch.equal(batch.space.depth, empty.space.depth)
    assert batch.kind.tolist() == [[0, 0, 0]] and not batch.pixels.any() and not batch.box.any()
    for labels in (batch.amodal_box, batch.visible, batch.space.truncated, batch.space.box):
        assert torch.isfinite(labels).all()


def test_what_is_behind_the_camera_has_an_empty_label(shapes):
    world = shapes.world(Meshes("car", (shapes.box(2, 1, 1),), 0, -9.0, 0.0))
    batch = RENDERER(world)
    assert batch.kind.item() == 0 and batch.pixels.item() == 0 and batch.visible.item() == 0
    assert not batch.box.any() and not batch.amodal_box.any() and batch.space.truncated.item() == 0
    assert batch.space.box[0, 0].tolist() == pytest.approx([1, 1, 2, 0, 1.65, -9, -np.pi / 2])


def test_the_last_of_very_many_nodes_has_its_id(shapes):
    present = torch.zeros(1, 32767, dtype=torch.bool)
    present[0, -1] = True
    kind = torch.zeros(1, 32767, dtype=torch.int64)
    camera = Camera.kitti(CANVAS)
    wall = Meshes("car", (shapes.box(1, 9, 9),), 0, 8.0, 0.0)
    batch = RENDERER(shapes.world(wall, kind=kind, present=present, camera=camera))
    assert batch.instance[0, 10, 30] == 32767 and batch.pixels[0, -1] > 0
    with pytest.raises(ModelError, match="32767 nodes"):
        RENDERER(shapes.world(kind=torch.zeros(1, 32768, dtype=torch.int64)))


def test_more_meshes_or_triangles_than_there_may_be_are_named(shapes, monkeypatch):
    dots = Meshes(
        (), (shapes.box(1, 1, 1),), 0, 50.0, 0.0, present=torch.ones(1, 65536, dtype=torch.bool), labelled=False
    )
    with pytest.raises(ModelError, match="at most 65535 meshes in a scene, got 65536"):
        RENDERER(shapes.world(dots))
    monkeypatch.setattr(meshes_module, "_MOST_TRIANGLES", 23)
    with pytest.raises(ModelError, match="at most 23 triangles in sight of a scene, got 24"):
        RENDERER(many(shapes, 1))


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("x", float("nan"), "finite x"),
        ("yaw", float("inf"), "finite yaw"),
        ("y", 2e6, "y within 1e\\+06 m, got 2e\\+06"),
        ("scale", 0.0, "got 0; bound"),
        ("scale", 1e9, "at most 10000 in a world, got 1e\\+09"),
        ("mesh", 3, r"meshes of layer 0 in 0\.\.0, got 3\.\.3"),
    ],
)
def test_what_cannot_be_rendered_is_named(shapes, field, value, message):
    world = shapes.world(Meshes("car", (shapes.box(1, 1, 1),), 0, 9.0, 0.0))
    (layer,) = world.layers
    broken = replace(layer, **{field: torch.full_like(getattr(layer, field), value)})
    with pytest.raises(ModelError, match=message):
        RENDERER(replace(world, layers=(broken,)))
    absent = replace(broken, present=torch.zeros(1, 1, dtype=torch.bool))
    assert not RENDERER(replace(world, layers=(absent,))).instance.any()


def test_worlds_that_cannot_be_are_named(shapes):
    world = shapes.world(Meshes("car", (shapes.box(1, 1, 1),), 0, 9.0, 0.0))
    with pytest.raises(ModelError, match="layer 0 as"):
        RENDERER(replace(world, kind=torch.zeros(1, 2, dtype=torch.int64)))
    for focal in (-1.0, 0.0):
        with pytest.raises(ModelError, match="positive focal length"):
            RENDERER(replace(world, camera=replace(world.camera, focal=torch.tensor([focal]))))
    for focal in (np.nan, np.inf):
        with pytest.raises(ModelError, match="finite cameras"):
            RENDERER(replace(world, camera=replace(world.camera, focal=torch.tensor([focal]))))
    with pytest.raises(ModelError, match="finite cameras"):
        RENDERER(replace(world, camera=replace(world.camera, yaw=torch.tensor([np.inf]))))
    with pytest.raises(ModelError, match="at most 256 classes"):
        RENDERER(replace(world, kinds=tuple(map(str, range(300)))))


@pytest.mark.parametrize(
    "options", [((0, 5), 1), ((5, -1), 1), ((1 << 13, 1 << 12), 1), ((5, 5), 0), ((5, 5), 1, 2), ((5, 5), 1, 16)]
)
def test_renderers_that_cannot_be_are_named(options):
    with pytest.raises(ModelError, match="expected"):
        MeshRenderer(*options)


def test_a_users_own_engine_is_left_alone():
    code = """
import torch
from probscene.renderers import engine
from probscene.renderers.meshes import MeshRenderer
from probscene.world import KITTI_CANVAS, Camera, Light, CameraEffects, World, resolve_scene
engine.ti.init(arch=engine.ti.cpu, default_ip=engine.ti.i64, default_fp=engine.ti.f64, offline_cache=False)
parts = {k: resolve_scene(v, 1) for k, v in dict(camera=Camera(), light=Light(), photo=CameraEffects()).items()}
batch = MeshRenderer((20, 20), threads=1)(World(torch.zeros(1, 0, dtype=torch.int64), (), (), ground=None, **parts))
assert batch.image.float().mean() > 100
"""
    # Quick to compile, which is most of it.
    quick = {f"{prefix}_{option}": "0" for prefix in ("TI", "QD") for option in ("ADVANCED_OPTIMIZATION", "OPT_LEVEL")}
    environment = {**os.environ, **quick}
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
