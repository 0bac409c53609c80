from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
import torch.nn.functional as F
from hypothesis import given
from hypothesis import strategies as st

from probscene import load_model
from probscene.app.fitting.rendered_features import RenderedFeatures
from probscene.errors import ProbsceneError
from probscene.inference.features.base import enter
from probscene.inference.features.counting import net as counting
from probscene.inference.features.counting.batches import FULL_AREA, MIN_IMAGES, CountBatches, CountSchedule, cells
from probscene.inference.features.counting.net import STRIDE, CountNet, toward_whole
from probscene.inference.features.counting.training import CountFeatures, CountTraining, count_loss
from probscene.inference.features.presence import PresenceFeatures, PresenceNet, PresenceTraining
from probscene.model import Groups
from probscene.structure import StructurePrior
from probscene.structure import counts as lengths


@given(st.sampled_from([1, 2, 4, 8]), st.integers(9, 40), st.integers(9, 40), st.integers(0, 2**31))
def test_entering_is_average_pooling(reduce, H, W, seed):
    image = torch.randint(0, 256, (2, 3, H, W), dtype=torch.uint8, generator=torch.Generator().manual_seed(seed))
    padded = F.pad(image.float(), (0, -W % reduce, 0, -H % reduce)) / 255
    assert torch.allclose(enter(image, 3, reduce), F.avg_pool2d(padded, reduce), atol=1e-6)


