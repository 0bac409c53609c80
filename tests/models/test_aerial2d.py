"""Aerial 2D: the distributions against the paper's, and that what is drawn is where it should be."""

import math

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from scipy.stats import chisquare, kstest, poisson

from probscene.app.loading import load_model
from probscene.checks import check
from probscene.errors import DataError
from probscene.models.aerial2d import APART, CANVAS, GRAMMAR, LANE, MODEL, PRETRAINING, ROAD, TARGET
from probscene.models.aerial_sprites import folder
from probscene.relations import per_parent
from probscene.renderers.sprites import SpriteRenderer
from probscene.sampling import sample, seed_everything
from probscene.structure import StructurePrior, counts

ROADS, CARS = GRAMMAR.kind("road"), GRAMMAR.kind("car")
LAYERS = {"ground": 0, "road": 1, "house": 2, "car": 3, "tree": 4}


@pytest.fixture(autouse=True)
def _sprites_of_the_install(monkeypatch):
    monkeypatch.delenv("PROBSCENE_SPRITES", raising=False)


def structures(policy, number=5000):
    """How many roads each scene has, and how many cars its first road and each of its other roads."""
    seed_everything(0)
    derivation = sample(MODEL, policy, number).derivation
    found = per_parent(derivation, ROADS, CARS)
    roads = derivation.counts(len(GRAMMAR.kinds))[:, ROADS]
    return roads.numpy(), found.count[found.rank == 0].numpy(), found.count[found.rank > 0].numpy()


def test_the_model_is_sound():
    report = check(MODEL)
    assert not report.faults and not report.warnings
    assert (MODEL.canvas, MODEL.max_steps, MODEL.classes) == ((256, 256), 64, ("road", "car"))


def test_the_prior_is_uniform():
    roads, first, others = structures(MODEL.prior)
    assert chisquare(np.bincount(roads)[1:]).pvalue > 1e-3 and set(roads) == {1, 2, 3, 4}
    for cars in (first, others):
        assert chisquare(np.bincount(cars, minlength=9)).pvalue > 1e-3 and cars.max() == 8


def test_the_target_is_the_papers():
    roads, first, others = structures(TARGET)
    assert chisquare(np.bincount(roads)[1:], len(roads) * np.array([0.05, 0.15, 0.4, 0.4])).pvalue > 1e-3
    for cars, mean in ((first, 9), (others, 3)):
        expected = np.append(poisson.pmf(np.arange(15), mean), poisson.sf(14, mean))
        assert chisquare(np.bincount(cars.clip(max=15), minlength=16), len(cars) * expected).pvalue > 1e-3


def test_a_tenth_of_the_pretraining_has_more_cars_than_the_prior():
    _, first, others = structures(PRETRAINING)
    assert abs((first > 8).mean() - 0.1) < 0.02 and abs((others > 8).mean() - 0.1) < 0.02 and first.max() == 20


@given(st.integers(0, 2**31), st.sampled_from([MODEL, MODEL.target(0)]), st.integers(1, 6), st.integers(0, 7))
@settings(max_examples=25, deadline=None)
def test_roads_follow_one_another_and_cars_stand_apart_on_them(seed, model, roads, cars):
    seed_everything(seed)
    policy = StructurePrior(GRAMMAR, Roads=counts(*[0] * roads, 1), Cars=counts(*[0] * cars, 1))
    scenes = sample(model, policy, 8)
    layers = {name: scenes.drawing.layers[i] for name, i in LAYERS.items()}
    assert torch.equal(layers["road"].present, scenes.derivation.kind == ROADS)
    for n in range(8):
        y = layers["road"].y[n][layers["road"].present[n]]
        pitch = min(ROAD, CANVAS / roads)
        assert (y.diff() >= pitch - 1).all() and y.min() >= pitch / 2 - 1 and y.max() <= CANVAS - pitch / 2 + 1
        car = layers["car"].present[n]
        x, car_y = layers["car"].x[n][car], layers["car"].y[n][car]
        parent_y = layers["road"].y[n][scenes.derivation.parent[n][car]]
        assert torch.allclose((car_y - parent_y).abs(), torch.tensor(LANE))
        assert (x > 9).all() and (x < CANVAS - 9).all()
        away = (x[:, None] - x).abs().masked_fill(car_y[:, None] != car_y, math.inf).fill_diagonal_(math.inf)
        assert (away > APART - 1e-3).all()
        for name, reach in (("house", 20), ("tree", 12)):
            there = layers[name].y[n][layers[name].present[n]]
            assert ((there[:, None] - y).abs() > ROAD / 2 + reach).all()


