"""FID and KID of a run, FID of as many images on either side, KID of all there are; beside halves' of the target."""

import json
import math

import pytest
import torch

from probscene.app.evaluation.image_distances import caveat, extrapolate, image_distances
from probscene.app.fitting.run import RunFolder
from probscene.app.fitting.scene_features import features_in, features_of, own_net
from probscene.app.views.tables import sample_sizes
from probscene.dataset import ImageFolder
from probscene.errors import DataError, ProbsceneError
from probscene.inference.statistics.image_metrics import fid, kid


@pytest.fixture(scope="module")
def run(fitted) -> RunFolder:
    return RunFolder.at(fitted)


@pytest.fixture(scope="module")
def images(run, target) -> ImageFolder:
    return ImageFolder(target.images, run.model.canvas, run.model.channels)


def test_figures_are_those_of_the_features(run, images):
    told = []
    found = image_distances(run, images, ["run"], lambda *said: told.append(said[:3]), 15, seed=2)
    assert told[-1] == ("comparing", 70, 70) and list(found) == ["run"]
    assert list(found["run"]) == ["prior", "learnt", "floor"]
    net = own_net(run)
    real = features_in(run, images, net)[torch.randperm(40, generator=torch.Generator().manual_seed(2))]
    sides = {
        "prior": features_of(run, run.model.prior, 15, net, 2),
        "learnt": features_of(run, run.guide, 15, net, 2),
        "floor": real[15:30],
    }
    for source, side in sides.items():
        for figure, distance in zip(found["run"][source], (kid, fid), strict=True):
            expected = distance(real[:15], side, "run", seed=2)
            assert figure.value == pytest.approx(expected.value, rel=1e-3)
            assert figure.images == figure.generated == 15
            assert figure[:2] == expected[:2] and figure.low <= figure.value <= figure.high


def test_all_images_where_asked(run, images):
    """As many generated ones beside them, for KID more; the floor is of the halves, and FID's an estimate for all."""
    found = image_distances(run, images, ["run"], lambda *_: None, None, seed=2)["run"]
    net = own_net(run)
    real = features_in(run, images, net)[torch.randperm(40, generator=torch.Generator().manual_seed(2))]
    learnt = features_of(run, run.guide, 160, net, 2)
    for figure, distance, number in zip(found["learnt"], (kid, fid), (160, 40), strict=True):
        assert figure.value == pytest.approx(distance(real, learnt[:number], "run", seed=2).value, rel=1e-3)
        assert (figure.images, figure.generated) == (40, number)
    floor, biased = found["floor"]
    halves = [distance(real[:20], real[20:], "run", seed=2) for distance in (kid, fid)]
    assert floor.value == pytest.approx(halves[0].value, rel=1e-3, abs=1e-6) and floor.images == 20
    assert biased.value == pytest.approx(halves[1].value / 2, rel=1e-3) and biased.images == 40
    assert "estimated from 20 images" in caveat(biased)


def test_fid_of_two_samples_of_one_distribution_falls_as_one_over_their_number():
    sampled = torch.randn(4, 2000, 6, generator=torch.Generator().manual_seed(0))
    few = [fid(one[:400], one[400:800], "noise", size=2) for one in sampled]
    many = sum(fid(one[:1000], one[1000:], "noise", size=2).value for one in sampled) / 4
    assert sum(extrapolate(figure, 1000).value for figure in few) / 4 == pytest.approx(many, rel=0.25)


@pytest.mark.parametrize(
    ("num", "real", "generated", "a_side"), [(1000, 40, 160, 20), (100, 40, 100, 20), (30, 30, 30, 20)]
)
def test_fid_takes_no_more_than_half_of_the_target_and_kid_all_that_is_asked_for(
    run, images, num, real, generated, a_side
):
    found = image_distances(run, images, ["run"], lambda *_: None, num)["run"]
    numbers = {s: [(figure.images, figure.generated) for figure in each] for s, each in found.items()}
    assert numbers.pop("floor") == [(20, 20), (a_side, a_side)]
    assert list(numbers.values()) == 2 * [[(real, generated), (a_side, a_side)]]
    said = f"{real} images a side" if real == generated else f"{real} real, {generated} generated images"
    assert [sample_sizes(figure) for figure in found["prior"]] == [said, f"{a_side} images a side"]


def test_faults_come_before_any_work(run, images, target, tmp_path):
    def never(*_):
        raise AssertionError

    assert image_distances(run, images, [], never) == {}
    with pytest.raises(ProbsceneError, match="run, efficientnet, .* or resnet50=FILE, got 'vgg'"):
        image_distances(run, images, ["run", "vgg"], never)
    with pytest.raises(ProbsceneError, match="at least 2 images to compare, got 1"):
        image_distances(run, images, ["run"], never, 1)
    for name in ("000000.png", "000001.png", "000002.png"):
        (tmp_path / name).write_bytes((target.images / name).read_bytes())
    few = ImageFolder(tmp_path, run.model.canvas, run.model.channels)
    with pytest.raises(DataError, match="at least 4 images .* got 3"):
        image_distances(run, few, ["run"], never)


def test_the_command_prints_and_writes_them(call, fitted, target, tmp_path):
    words = ["evaluate", fitted, "--target", target.images, "--num", 50, "--images", 10, "--scenes", 0]
    shown = call(*words, "--features", "run", "--features", "efficientnet", "--json", tmp_path / "e.json")
    assert shown.code == 0, shown.err
    record = json.loads((tmp_path / "e.json").read_text())["images"]
    assert list(record) == ["efficientnet-lite0", "run"]  # written in order
    for name, each in record.items():
        for source in ("prior", "learnt", "floor"):
            for metric in ("FID", "KID"):
                figure = each[source][metric]
                assert figure["features"] == name and figure["images"] == 10 and math.isfinite(figure["value"])
                assert f"{figure['value']:.4g} ±" in shown.out
    said = "".join(shown.out.split())  # a title may be wider than its table
    assert "inthefeaturesofefficientnet-lite0" in said and shown.out.index("KID, 10") < shown.out.index("FID, 10")
    refused = call(*words[:-4], "--images", "many", "--features", "run")
    assert refused.code == 2 and "number of images to compare, or all, got 'many'" in refused.err
    assert "FID of 10 images in 1280 dimensions" in shown.out and "two halves of the target" in shown.out
    wrong = call(*words, "--features", "resnet", "--json", tmp_path / "f.json")
    assert wrong.code == 2 and "got 'resnet'" in wrong.err and not (tmp_path / "f.json").exists()