@given(st.integers(0, 2**31), st.integers(1, 6))
def test_cells_hold_every_object_once(seed, M):
    """Objects that stand apart and inside: the map sums to one a class object, and cells are distributions."""
    generator = torch.Generator().manual_seed(seed)
    spots = torch.randperm(9, generator=generator)[:M]  # a 3 x 3 raster of 5 cells, so that no two share a cell
    raster = torch.stack([spots % 3, spots // 3], -1) * 5 * STRIDE + 2.5 * STRIDE
    centre = (raster + torch.rand(M, 2, generator=generator) * STRIDE).unsqueeze(0)
    label = torch.randint(0, 3, (1, M), generator=generator)
    label[0, 0] = -1
    target = cells(centre, label, 3, 15, 15)
    assert torch.allclose(target.sum(1), torch.ones(1, 15, 15), atol=1e-5)
    expected = torch.stack([(label == c).sum() for c in range(3)]).float()
    assert torch.allclose(target[0, 1:].sum((1, 2)), expected, atol=1e-4)


def test_crowded_cells_stay_distributions():
    centre = torch.full((1, 5, 2), 12.0)
    target = cells(centre, torch.tensor([[0, 0, 1, 1, 1]]), 2, 4, 4)
    assert (target >= 0).all()
    assert torch.allclose(target.sum(1), torch.ones(1, 4, 4), atol=1e-6)


def test_loss_is_least_at_the_target():
    target = cells(torch.tensor([[[13.0, 20.0]]]), torch.tensor([[1]]), 2, 6, 6)
    best = count_loss(target.clamp(min=1e-9).log(), target, 1, 0.5)
    for _ in range(5):
        assert count_loss(target.clamp(min=1e-9).log() + torch.randn_like(target), target, 1, 0.5) > best


@given(st.integers(0, 3), st.integers(0, 3), st.integers(0, 3), st.integers(0, 3))
def test_a_relative_error_is_over_one_more_than_the_count(a, b, found_a, found_b):
    """Of each class and of the total, as written out; the cross-entropy is that of the absolute one."""
    target, guess = (torch.zeros(1, 3, 3, 3) for _ in range(2))
    for cells_of, counts in ((target, (a, b)), (guess, (found_a, found_b))):
        for label, (count, row) in enumerate(zip(counts, (0, 1), strict=True)):
            cells_of[0, 1 + label].view(-1)[3 * row : 3 * row + count] = 1
        cells_of[:, 0] = 1 - cells_of[:, 1:].sum(1)
    logits = 40 * guess
    wrong, truth = (found_a - a, found_b - b, found_a + found_b - a - b), (a, b, a + b)
    expected = sum(e**2 / (1 + n) - e**2 for e, n in zip(wrong, truth, strict=True))
    actual = count_loss(logits, target, 0, 0.5, relative=True) - count_loss(logits, target, 0, 0.5)
    assert actual.item() == pytest.approx(0.5 * expected, abs=1e-3)


@given(st.integers(0, 2**31))
def test_balanced_crops_are_around_objects_of_every_class_alike(seed):
    """Nine of one class and one of another: each class gets half of the crops."""
    torch.manual_seed(seed)
    schedule = CountSchedule(crops=400, crop=32, window=1, anywhere=0.0, balanced=True)
    batches = CountBatches(CountNet(("a", "b"), 1, (128, 128)), lambda num: None, schedule, 0)
    pick = batches._pick(torch.tensor([0] * 9 + [1]), schedule.crops)
    assert 140 <= (pick == 9).sum() <= 260
    assert (torch.bincount(pick, minlength=10)[:9] > 0).all()


@given(st.integers(1, 3), st.integers(1, 6), st.integers(1, 6), st.integers(0, 2**31))
def test_grey_images_pass_the_same_layers_with_the_same_gradient(N, h, w, seed):
    torch.manual_seed(seed)
    net = CountNet(("a", "b"), 1, (128, 128)).eval()
    image = torch.rand(N, 1, STRIDE * h, STRIDE * w)
    first, sides = net.body[0].weight, (net(image), net.body(image))
    assert torch.allclose(*sides, atol=1e-5)
    weight = torch.randn_like(sides[0])
    ours, plain = (torch.autograd.grad((side * weight).sum(), first)[0] for side in sides)
    assert torch.allclose(ours, plain, rtol=1e-4, atol=1e-4 * float(plain.abs().max()))


def test_embedding_is_the_map_summed_and_indifferent_to_place(dots):
    torch.manual_seed(0)
    net = CountNet(dots.classes, 3, (128, 128))
    for module in net.modules():  # as if trained: statistics that are not the initial ones
        if isinstance(module, torch.nn.BatchNorm2d):
            module.running_mean.normal_(0, 0.1)
            module.running_var.uniform_(0.5, 2)
            module.weight.data.uniform_(0.5, 1.5)
    net.eval()
    image = torch.zeros(1, 3, 128, 128, dtype=torch.uint8)
    image[:, 0, 40:56, 40:56] = 255
    moved = image.roll((2 * STRIDE, 3 * STRIDE), (2, 3))
    one, other = net.embed(image), net.embed(moved)
    direct = net(net.enter(image)).softmax(1)[:, 1:].sum((2, 3))
    assert torch.allclose(one[:, :2], toward_whole(direct), atol=1e-4)
    assert torch.allclose(one[:, 2], toward_whole(direct.sum(1)), atol=1e-4)
    assert torch.allclose(one, other, atol=1e-3)
    net.rounding = False
    assert torch.allclose(net.embed(image), torch.cat([direct, direct.sum(1, keepdim=True)], 1), atol=1e-4)


def test_a_schedule_says_whether_counts_are_drawn_toward_whole_numbers(dots):
    nets = [CountFeatures(CountSchedule(rounding=rounding)).build(dots) for rounding in (False, True)]
    assert [net.rounding for net in nets] == [False, True]


def test_fits_of_all_seeds_look_at_one_resolution(dots):
    """Objects of a size at which a few more or fewer in a sample decide."""
    renders, choice = SimpleNamespace(object_size=lambda: 11.5 + float(torch.rand(())), draw=print), CountFeatures()
    nets = [choice.build(replace(dots, canvas=(256, 256))) for _ in range(20)]
    for seed, net in enumerate(nets):
        choice.training(net, renders, None, seed)
    assert len({net.reduce for net in nets}) == 1


@pytest.mark.parametrize("beyond", [False, True])
def test_a_schedule_says_whether_a_network_sees_more_than_the_prior_has(dots, beyond):
    more = StructurePrior(dots.grammar, Things=lengths(0, 0, 0, 0, 0, 1))
    choice = CountFeatures(CountSchedule(beyond_prior=beyond))
    renders = RenderedFeatures(replace(dots, pretraining=more), threads=1)
    number = (choice.training(choice.build(dots), renders, None, 0).batches.draw(32).label >= 0).sum(1)
    assert (number == 5).all() if beyond else (number <= 4).all()


def test_counts_are_drawn_toward_whole_numbers_in_order():
    x = torch.linspace(0, 12, 2401, dtype=torch.float64)
    y = toward_whole(x)
    assert (y.diff() >= -1e-12).all()
    assert torch.allclose(toward_whole(torch.arange(13.0) / 1), torch.arange(13.0), atol=1e-5)
    assert torch.equal(y.round()[x % 1 != 0.5], x.round()[x % 1 != 0.5])
    near = (x - x.round()).abs() < 0.3
    assert ((y - x.round()).abs()[near] <= 0.6 * (x - x.round()).abs()[near] + 1e-12).all()


SHORT = CountSchedule(steps=260, whole=0.5, images=16, crops=24, crop=32, window=2)


def test_it_learns_to_count(dots, draw_dots):
    torch.manual_seed(0)
    net = CountNet(dots.classes, 3, dots.canvas, width=(8, 16, 16), blocks=(1, 0))
    CountTraining(net, draw_dots, SHORT, seed=1).run()
    torch.manual_seed(99)
    fresh = draw_dots(300)
    counts = torch.stack([(fresh.label == c).sum(1) for c in range(2)], 1).float()
    seen = net.embed(fresh.image)[:, :2]
    assert ((seen - counts).square().mean(0) < 0.35 * counts.var(0)).all()


def test_what_goes_wrong_while_drawing_ahead_ends_the_training(dots, draw_dots):
    calls = []

    def draw(num):
        calls.append(num)
        if len(calls) == 3:
            raise ProbsceneError("no more ink")
        return draw_dots(num)

    net = CountNet(dots.classes, 3, dots.canvas, width=(4, 8, 8), blocks=(0, 0))
    training = CountTraining(net, draw, CountSchedule(steps=72, images=2, crops=4, crop=32, window=2))
    with pytest.raises(ProbsceneError, match="no more ink"):
        training.run()
    assert training.done == 32


def test_the_last_draw_is_as_long_as_the_steps_that_are_left(dots, draw_dots):
    calls = []
    net = CountNet(dots.classes, 3, dots.canvas, width=(4, 8, 8), blocks=(0, 0))
    schedule = CountSchedule(steps=20, images=2, crops=4, crop=32, window=2)
    training = CountTraining(net, lambda num: calls.append(num) or draw_dots(num), schedule)
    training.run()
    training.run()
    assert training.done == 20 and calls == [32, 8]


def test_presence_net_stops_at_its_accuracy(dots, draw_dots):
    net = PresenceNet(dots.classes, 4, 8)
    training = PresenceTraining(net, draw_dots, 40, 5, 20, accuracy=0.0)
    training.run()
    assert training.done == 0
    features = net.embed(draw_dots(3).image)
    assert features.shape == (3, len(net.names))


def test_counts_one_hot_are_learnt_and_what_is_more_is_the_last(dots, draw_dots):
    """Of at most two of a class, told apart from none alone: two or more is one of the three ways."""
    net = PresenceNet(dots.classes, 8, 32, ways=3)
    training = PresenceTraining(net, draw_dots, 300, 30, 20, 3e-3, accuracy=0.9)
    training.run()
    assert training.summary() == {"stage": "accuracy", "accuracy": training.reached, "demanded": 0.9}
    assert training.reached > 0.8
    fresh = draw_dots(60)
    true = torch.stack([(fresh.label == c).sum(1) for c in range(len(dots.classes))], 1).clamp(max=2)
    said = net.layers(fresh.image)[1]
    assert said.shape == (60, len(dots.classes), 3)
    often = true.flatten().bincount().max() / true.numel()
    assert (said.argmax(-1) == true).float().mean() > (1 + often) / 2


def test_the_papers_counts_never_overflow():
    aerial, digits = (PresenceFeatures(counts=True).build(load_model(name)) for name in ("aerial2d", "multi_mnist"))
    assert aerial.ways == 65 and digits.ways == 33


def test_small_objects_are_reduced_less(dots):
    net = CountNet(dots.classes, 3, (188, 621))
    assert net.reduce == 4
    for size, reduce in ((40.0, 4), (24.0, 4), (23.0, 2), (12.0, 2), (11.0, 1), (1.0, 1)):
        net = CountNet(dots.classes, 3, (188, 621))
        net.fit_to(size)
        assert net.reduce == reduce
        again = CountNet(dots.classes, 3, (188, 621))
        again.load_state_dict(net.state_dict())
        assert again.reduce == reduce
        image = torch.zeros(1, 3, 188, 621, dtype=torch.uint8)
        assert again.enter(image).shape[-1] >= 621 / reduce and again.eval().embed(image).shape == (1, len(net.names))


@given(st.integers(16, 1300), st.integers(16, 1300), st.integers(1, 24))
def test_a_step_takes_no_more_pixels_of_large_images(height, width, images):
    """Than of 128 x 128 reduced ones, but for a few images at least; of those it takes what the schedule says."""
    net = CountNet(("a",), 1, (height, width), (2, 2, 2))
    taken = CountBatches(net, None, CountSchedule(images=images), 0).images
    area = height * width / net.reduce**2
    assert 1 <= taken <= images
    assert taken == images or area > FULL_AREA
    assert taken <= MIN_IMAGES or taken * area <= images * FULL_AREA + area / 2


@pytest.mark.parametrize("groups", [None, Groups("row", max_groups=2)])
def test_cells_hold_what_is_counted(groups):
    torch.manual_seed(0)
    net = CountNet(("a", "row", "b"), 3, (64, 96), (4, 8, 8), groups=groups).eval()
    with torch.no_grad():
        torch.nn.init.normal_(net.body[-1].weight, std=0.5)
    images = torch.randint(0, 256, (70, 3, 64, 96), dtype=torch.uint8)
    cells = net.cells(images)
    assert cells.shape[:2] == (70, 3) and (cells >= 0).all() and net.classes == ("a", "row", "b")
    torch.testing.assert_close(net.cells(images[3:4]), cells[3:4])
    sums = cells.sum((2, 3))
    if groups is None:
        torch.testing.assert_close(toward_whole(sums), net.embed(images)[:, :3], atol=1e-3, rtol=1e-3)
    else:
        with torch.no_grad():
            counts = net._read(net(net.enter(images))).clamp(min=0)
        of_a = counts[:, [i for i, name in enumerate(net.names) if name.startswith("a ")]].sum(1)
        torch.testing.assert_close(sums[:, 0], of_a, atol=1e-3, rtol=1e-3)


@given(st.floats(1.0, 1e8))
def test_few_large_images_are_looked_at_together(area):
    number = counting.images_at_once(area)
    assert 1 <= number <= 64 and (number == 1 or number * area <= counting.PIXELS_AT_ONCE)
    assert number == 64 or area > 256**2


def test_large_images_are_counted_like_others(monkeypatch):
    torch.manual_seed(0)
    net, images = CountNet(("a", "b"), 3, (64, 96), (4, 8, 8)).eval(), torch.randint(0, 256, (7, 3, 64, 96)).byte()
    features, maps = net.embed(images), net.cells(images)
    monkeypatch.setattr(counting, "PIXELS_AT_ONCE", 2 * 64 * 96)
    torch.testing.assert_close(net.embed(images), features)
    torch.testing.assert_close(net.cells(images), maps)
