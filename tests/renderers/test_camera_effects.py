"""Laws of photos: against their numpy twin, against OpenCV's encoder, and against themselves."""

import subprocess
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from reference.camera_effects import apply_camera_effects

from probscene.camera_effects import CameraEffects
from probscene.drawing import Atlas, Drawing, Sprites, resolve
from probscene.errors import ModelError
from probscene.renderers.camera import effects as effects_module
from probscene.renderers.meshes import MeshRenderer
from probscene.renderers.sprites import SpriteRenderer
from probscene.world import Camera, Light, Meshes, resolve_scene

SEED = st.integers(0, 2**32 - 1)
SIZE = st.integers(1, 45)


def drawing_of(images: np.ndarray, photo: CameraEffects | None = None) -> Drawing:
    """Scenes of which each shows an image ``(N, H, W, 3)`` to the byte, as the sprite of its one node."""
    number, height, width = images.shape[:3]
    opaque = np.concatenate([images, np.full_like(images[..., :1], 255)], 3)
    which = torch.arange(number).unsqueeze(1)
    layer = resolve(Sprites("a", Atlas(tuple(opaque)), which, width / 2, height / 2), which >= 0)
    photo = None if photo is None else resolve_scene(photo, number)
    return Drawing(torch.zeros(number, 1, dtype=torch.int64), ("a",), (layer,), photo=photo)


def photos_of(images: np.ndarray, **values) -> np.ndarray:
    """Photos ``(N, H, W, 3)`` of images."""
    batch = SpriteRenderer(images.shape[1:3], threads=1)(drawing_of(images, CameraEffects(**values)))
    return batch.image.permute(0, 2, 3, 1).numpy()


def noise_of(seed: int, *shape: int, smooth: float = 0.0) -> np.ndarray:
    """Random images, as smooth as photographs where asked for."""
    images = np.random.default_rng(seed).integers(0, 256, (*shape, 3)).astype(np.uint8)
    if smooth:
        images = np.stack([cv2.GaussianBlur(image, (0, 0), smooth) for image in images])
        images = np.stack([cv2.normalize(image, None, 0, 255, cv2.NORM_MINMAX) for image in images])
    return images


def random_effects(seed: int, number: int) -> CameraEffects:
    """Some of the effects, of other strength in each scene."""
    generator = np.random.default_rng(seed)
    ranges = {
        "exposure": (0.5, 1.6), "contrast": (0.4, 1.6), "saturation": (0, 1.8), "red_gain": (0.6, 1.4),
        "blue_gain": (0.6, 1.4), "vignette": (0, 1), "blur": (0, 4), "noise": (0, 20), "jpeg_quality": (1, 100),
    }  # fmt: skip
    chosen = {name: ends for name, ends in ranges.items() if generator.random() < 0.4}
    values = {name: torch.from_numpy(generator.uniform(*ends, (number, 1))) for name, ends in chosen.items()}
    return CameraEffects(**values, seed=torch.from_numpy(generator.integers(0, 2**31, (number, 1))))


@settings(max_examples=60)
@given(SEED, SIZE, SIZE)
def test_agrees_with_the_numpy_twin(seed, height, width):
    images = noise_of(seed, 2, height, width, smooth=2.0 * (seed % 2))
    photo = resolve_scene(random_effects(seed, 2), 2)
    found = SpriteRenderer((height, width), threads=1)(replace(drawing_of(images), photo=photo))
    for n in range(2):
        before = replace(photo, jpeg_quality=torch.full((2,), torch.inf))
        ours = SpriteRenderer((height, width), threads=1)(replace(drawing_of(images), photo=before))
        ours = ours.image[n].permute(1, 2, 0).numpy()
        twin = apply_camera_effects(images[n] / 255, before, n)
        assert np.abs(ours.astype(int) - twin.image).max() <= 1  # each stage rounds
        # What is coded is our own bytes: a byte that rounds the other way would change whole blocks.
        plain = replace(resolve_scene(CameraEffects(), 2), jpeg_quality=photo.jpeg_quality)
        twin = apply_camera_effects(ours / 255, plain, n)
        apart = np.abs(found.image[n].permute(1, 2, 0).numpy().astype(int) - twin.image).max(2)
        assert (apart[~twin.doubtful] <= 2).all()


