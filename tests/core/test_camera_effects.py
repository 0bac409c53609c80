"""Photos of scenes: their sites, their values, and what carries them."""

from dataclasses import fields, replace

import pyro
import pyro.distributions as dist
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from pyro import poutine

from probscene.camera_effects import LIMITS, CameraEffects
from probscene.derivation import Derivation
from probscene.drawing import Sprites
from probscene.errors import ModelError
from probscene.grammar import Grammar
from probscene.joining import join_drawings
from probscene.model import scene_model
from probscene.sampling import run_program, sample
from probscene.scene import SceneGraph
from probscene.structure import StructurePrior, counts
from probscene.world import Camera, resolve_scene

DISCS = Grammar("Scene -> Discs\nDiscs -> disc Discs | ε")
PRIOR = StructurePrior(DISCS, Discs=counts(1, 1, 1))
RANGES = {
    "exposure": (0.7, 1.4), "contrast": (0.8, 1.2), "saturation": (0.5, 1.2), "red_gain": (0.9, 1.1),
    "blue_gain": (0.8, 1.2), "vignette": (0.0, 0.5), "blur": (0.0, 2.0), "noise": (0.0, 6.0),
    "jpeg_quality": (40.0, 95.0),
}  # fmt: skip
NAMES = st.lists(st.sampled_from(sorted(RANGES)), unique=True)


def scene_of(N=3):
    return SceneGraph(DISCS, Derivation.from_rules(DISCS, torch.tensor([[0, 1, 1, 2]] * N)))


def traced(N=3, **looks):
    """The photo that is asked for in the plate of scenes, and its sites."""

    def program():
        with pyro.plate("scenes", N, dim=-2):
            return scene_of(N).photo(**looks)

    trace = poutine.trace(program).get_trace()
    sites = {name: site for name, site in trace.nodes.items() if site["type"] == "sample" and name.startswith("photo.")}
    return trace.nodes["_RETURN"]["value"], sites


@given(NAMES)
def test_what_is_asked_for_and_nothing_else_has_a_site(names):
    photo, sites = traced(4, **{name: RANGES[name] for name in names})
    expected = {f"photo.{name}" for name in names} | ({"photo.seed"} if "noise" in names else set())
    assert set(sites) == expected
    for name in LIMITS:
        value = getattr(photo, name)
        if name in names:
            assert value.shape == (4, 1) and torch.equal(value, sites[f"photo.{name}"]["value"])
            assert ((value >= RANGES[name][0]) & (value <= RANGES[name][1])).all()
        else:
            assert value == getattr(CameraEffects(), name)


def test_sites_come_in_one_order():
    """So the same seed gives the same values, in whatever order a program names them."""
    names = list(RANGES)
    orders = [list(traced(**{name: RANGES[name] for name in some})[1]) for some in (names, names[::-1])]
    assert orders[0] == orders[1] and orders[0][-1] == "photo.seed"


def test_numbers_and_tensors_have_no_site_and_distributions_have():
    given_value = torch.tensor([[0.9], [1.0], [1.1]])
    photo, sites = traced(exposure=1.2, contrast=given_value, blur=dist.Exponential(1.0), noise=3.0)
    assert list(sites) == ["photo.blur", "photo.seed"]
    assert photo.exposure == 1.2 and photo.contrast is given_value and photo.blur.shape == (3, 1)
    assert float(sites["photo.blur"]["fn"].mean[0, 0]) == 1.0
    assert sites["photo.seed"]["infer"]["learn"] is False
    assert photo.seed.dtype == torch.int64 and len(photo.seed.unique()) == 3


