"""Light, shadow, air and texture of the mesh renderer, against cases worked out by hand."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from probscene.camera_effects import CameraEffects
from probscene.mesh import Surface
from probscene.renderers.meshes import MeshRenderer
from probscene.renderers.meshes.tables.texture_atlas import TextureAtlas
from probscene.world import Camera, Ground, Light, Meshes

CANVAS = (188, 300)
RENDERER = MeshRenderer(CANVAS, threads=1)
GREY = 100


def plain(colour=(GREY, GREY, GREY), tile=(1.0, 1.0)) -> Ground:
    return covered(np.full((2, 2, 3), colour, np.uint8), tile)


def covered(texture, tile=(1.0, 1.0), **more) -> Ground:
    return Ground((Surface("road", texture, tile),), torch.zeros(1, 0), torch.zeros(1, 1, dtype=torch.int64), **more)


def above(height=60.0, x=0.0, focal=600.0) -> Camera:
    """Straight above the ground, x upward in the image."""
    return Camera(focal, 150.0, 94.0, x, 0.0, height, pitch=np.pi / 2)


def pixel(camera: Camera, x: float, y: float, z: float = 0.0) -> tuple[int, int]:
    """Row and column of a point that ``above`` looks at."""
    scale = camera.focal / (camera.z - z)
    return round(94 - (x - camera.x) * scale), round(150 - y * scale)


def light(**more) -> Light:
    return Light(**{"haze": 0.0, "azimuth": 0.0, "elevation": np.pi / 2, "sun": 0.5, "ambient": 0.4, **more})


@settings(max_examples=15)
@given(st.floats(0.45, 1.2), st.floats(-3.1, 3.1), st.floats(1, 3))
def test_a_box_casts_a_shadow_as_long_as_the_sun_is_low(shapes, elevation, azimuth, height):
    """From above: dark from the box to its height over the tangent of the elevation, away from the sun."""
    camera, length = above(), height / np.tan(elevation)
    post = Meshes("car", (shapes.box(0.8, 0.8, height),), 0, 0.0, 0.0)
    sun = light(elevation=elevation, azimuth=azimuth)
    image = RENDERER(shapes.world(post, camera=camera, ground=plain(), light=sun)).image[0, 0].numpy()
    bright = round(GREY * (0.5 * np.sin(elevation) + 0.4))
    dark = round(GREY * 0.4)

    def at(distance, aside=0.0):
        x, y = -distance * np.cos(azimuth), -distance * np.sin(azimuth)
        return image[pixel(camera, x - aside * np.sin(azimuth), y + aside * np.cos(azimuth))]

    for distance in np.arange(0.8, length - 0.9, 0.1):
        assert abs(int(at(distance)) - dark) <= 1
    reach = 0.8 + length
    assert abs(int(at(reach)) - bright) <= 1 and abs(int(at(-1.0)) - bright) <= 1
    assert abs(int(at(max(length / 2, 1.0), 1.0)) - bright) <= 1 and abs(int(at(length / 2, -1.2)) - bright) <= 1
    end = [distance for distance in np.arange(0.8, reach, 0.02) if at(distance) > (dark + bright) / 2]
    if length > 1:  # the top's far edge is up to 0.57 m from its middle
        assert length + 0.25 < end[0] < length + 0.7


def test_things_shade_one_another_and_covers_cast_shadows(shapes):
    low = Meshes("car", (shapes.box(4, 4, 1),), 0, 0.0, 0.0)
    roof = Meshes("car", (shapes.box(4, 4, 0.2),), 0, 2.0, 0.0, 6.0, labelled=False)
    camera, sun = above(), light(elevation=np.pi / 4)
    image = RENDERER(shapes.world(low, roof, camera=camera, ground=plain(), light=sun)).image[0, 0]
    lit, dark = round(255 * (0.5 * np.sqrt(0.5) + 0.4)), round(255 * 0.4)
    assert abs(int(image[pixel(camera, -1.5, 0, 1)]) - dark) <= 1  # the roof's shadow covers x from -5 to -1 there
    assert abs(int(image[pixel(camera, -0.4, 1, 1)]) - lit) <= 1


def test_the_sun_is_off_below_the_horizon(shapes):
    post = Meshes("car", (shapes.box(1, 1, 2),), 0, 0.0, 0.0)
    for elevation in (-0.3, 0.0):
        world = shapes.world(post, camera=above(), ground=plain(), light=light(elevation=elevation))
        assert RENDERER(world).image[0, 0, 10, 10] == round(GREY * 0.4)


def test_light_of_sun_and_sky_by_facing(shapes):
    """A cube's near side, from the front: upright, towards the sun and then in its own shadow."""
    cube = Meshes("car", (shapes.box(2, 2, 2, (200, 100, 50)),), 0, 10.0, 0.0)
    camera = Camera(300.0, 150.0, 94.0, z=1.0)
    for azimuth, cosine in ((np.pi, 1.0), (0.0, 0.0)):
        sun = light(azimuth=azimuth, elevation=0.5)
        image = RENDERER(shapes.world(cube, camera=camera, light=sun)).image[0, :, 94, 150].numpy()
        expected = np.array([200, 100, 50]) * (0.5 * cosine * np.cos(0.5) + 0.4 * 0.75)
        np.testing.assert_allclose(image, expected, atol=1)