def test_places_are_uniform_among_those_without_overlap():
    """A lane with one car: its place is uniform; with two, the gap between them is as that of two uniform numbers."""
    length = CANVAS - 20
    policy = StructurePrior(GRAMMAR, Roads=counts(0, 1), Cars=counts(0, 0, 0, 1))
    seed_everything(1)
    scenes = sample(MODEL, policy, 3000)
    layer = scenes.drawing.layers[LAYERS["car"]]
    x, y = (value[layer.present].view(3000, 3) for value in (layer.x, layer.y))
    alone = (y == y.median(1, keepdim=True).values).sum(1) == 2
    assert abs(float(alone.float().mean()) - 0.75) < 0.04  # each car takes a lane of its own choice
    x, y = x[alone], y[alone]
    lonely = y != y.median(1, keepdim=True).values
    assert kstest((x[lonely] - 10).numpy() / length, "uniform").pvalue > 1e-3
    pair = x[~lonely].view(-1, 2)
    gap = ((pair[:, 0] - pair[:, 1]).abs() - APART) / (length - APART)
    assert kstest(gap.numpy(), lambda g: 1 - (1 - g) ** 2).pvalue > 1e-3


def test_a_lane_that_has_no_room_shares_its_cars_with_the_other():
    policy = StructurePrior(GRAMMAR, Roads=counts(0, 1), Cars=counts(*[0] * 20, 1))
    seed_everything(1)
    scenes = sample(MODEL, policy, 300)
    layer = scenes.drawing.layers[LAYERS["car"]]
    y = layer.y[layer.present].view(300, 20)
    upper = (y == y.amin(1, keepdim=True)).sum(1)
    assert (torch.maximum(upper, 20 - upper) <= 11).all() and upper.unique().tolist() == [9, 10, 11]


@pytest.mark.parametrize("model", [MODEL, MODEL.target(0)], ids=["prior", "target"])
def test_every_car_is_seen_whole_and_the_ground_is_everywhere(model):
    seed_everything(2)
    batch = SpriteRenderer(model.canvas)(sample(model, model.prior, 64).drawing)
    cars = batch.kind == CARS
    assert (batch.visible[cars] > 0.999).all()
    assert (batch.image.amax(1) > 0).all()  # black is what nothing was drawn on
    road = batch.kind == ROADS
    assert ((batch.box[road][:, 2] - batch.box[road][:, 0]) == CANVAS).all()
    assert ((batch.box[road][:, 3] - batch.box[road][:, 1]) == ROAD).all()


def test_cars_of_the_target_keep_to_their_side():
    seed_everything(3)
    target = MODEL.target(0)
    scenes = sample(target, target.prior, 50)
    layer, parent = scenes.drawing.layers[LAYERS["car"]], scenes.derivation.parent
    road_y = scenes.drawing.layers[LAYERS["road"]].y.gather(1, parent.clamp(min=0))
    below = (layer.y > road_y)[layer.present]
    heading = layer.angle[layer.present].cos()
    assert (heading[below] > 0.99).all() and (heading[~below] < -0.99).all()


def pictures(path, size=(24, 50)):
    for name in ("car", "tree", "house"):
        (path / name).mkdir(parents=True)
        sprite = np.full((*size, 4), 255, np.uint8)
        sprite[..., :3] = (10, 20, 250)  # blue, green, red
        cv2.imwrite(str(path / name / "one.png"), sprite)
    return path


def test_a_folder_of_pictures(tmp_path, monkeypatch):
    monkeypatch.setenv("PROBSCENE_SPRITES", str(pictures(tmp_path)))
    model = load_model("aerial2d")
    seed_everything(4)
    scenes = sample(model, StructurePrior(GRAMMAR, Cars=counts(0, 0, 1)), 4)
    atlas = scenes.drawing.layers[LAYERS["car"]].atlas
    assert atlas.sprites[0].shape[1] == 18 and atlas.sprites[0][4, 9].tolist() == [250, 20, 10, 255]
    assert (scenes.drawing.layers[LAYERS["car"]].tint == 1).all()