def test_hardly_any_pixel_is_doubtful_to_the_twin():
    images = noise_of(0, 4, 200, 300, smooth=2.0)
    photo = resolve_scene(CameraEffects(jpeg_quality=torch.tensor([[10.0], [40.0], [75.0], [93.0]])), 4)
    assert np.mean([apply_camera_effects(images[n] / 255, photo, n).doubtful for n in range(4)]) < 0.5


@given(SEED, st.integers(0, 3), SIZE, SIZE)
def test_the_default_photo_keeps_every_byte(seed, number, height, width):
    images = noise_of(seed, number, height, width) if number else np.zeros((0, height, width, 3), np.uint8)
    if number:
        np.testing.assert_array_equal(photos_of(images), images)
    renderer = SpriteRenderer((height, width), threads=1)
    empty = Drawing(torch.zeros(number, 0, dtype=torch.int64), ("a",), (), (0.2, 0.4, 0.6))
    shown = renderer(replace(empty, photo=resolve_scene(CameraEffects(), number)))
    assert torch.equal(shown.image, renderer(empty).image)


@given(SEED, SIZE, SIZE)
def test_labels_are_those_without_a_photo(seed, height, width):
    images = noise_of(seed, 3, height, width)
    renderer = SpriteRenderer((height, width), threads=1)
    with_photo, without = renderer(drawing_of(images, random_effects(seed, 3))), renderer(drawing_of(images))
    assert all(torch.equal(a, b) for a, b in zip(with_photo[1:7], without[1:7], strict=True))


@given(SEED, st.integers(0, 4), SIZE, SIZE)
def test_same_bytes_for_any_threads_and_any_batch(seed, cut, height, width):
    drawing = drawing_of(noise_of(seed, 4, height, width), random_effects(seed, 4))
    renderer = SpriteRenderer((height, width), threads=1)
    image = renderer(drawing).image
    assert torch.equal(image, SpriteRenderer((height, width), threads=2)(drawing).image)
    for part in (slice(0, cut), slice(cut, None), slice(cut, cut + 1)):
        assert torch.equal(image[part], renderer(drawing[part]).image)


def test_same_bytes_for_several_launches(monkeypatch):
    drawing = drawing_of(noise_of(0, 21, 7, 9), random_effects(6, 21))
    image = SpriteRenderer((7, 9), threads=1)(drawing).image
    monkeypatch.setattr(effects_module, "_CHUNK", 1)
    assert torch.equal(image, SpriteRenderer((7, 9), threads=2)(drawing).image)
    assert not torch.equal(image, SpriteRenderer((7, 9), threads=1)(replace(drawing, photo=None)).image)


GREYS = np.repeat(np.arange(256, dtype=np.uint8), 3).reshape(1, 8, 32, 3)


@given(st.floats(0, 3))
def test_contrast_turns_about_the_middle_grey(contrast):
    found, values = photos_of(GREYS, contrast=contrast).astype(int), np.arange(256)
    np.testing.assert_allclose(
        found[0, ..., 0].ravel(), np.clip(127.5 + contrast * (values - 127.5), 0, 255), atol=0.501 + 1e-3
    )
    assert np.abs(found + found[:, ::-1, ::-1] - 255).max() <= 1


@given(st.floats(0, 3), st.floats(0, 3), st.floats(0, 3))
def test_more_light_makes_no_pixel_darker(less, more, contrast):
    less, more = sorted((less, more))
    dark, bright = (photos_of(GREYS, exposure=exposure, contrast=contrast).astype(int) for exposure in (less, more))
    assert (bright >= dark).all() and (np.diff(bright[0, ..., 0].ravel()) >= 0).all()
    if contrast == 1:
        np.testing.assert_allclose(bright[0, ..., 0].ravel(), np.clip(more * np.arange(256), 0, 255), atol=0.51)


@given(SEED, st.floats(0, 2), st.floats(0.3, 1.5))
def test_colours(seed, saturation, gain):
    images = noise_of(seed, 1, 9, 11)
    grey = photos_of(images, saturation=0.0)
    assert (grey == grey[..., :1]).all()
    np.testing.assert_allclose(grey[..., 0], images @ [0.299, 0.587, 0.114], atol=0.501)
    assert np.abs(photos_of(GREYS, saturation=saturation).astype(int) - GREYS).max() <= 1
    for name, channel in (("red_gain", 0), ("blue_gain", 2)):
        expected = images.astype(float)
        expected[..., channel] = np.clip(expected[..., channel] * gain, 0, 255)
        np.testing.assert_allclose(photos_of(images, **{name: gain}), expected, atol=0.501)