def test_tints_are_for_the_tinted(shapes):
    tinted = np.zeros(12, bool)
    tinted[[4, 10]] = True  # the side at low z
    mesh = shapes.box(2, 2, 2, (200, 200, 200), tinted=~tinted)
    kind = torch.zeros(1, 2, dtype=torch.int64)
    cubes = Meshes(
        "car", (mesh,), 0, 10.0, torch.tensor([[-2.0, 2.0]]), tint=torch.tensor([[[0.5, 1, 0.0], [1, 1, 1.0]]])
    )
    camera = Camera(300.0, 150.0, 94.0, z=1.0)
    image = RENDERER(shapes.world(cubes, kind=kind, camera=camera, light=light(sun=0.0, ambient=1.0))).image[0]
    assert image[:, 94, 217].tolist() == [75, 150, 0] and image[:, 94, 83].tolist() == [150, 150, 150]


def test_air_takes_on_the_horizons_colour(shapes):
    wall = Meshes("car", (shapes.box(0.02, 20, 20, (0, 0, 0)),), 0, 40.01, 0.0)
    air = light(haze=0.02, horizon=(0.8, 0.6, 0.4), zenith=(0.2, 0.2, 1.0))
    camera = Camera(300.0, 150.0, 94.0, z=5.0)
    image = RENDERER(shapes.world(wall, camera=camera, light=air)).image[0]
    for column in (150, 200):
        distance = 40 * np.hypot(1, (column - 150) / 300)
        expected = 255 * (1 - np.exp(-0.02 * distance)) * np.array([0.8, 0.6, 0.4])
        np.testing.assert_allclose(image[:, 94, column], expected, atol=1.5)
    sine = 90 / np.sqrt(300**2 + 90**2 + 140**2)
    expected = 255 * (np.array([0.8, 0.6, 0.4]) * (1 - sine) + np.array([0.2, 0.2, 1.0]) * sine)
    np.testing.assert_allclose(image[:, 4, 290], expected, atol=1)
    np.testing.assert_allclose(image[:, 150, 290], np.array([204, 153, 102]), atol=1)  # no ground


def test_textures_lie_along_the_road_from_its_offset(shapes):
    """Rows along x, columns to the right; four colours a tile of 8 m by 4 m."""
    texture = np.array([[[250, 0, 0], [0, 250, 0]], [[0, 0, 250], [250, 250, 250]]], np.uint8)
    camera = above(x=1.0)
    for offset in (0.0, 1.5, -9.0):
        ground = covered(texture, (8.0, 4.0), offset=offset)
        image = RENDERER(shapes.world(camera=camera, ground=ground, light=light(sun=0.0, ambient=1.0))).image[0]
        for x, y, row, column in (
            (2, -1, 0, 0),
            (2, -3, 0, 1),
            (6, -1, 1, 0),
            (6, -3, 1, 1),
            (2, 3, 0, 0),
            (-2, 1, 1, 1),
        ):
            if abs(x + offset - 1) < 8:
                seen = image[:, *pixel(camera, x + offset, y)].numpy()
                np.testing.assert_allclose(seen, texture[row, column], atol=3)


def test_far_textures_become_their_mean(shapes):
    checks = np.indices((8, 8)).sum(0)[..., None] % 2 * np.full(3, 200)
    world = shapes.world(
        camera=Camera(200.0, 150.0, 60.0, z=2.0),
        ground=covered(checks.astype(np.uint8)),
        light=light(sun=0.0, ambient=1),
    )
    image = RENDERER(world).image[0, 0].float()
    assert (image[62:68] - 100).abs().max() <= 1 and image[-1].std() > 15