def test_the_default_photo_has_every_value_once_a_scene():
    photo = resolve_scene(CameraEffects(), 5)
    assert all(getattr(photo, field.name).shape == (5,) for field in fields(photo))
    assert photo.seed.dtype == torch.int64 and (photo.jpeg_quality == torch.inf).all()
    assert set(LIMITS) == {field.name for field in fields(CameraEffects)} - {"seed"}


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"blur": -1.0}, r"CameraEffects.blur within 0..64, got -1;"),
        ({"blur": 65.0}, "CameraEffects.blur within 0..64, got 65;"),
        ({"blur": float("nan")}, "finite values in CameraEffects.blur"),
        ({"jpeg_quality": 0.0}, "CameraEffects.jpeg_quality within 1..100, or infinity for no JPEG, got 0;"),
        ({"jpeg_quality": 101.0}, "jpeg_quality within 1..100.*got 101;"),
        ({"jpeg_quality": float("nan")}, "jpeg_quality within 1..100.*got nan;"),
        ({"jpeg_quality": -torch.inf}, "jpeg_quality within 1..100.*got -inf;"),
        ({"exposure": -0.5}, "CameraEffects.exposure of at least 0, got -0.5;"),
        ({"noise": float("inf")}, "finite values in CameraEffects.noise"),
        ({"vignette": 1.5}, "CameraEffects.vignette within 0..1, got 1.5;"),
        ({"contrast": torch.ones(2, 4)}, r"CameraEffects.contrast to broadcast to \(2, 1\), got shape \(2, 4\)"),
        ({"seed": torch.zeros(3, 1)}, r"CameraEffects.seed to broadcast to \(2, 1\)"),
        ({"red_gain": torch.tensor([[1.0], [-1.0]])}, "CameraEffects.red_gain of at least 0, got -1;"),
    ],
)
def test_photos_that_cannot_be(values, message):
    scene = scene_of(2)
    with pytest.raises(ModelError, match=message):
        scene.draw(Sprites.disc("disc", 1.0, 1.0, 1.0), photo=CameraEffects(**values))
    with pytest.raises(ModelError, match=message):
        scene.build(camera=Camera(), photo=CameraEffects(**values))


@pytest.mark.parametrize(
    ("looks", "message"),
    [
        ({"blur": (-1.0, 2.0)}, r"blur of scene.photo\(...\) as a range \(lowest, highest\) within 0..64, got \(-1"),
        ({"exposure": (-0.5, 0.5)}, "exposure .* of at least 0, got"),
        ({"contrast": (1.2, 0.8)}, r"contrast .* got \(1.2, 0.8\)"),
        ({"contrast": (1.0, 1.0)}, "write one number"),
        ({"contrast": (1.0, 1.1, 1.2)}, "as a range"),
        ({"contrast": ("low", "high")}, "as a range"),
        ({"exposure": (1.0, float("inf"))}, "as a range"),
        ({"jpeg_quality": (30, 101)}, "within 1..100, or infinity for no JPEG"),
    ],
)
def test_ranges_that_are_none(looks, message):
    with pytest.raises(ModelError, match=message):
        traced(**looks)


def test_photos_belong_to_scenes_and_not_to_nodes():
    with pytest.raises(ModelError, match=r"'photo.blur' with one value a scene, shape \(3, 1\), got \(\)"):
        scene_of().photo(blur=(0.0, 1.0))
    scene = scene_of()
    with (
        pyro.plate("scenes", 3, dim=-2),
        scene.nodes("disc"),
        pytest.raises(ModelError, match=r"got \(3, 2\); call scene.photo\(...\) .* outside"),
    ):
        scene.photo(blur=(0.0, 1.0))


@scene_model(DISCS, PRIOR, canvas=(32, 32), max_steps=8, classes=("disc",))
def discs(scene):
    photo = scene.photo(exposure=(0.5, 1.5), noise=(1.0, 5.0), blur=(0.0, 2.0))
    with scene.nodes("disc"):
        x = pyro.sample("disc.x", dist.Uniform(4.0, 28.0))
    return scene.draw(Sprites.disc("disc", x, 16.0, radius=4.0), photo=photo)


def test_a_drawing_carries_its_photo_through_programs_and_slices():
    scenes = sample(discs, PRIOR, 6)
    photo = scenes.drawing.photo
    assert torch.equal(photo.exposure, scenes.parameters["photo.exposure"][:, 0])
    again = run_program(discs, scenes.derivation, scenes.parameters).drawing.photo
    some = scenes.drawing[2:5].photo
    for field in fields(CameraEffects):
        value = getattr(photo, field.name)
        assert torch.equal(getattr(again, field.name), value) and torch.equal(getattr(some, field.name), value[2:5])
    plain = replace(scenes.drawing, photo=None)
    assert plain[1:].photo is None


def test_joined_drawings_keep_their_photos():
    scenes = sample(discs, PRIOR, 4)
    own = torch.tensor([True, False, False, True])
    with_photo, plain = scenes.drawing, replace(scenes.drawing, photo=None)
    kind = with_photo.kind
    joined = join_drawings(kind, DISCS.kinds, [(own, with_photo), (~own, plain)]).photo
    for field in fields(CameraEffects):
        value, default = getattr(with_photo.photo, field.name), getattr(CameraEffects(), field.name)
        assert torch.equal(getattr(joined, field.name), torch.where(own, value, default))
    assert join_drawings(kind, DISCS.kinds, [(own, plain), (~own, plain)]).photo is None