@given(st.floats(0, 1), st.integers(3, 40), st.integers(3, 40))
def test_a_vignette_darkens_the_corners_evenly_and_not_the_middle(vignette, height, width):
    image = photos_of(np.full((1, height, width, 3), 255, np.uint8), vignette=vignette)[0].astype(int)
    assert (image == image[::-1]).all() and (image == image[:, ::-1]).all()
    assert image[height // 2, width // 2].min() >= 255 * (1 - vignette * 2 / (height - 1)) - 1
    np.testing.assert_allclose(image[0, 0], 255 * (1 - vignette), atol=0.501)
    assert (np.diff(image[: height // 2], axis=0) >= 0).all() and (np.diff(image[:, : width // 2], axis=1) >= 0).all()


@given(SEED, st.floats(0.3, 6), SIZE, SIZE)
def test_blur_is_a_gaussian(seed, sigma, height, width):
    images = noise_of(seed, 1, height, width)
    found = photos_of(images, blur=sigma)
    size = 2 * int(np.ceil(4 * sigma)) + 1
    peer = cv2.GaussianBlur(images[0].astype(np.float32), (size, size), sigma, borderType=cv2.BORDER_REPLICATE)
    np.testing.assert_allclose(found[0], peer, atol=0.51)
    np.testing.assert_array_equal(photos_of(images[:, ::-1], blur=sigma)[:, ::-1], found)
    np.testing.assert_array_equal(photos_of(images[:, :, ::-1], blur=sigma)[:, :, ::-1], found)


@given(SEED, st.floats(0, 3), st.integers(0, 255))
def test_blur_keeps_the_mean_inside_and_an_even_image(seed, sigma, grey):
    images = np.full((1, 64, 64, 3), 128, np.uint8)
    images[:, 20:44, 20:44] = noise_of(seed, 1, 24, 24)
    found = photos_of(images, blur=sigma)
    assert abs(found.mean() - images.mean()) < 0.1
    assert found.std() <= images.std() + 1e-9
    even = np.full((1, 13, 17, 3), grey, np.uint8)
    np.testing.assert_array_equal(photos_of(even, blur=sigma), even)


@pytest.mark.parametrize("blur", [0.0, 2.0])
def test_noise_is_normal_of_its_seed_and_not_blurred(blur):
    images = np.full((3, 90, 120, 3), 128, np.uint8)
    seeds = torch.tensor([[7], [8], [7]])
    found = photos_of(images, noise=8.0, seed=seeds, blur=blur).astype(float) - 128
    assert (found[0] == found[2]).all() and (found[0] != found[1]).any()
    noise = found[:2].reshape(2, -1, 3)
    assert np.abs(noise.mean(1)).max() < 0.3 and np.abs(noise.std(1) - 8).max() < 0.2
    channels = noise.transpose(0, 2, 1).reshape(6, -1)
    assert np.abs(np.corrcoef(channels) - np.eye(6)).max() < 0.04


@pytest.mark.parametrize("quality", [5, 20, 50, 75, 90, 98])
@pytest.mark.parametrize("size", [(96, 160), (61, 83)])
def test_jpeg_is_what_opencv_writes_and_reads(quality, size):
    images = noise_of(0, 2, *size, smooth=3.0)
    found = photos_of(images, jpeg_quality=float(quality))
    for image, ours in zip(images, found, strict=True):
        _, written = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
        theirs = cv2.imdecode(written, cv2.IMREAD_COLOR)[..., ::-1].astype(int)
        lost, apart = np.abs(theirs - image), np.abs(theirs - ours)
        assert apart.mean() < min(0.6, 0.2 + 0.15 * lost.mean()), (apart.mean(), lost.mean())


@given(SEED, st.lists(st.integers(1, 100), min_size=2, max_size=2, unique=True))
def test_jpeg_keeps_grey_grey_and_more_of_the_image_at_a_higher_quality(seed, qualities):
    images = np.repeat(noise_of(seed, 1, 48, 64, smooth=1.5)[..., :1], 3, 3)
    qualities = torch.tensor(sorted(qualities)).double().view(2, 1)
    worse, better = photos_of(np.repeat(images, 2, 0), jpeg_quality=qualities).astype(int)
    assert (worse == worse[..., :1]).all() and (better == better[..., :1]).all()
    lost = [((found - images[0]) ** 2).mean() for found in (worse, better)]
    assert lost[1] <= 1.05 * lost[0] + 0.5


def test_a_world_and_a_drawing_that_show_the_same_give_the_same_photo(shapes):
    """Blur, noise and JPEG of a render are those of an image with its bytes."""
    car = Meshes("car", (shapes.box(4, 2, 2, (200, 40, 60)),), 0, torch.tensor([[9.0], [14.0], [20.0]]), 0.0, yaw=0.6)
    camera, renderer = Camera(100.0, 50.0, 20.0), MeshRenderer((45, 101), threads=2)
    late = CameraEffects(blur=torch.tensor([[0.0], [1.0], [2.5]]), noise=6.0, jpeg_quality=60.0, seed=9)
    parts = {"kind": torch.zeros(3, 1, dtype=torch.int64), "camera": camera, "light": Light(), "ground": shapes.road()}
    plain, found = (renderer(shapes.world(car, photo=photo, **parts)) for photo in (None, late))
    images = plain.image.permute(0, 2, 3, 1).numpy()
    drawn = photos_of(images, blur=late.blur, noise=6.0, jpeg_quality=60.0, seed=9)
    apart = np.abs(found.image.permute(0, 2, 3, 1).numpy().astype(int) - drawn)
    assert apart[1:].max() == 0  # without blur a world's noise is added before its colours are rounded
    assert apart[0].mean() < 1.5
    assert shapes.same(found._replace(image=plain.image), plain)


@given(SEED, st.integers(0, 3), SIZE, SIZE)
def test_renderers_of_ones_own_get_the_same(seed, number, height, width):
    drawing = drawing_of(noise_of(seed, max(1, number), height, width), random_effects(seed, max(1, number)))[:number]
    renderer = SpriteRenderer((height, width), threads=1)
    plain = renderer(replace(drawing, photo=None)).image
    assert torch.equal(effects_module.apply_camera_effects(drawing.photo, plain.contiguous()), renderer(drawing).image)


def test_a_photo_of_other_scenes_is_named():
    drawing = drawing_of(noise_of(0, 2, 5, 6))
    with pytest.raises(ModelError, match=r"uint8 \(N, 3, H, W\), got torch.uint8 \(2, 5, 6, 3\)"):
        effects_module.apply_camera_effects(
            resolve_scene(CameraEffects(), 2), torch.zeros(2, 5, 6, 3, dtype=torch.uint8)
        )
    renderer = SpriteRenderer((5, 6), threads=1)
    for photo in (CameraEffects(), resolve_scene(CameraEffects(), 1), resolve_scene(CameraEffects(), 3)):
        with pytest.raises(ModelError, match="one value for each of 2 scenes.*resolve_scene"):
            renderer(replace(drawing, photo=photo))
    wrong = replace(resolve_scene(CameraEffects(), 2), blur=torch.tensor([0.0, torch.nan]))
    with pytest.raises(ModelError, match="CameraEffects.blur within 0..64, got nan"):
        renderer(replace(drawing, photo=wrong))


OWN = """
from probscene.renderers import engine
engine.ti.init(arch=engine.ti.cpu, default_ip=engine.ti.i64, default_fp=engine.ti.f64, offline_cache=False)
"""
DIGEST = """
import hashlib
import torch
from probscene.camera_effects import CameraEffects
from probscene.renderers.camera.effects import apply_camera_effects
from probscene.world import resolve_scene
image = torch.randint(0, 256, (2, 3, 37, 53), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
blur, quality = torch.tensor([[0.0], [1.5]]), torch.tensor([[60.0], [torch.inf]])
photo = CameraEffects(1.2, 0.8, 0.7, 1.1, 0.9, 0.3, blur, 5.0, quality)
found = apply_camera_effects(resolve_scene(photo, 2), image)
digest = hashlib.sha256(found.contiguous().numpy().tobytes()).hexdigest()
"""


def test_a_users_own_engine_gives_the_same_bytes():
    """Where whole numbers have 64 bits, and real ones as well."""
    command = [sys.executable, "-W", "error", "-c", f"{OWN}{DIGEST}print(digest)"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0 and done.stderr == "", done.stderr
    exec(DIGEST, here := {})
    assert done.stdout.split()[-1] == here["digest"]