def test_meshes_textures_repeat(shapes):
    texture = np.array([[[250, 0, 0], [0, 250, 0]], [[0, 0, 250], [250, 250, 250]]], np.uint8)
    one, many = shapes.box(2, 2, 2, texture=texture), shapes.box(2, 2, 2)
    shifted = type(one)(many.positions, many.triangles, many.colour, uv=many.uv - 7, texture=texture)
    camera = Camera(300.0, 150.0, 94.0, z=1.0)
    images = [RENDERER(shapes.world(Meshes("car", (m,), 0, 10.0, 0.0), camera=camera)).image for m in (one, shifted)]
    assert (images[0].int() - images[1].int()).abs().max() <= 3
    assert images[0][0, :, 80, 140].tolist() != images[0][0, :, 80, 160].tolist()


def test_what_the_camera_makes_of_colours(shapes):
    colour = np.array([40.0, 100.0, 180.0])
    grey = colour @ [0.299, 0.587, 0.114]

    def seen(**photo):
        lit = light(sun=0.0, ambient=1.0)
        world = shapes.world(camera=above(), ground=plain(colour), light=lit, photo=CameraEffects(**photo))
        return RENDERER(world).image[0, :, 50, 50].numpy()

    np.testing.assert_allclose(seen(), colour, atol=0.6)
    np.testing.assert_allclose(seen(exposure=1.2), colour * 1.2, atol=0.6)
    np.testing.assert_allclose(seen(exposure=9.0), [255, 255, 255])
    np.testing.assert_allclose(seen(saturation=0.0), [grey] * 3, atol=0.6)
    np.testing.assert_allclose(seen(contrast=0.5), colour / 2 + 63.75, atol=0.6)
    both = 0.5 * (grey + 1.5 * (1.2 * colour - grey * 1.2) + 0.2 * grey) + 63.75
    np.testing.assert_allclose(seen(exposure=1.2, contrast=0.5, saturation=1.5), both, atol=0.6)


def test_noise_is_normal_and_of_its_seed(shapes):
    kind = torch.zeros(3, 0, dtype=torch.int64)
    photo = CameraEffects(noise=8.0, seed=torch.tensor([[7], [8], [7]]))
    world = shapes.world(
        kind=kind, camera=above(), ground=plain((128, 128, 128)), light=light(sun=0.0, ambient=1.0), photo=photo
    )
    image = RENDERER(world).image.double() - 128
    assert torch.equal(image[0], image[2]) and not torch.equal(image[0], image[1])
    noise = image[:2].flatten(2)
    assert noise.mean((2,)).abs().max() < 0.15 and (noise.std(2) - 8).abs().max() < 0.15
    assert (noise.abs() > 16).double().mean() == pytest.approx(0.037, abs=0.008)
    rows = torch.cat([noise.flatten(0, 1), noise.flatten(0, 1).roll(1, 1), noise.flatten(0, 1).roll(CANVAS[1], 1)])
    apart = torch.corrcoef(rows) - torch.eye(18)
    assert apart.abs().max() < 0.02


def test_equal_textures_are_kept_once(shapes):
    """By what they hold: of meshes and surfaces alike, new objects at every call."""

    def textures(*colours):
        return [np.full((4, 8, 3), colour, np.uint8) for colour in colours]

    atlas = TextureAtlas()
    first, second, again, other = atlas.add(textures(10, 20, 10, 30))
    size = atlas.texels.size, atlas.table.size
    assert again == first and len({first, second, other}) == 3
    assert atlas.add(textures(30, 10)) == [other, first] and (atlas.texels.size, atlas.table.size) == size
    assert atlas.add([textures(10)[0].reshape(8, 4, 3)])[0] not in (first, second, other)
    world, renderer = covered_world(shapes), MeshRenderer(CANVAS, threads=1)
    image = renderer(world).image
    size = renderer._atlas.textures.texels.size
    assert torch.equal(renderer(covered_world(shapes)).image, image)
    assert renderer._atlas.textures.texels.size == size


def covered_world(shapes):
    """A box and the ground with one texture."""
    texture = np.random.default_rng(0).integers(0, 256, (16, 16, 3)).astype(np.uint8)
    cube = Meshes("car", (shapes.box(1, 1, 1, texture=texture),), 0, 8.0, 0.0)
    return shapes.world(cube, ground=covered(texture), camera=Camera(300.0, 150.0, 94.0))