def test_hidden_files_are_no_pictures(tmp_path):
    path = pictures(tmp_path)
    (path / "car" / "one.png").rename(path / "car" / "ONE.PNG")
    for name in ("._ONE.PNG", "._two.png", ".three.png"):
        (path / "car" / name).write_bytes(b"\0\5\x16\7")
    assert len(folder(str(path)).cars.sprites) == 1


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ("missing", "expected PNG files in .*tree"),
        ("no alpha", r"tree/one\.png, which has no alpha channel;"),
        ("no picture", r"tree/one\.png, which is not a PNG"),
        ("web", r"tree/one\.png, which is a WebP file"),
        ("cut", r"tree/one\.png, which is truncated"),
    ],
)
def test_a_folder_that_is_no_folder_of_pictures(wrong, said, tmp_path):
    path = pictures(tmp_path)
    file = path / "tree" / "one.png"
    if wrong == "missing":
        file.unlink()
    elif wrong == "no alpha":
        cv2.imwrite(str(file), np.zeros((8, 8, 3), np.uint8))
    elif wrong == "web":
        Image.new("RGBA", (8, 8)).save(file, "WEBP")
    else:
        file.write_bytes(file.read_bytes()[:-20] if wrong == "cut" else b"tree")
    with pytest.raises(DataError, match=said):
        folder(str(path))


def test_pictures_are_read_as_photographs_are(tmp_path):
    """Upright, of 16 bits as of 8, whatever is wrong with a comment."""
    path = pictures(tmp_path)
    file = path / "car" / "one.png"
    half = np.zeros((24, 48, 4), np.uint8)
    half[:, 24:] = (250, 20, 10, 255)  # on the right
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(np.rot90(half)).save(path / "car" / "lying.png", exif=exif)
    Image.fromarray(half).save(file)
    cv2.imwrite(str(path / "car" / "wide.png"), half[..., [2, 1, 0, 3]].astype(np.uint16) * 257)
    whole = file.read_bytes()
    (path / "car" / "comment.png").write_bytes(whole[:33] + b"\0\0\0\4tEXta\0bc\1\2\3\4" + whole[33:])
    first, *others = folder(str(path)).cars.sprites
    assert len(others) == 3 and all((sprite == first).all() for sprite in others)
    assert (first[:, 10:] == (250, 20, 10, 255)).all() and not first[:, :8].any()


@pytest.mark.parametrize("size", [(2, 900), (900, 2), (1, 40_000), (7, 500), (1, 1), (3, 4)])
def test_a_picture_of_any_shape_keeps_its_length_and_at_least_one_pixel(tmp_path, size):
    found = folder(str(pictures(tmp_path, size)))
    for atlas, length in ((found.cars, 18), (found.trees, 22), (found.houses, 40)):
        (sprite,) = atlas.sprites
        height, width = sprite.shape[:2]
        assert max(height, width) == length
        assert min(height, width) == pytest.approx(max(1, length * min(size) / max(size)), abs=0.5)
        assert (sprite == (250, 20, 10, 255)).all()


@pytest.mark.parametrize("hidden", ["._one.png", ".one.png", "._two.PNG"])
def test_hidden_files_and_capital_letters_beside_pictures(tmp_path, hidden):
    """macOS puts ``._NAME`` beside each NAME in a zip; it is no picture."""
    path = pictures(tmp_path)
    (path / "car" / hidden).write_bytes(b"\0\5\x16\7\0\2\0\0Mac OS X")
    (path / "car" / "one.png").rename(path / "car" / "A.PNG")
    (path / "tree" / "one.png").rename(path / "tree" / "B.Png")
    found = folder(str(path))
    assert len(found.cars) == len(found.trees) == len(found.houses) == 1


def test_the_sprites_of_the_data_folder(data_dir):
    if not (data_dir / "sprites2d").is_dir():
        pytest.skip("no sprites2d in the data folder")
    own = folder(str(data_dir / "sprites2d"))
    assert len(own.cars) > 100 and all(max(sprite.shape[:2]) == 18 for sprite in own.cars.sprites)
