"""Counts read from probabilities, and which readings are believed: against slow sums, and made-up heads."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from probscene.inference.features.photographs.readability import (
    MAX_DISAGREEMENT,
    Read,
    disagreement,
    histogram_scores,
    rules_for_renders,
    scopes_without_labels,
    scores,
    unlike,
    with_labels,
    without_labels,
)
from probscene.inference.features.photographs.reading import (
    LARGE,
    PEAKS,
    RULES,
    SCOPES,
    SMALL,
    Rule,
    by_steps,
    read,
    read_all,
    read_each,
)

MAPS = arrays(np.float64, (2, 6, 7), elements=st.floats(0, 1)).map(lambda x: torch.from_numpy(x / (1 + x.sum(0))))
PEAK = RULES.index(PEAKS[1])


def slowly(image: np.ndarray, rule: Rule) -> float:
    """A count, place by place."""
    if rule.name == "sum":
        return float(image.sum())
    h, w, reach = *image.shape, rule.window // 2
    mass = np.array(
        [
            [image[max(0, y - reach) : y + reach + 1, max(0, x - reach) : x + reach + 1].sum() for x in range(w)]
            for y in range(h)
        ]
    )
    if rule.name == "peaks":
        around = [mass[max(0, y - 1) : y + 2, max(0, x - 1) : x + 2].max() for y in range(h) for x in range(w)]
        return float(((mass.ravel() >= np.array(around)) & (mass.ravel() > rule.nothing)).sum())
    part = np.clip((mass - rule.nothing) / (rule.whole - rule.nothing), 0, 1)
    return float((image * part**2 * (3 - 2 * part) * np.maximum(1 / np.maximum(mass, rule.nothing), 1)).sum())


@given(MAPS, st.sampled_from([rule for rule in RULES if rule.name != "peaks"]))
def test_a_rule_is_its_sum_place_by_place(maps, rule):
    assert read(maps[None], rule)[0].tolist() == pytest.approx([slowly(each.numpy(), rule) for each in maps], abs=1e-9)


@pytest.mark.parametrize("rule", PEAKS, ids=str)
def test_peaks_are_the_places_that_hold_most_around(rule):
    maps = torch.rand(3, 9, 11, generator=torch.manual_seed(0)).double() ** 6
    assert read(maps[None], rule)[0].tolist() == [slowly(each.numpy(), rule) for each in maps]


def test_an_object_is_taken_to_whole():
    """Spread over four places it counts as none, as a part or as one; beyond that what there is counts."""
    rule = Rule("soft", 3, 0.1, 0.5)
    for probability, least, most in (
        (0.0, 0, 0),
        (0.1, 0, 1e-6),
        (0.3, 0.5 - 1e-5, 0.5 + 1e-5),
        (1.0, 1, 1),
        (2.0, 2, 2),
    ):
        maps = torch.zeros(1, 1, 9, 9)
        maps[0, 0, :2, 3:5] = probability * torch.tensor([[0.1, 0.2], [0.3, 0.4]])
        assert least - 1e-5 <= read(maps, rule).item() <= most + 1e-5
    grain = torch.full((1, 1, 30, 30), 0.01)  # a little everywhere
    assert grain.sum() == pytest.approx(9, rel=1e-4) and read(grain, rule).sum() == 0


def test_each_class_has_its_own_rules_and_their_median():
    maps = torch.rand(4, 3, 8, 8, generator=torch.manual_seed(1)) * 0.2
    rules = torch.zeros(3, len(RULES), dtype=torch.bool)
    rules[0, 5] = rules[1, [0, 3, PEAK]] = rules[2, [2, 8]] = True
    every = read_all(maps)
    expected = [every[:, 5, 0], every[:, [0, 3, PEAK], 1].median(1).values, every[:, [2, 8], 2].mean(1)]
    assert torch.allclose(read_each(maps, rules), torch.stack(expected, 1))


def test_steps_are_reached_or_not():
    steps = torch.tensor([[math.inf, math.inf], [0.5, 2.0]])
    counts = torch.tensor([[3.3, 0.4], [0.0, 0.5], [1.0, 7.0]])
    assert torch.equal(by_steps(counts, steps), torch.tensor([[3.3, 0.0], [0.0, 1.0], [1.0, 2.0]]))


def test_renders_are_read_by_what_errs_least():
    true = torch.tensor([[1.0, 2.0], [3.0, 0.0]])
    read = torch.stack([true + 1, true * torch.tensor([1.0, 0.5]), true + torch.tensor([0.4, 0.1])], 2)
    assert rules_for_renders(read, true).tolist() == [[False, True, False], [False, False, True]]


def test_small_objects_are_in_the_scope_without_labels_unless_few_are():
    true = torch.ones(4, len(SCOPES), 2)
    true[:, LARGE, 1] = 0.5
    assert scopes_without_labels(true).tolist() == [LARGE, SMALL]


def made(true: np.ndarray, seen: np.ndarray, apart: float = 0.02, ramp: float = 0.0, seed: int = 0) -> Read:
    """What heads read of one class: ``seen (L,)`` by each rule, but for noise of ``apart`` between heads and a level
    that changes by ``ramp`` from one threshold to the next; on renders the truth."""
    rng = np.random.default_rng(seed)
    R, S, L = len(RULES), len(SCOPES), len(seen)
    level = np.ones(R)
    for start in (1, 7, 13):
        level[start : start + 6] = (1 + ramp) ** -np.arange(6)
    whole = torch.from_numpy(np.broadcast_to((seen[:, None] * level)[:, None, :, None], (L, S, R, 1)).copy()).float()
    heads = torch.stack([whole + apart * torch.from_numpy(rng.normal(size=(L, 1, 1, 1))).float() for _ in range(4)])
    drawn = torch.from_numpy(rng.integers(0, 6, (50, 1, 1))).float().expand(-1, S, -1)
    return Read(whole, whole[: len(true)], disagreement(heads), drawn[:, :, None].expand(-1, -1, R, -1), drawn)


def test_heads_are_apart_by_the_mean_difference_of_any_two():
    by_head = torch.rand(4, 5, 2, 3, 1, generator=torch.Generator().manual_seed(0)) * 3
    x = by_head.double().numpy()
    apart = np.mean([np.abs(x[i] - x[j]).mean(0) for i in range(4) for j in range(i)], 0)
    assert torch.allclose(disagreement(by_head), torch.from_numpy(apart / (x.mean((0, 1)) + 0.3)).float())


COUNTS = np.random.default_rng(5).integers(0, 5, 60).astype(float)


def test_heads_that_agree_are_believed():
    found = without_labels(made(COUNTS, COUNTS), 0)
    assert found.readable and found.by == "agreement" and found.mean == pytest.approx(COUNTS.mean(), rel=1e-4)
    assert found.because.startswith("readable, ") and found.disagreement < MAX_DISAGREEMENT


@pytest.mark.parametrize("spoilt", [{"apart": 1.5}, {"ramp": 0.8}], ids=str)
def test_heads_that_differ_or_rules_that_differ_are_not(spoilt):
    found = without_labels(made(COUNTS, COUNTS, **spoilt), 0)
    assert not found.readable and found.because.startswith("not readable, ") and "label ten images" in found.because


def test_small_objects_are_not_believed_without_labels():
    read = made(COUNTS[:10], COUNTS)
    true, renders = read.true.clone(), read.renders.clone()
    true[:, LARGE] = true[:, LARGE].clamp(max=1)
    renders[:, LARGE] = renders[:, LARGE].clamp(max=1)
    read = read._replace(true=true, renders=renders)
    assert scopes_without_labels(read.true).tolist() == [SMALL]
    free = without_labels(read, 0)
    assert free.disagreement < 0.1 and free.skill > 0.9 and not free.readable
    assert "most objects under 16 pixels" in free.because and "label ten images" in free.because
    found = with_labels(read, 0, torch.from_numpy(COUNTS[:10]))
    assert found.readable and found.scope >= SMALL  # the large ones are read as well, and are not what was labelled


def test_rules_that_count_renders_badly_are_left_out():
    """Of rules that read from once to seven times as much, one counts the renders right: the others do not matter."""
    read = made(COUNTS, COUNTS, ramp=0.5)
    wrong = read.renders + 1
    wrong[:, :, 2] = read.renders[:, :, 2]
    found = without_labels(read._replace(renders=wrong), 0)
    assert found.rules == (2,) and found.spread == 0 and found.readable
    assert found.mean == pytest.approx(COUNTS.mean() / 1.5, rel=1e-4)


def test_what_cannot_count_renders_is_not_believed():
    read = made(COUNTS, COUNTS)
    assert not without_labels(read._replace(renders=torch.ones_like(read.renders)), 0).readable


def test_labels_choose_the_rule_that_reads_them():
    """Of a level that doubles from threshold to threshold, one is right."""
    read = made(COUNTS[:10], 8 * COUNTS, ramp=1.0)
    found = with_labels(read, 0, torch.from_numpy(COUNTS[:10]))
    assert found.readable and found.by == "labels" and found.error < 0.1
    assert found.mean == pytest.approx(COUNTS.mean(), rel=0.1)


def test_labels_that_bear_out_what_is_read_without_them_change_nothing():
    """Ten labels would choose another rule by luck."""
    rng = np.random.default_rng(2)
    read = made(COUNTS[:10], COUNTS + rng.normal(0, 0.5, len(COUNTS)), ramp=0.05)
    free, found = without_labels(read, 0), with_labels(read, 0, torch.from_numpy(COUNTS[:10]))
    assert free.readable and found.by == "labels" and (found.rules, found.scope) == (free.rules, free.scope)
    assert "10 labels confirm it" in found.because and 0 < found.error < 1


def test_the_labels_histogram_is_learnt_where_nothing_reads_them():
    rng = np.random.default_rng(1)
    read = made(COUNTS[:10], rng.permutation(COUNTS) * 3, apart=2.0)
    labels = torch.tensor([0.0, 1, 1, 1, 1, 1, 1, 2, 2, 1])
    found = with_labels(read, 0, labels)
    counts = by_steps(read.photographs[:, found.scope, found.rules[0]], torch.tensor([found.steps]))
    assert found.readable and found.by == "histogram" and found.error > 0
    assert counts.mean().item() == pytest.approx(labels.mean().item(), abs=0.35)


@pytest.mark.parametrize("apart", [0.02, 2.0], ids=["readable without labels", "not readable without them"])
@pytest.mark.parametrize("noise", [0.2, 1.0, 2.0, 3.0])
def test_no_reading_that_errs_more_than_the_labels_histogram_is_learnt(noise, apart):
    """Of unbiased readings, which labels would bear out: those that err clearly more, or a histogram of which predicts
    labels worse, are given up."""
    labels = torch.from_numpy(COUNTS[:10])
    off = noise * np.random.default_rng(4).permutation(np.linspace(-1.7, 1.7, len(COUNTS)))
    off[:10] -= off[:10].mean()
    found = with_labels(made(COUNTS[:10], COUNTS + off, apart), 0, labels)
    error, histogram = float(np.abs(off[:10]).mean()), float(histogram_scores(COUNTS[:10]).mean())
    assert found.readable and (found.by == "histogram") is (error > histogram)
    assert ("confirm it" in found.because) is (found.by == "labels" and apart < 1)
    assert ("histogram of 10 labels is learnt" in found.because) is (found.by == "histogram")


def test_a_reading_whose_histogram_is_right_may_err_a_little_more_than_the_labels_histogram():
    """As what one image shows is not asked for. Far more it may not err, nor with another histogram."""
    labels, rng = torch.from_numpy(COUNTS[:10]), np.random.default_rng(0)
    for _ in range(200):
        seen = COUNTS.copy()
        seen[:10] = rng.permutation(COUNTS[:10])
        error, histogram = np.abs(seen[:10] - COUNTS[:10]).mean(), float(histogram_scores(COUNTS[:10]).mean())
        if histogram + 0.05 < error < 1.25 * histogram:
            break
    assert with_labels(made(COUNTS[:10], seen), 0, labels).by == "labels"
    wider = np.concatenate([seen[:10], seen[10:] * 3 - 4])
    assert with_labels(made(COUNTS[:10], wider), 0, labels).by == "histogram"


@given(arrays(float, st.integers(1, 9), elements=st.floats(-9, 9)), arrays(float, 4, elements=st.floats(0, 9)))
def test_the_score_is_the_mean_distance_less_half_of_the_distances_among_what_is_read(seen, labels):
    among = np.mean([abs(a - b) for a in seen for b in seen])
    for label, score in zip(labels, scores(seen, labels), strict=True):
        assert score == pytest.approx(np.mean(np.abs(seen - label)) - among / 2, abs=1e-9)
    for i, score in enumerate(histogram_scores(labels)):
        others = np.delete(labels, i)
        assert score == pytest.approx(scores(others, labels[i : i + 1])[0], abs=1e-9)


def test_labels_of_another_place_choose_no_rule():
    """In the images without labels three more are read by every rule, and rules differ: what the labels say of a rule
    does not hold there. Of images drawn from all it does."""
    elsewhere = np.where(np.arange(len(COUNTS)) < 12, COUNTS, COUNTS + 3)
    labels = torch.from_numpy(COUNTS[:12])
    found = with_labels(made(COUNTS[:12], 4 * elsewhere, ramp=1.0), 0, labels)
    assert found.by == "histogram" and found.mean == pytest.approx(labels.mean().item())
    assert found.because.endswith("the best rule reads 2.1 in these images and 4.9 in the others; label some of those")
    assert with_labels(made(COUNTS[:12], 4 * COUNTS, ramp=1.0), 0, labels).by == "labels"


def test_labels_that_do_not_go_with_what_is_seen_are_not_used():
    """Half of the objects, and not those of the fuller images: not all are labelled."""
    labels = torch.from_numpy(np.random.default_rng(3).permutation(COUNTS[:12]) / 2).round()
    found = with_labels(made(COUNTS[:12], 3 * COUNTS + 4), 0, labels)
    assert found.readable and found.by == "agreement" and "do not correlate with" in found.because
    assert found.mean == pytest.approx(3 * COUNTS.mean() + 4, rel=1e-3)


@pytest.mark.parametrize("labels", [torch.zeros(10), torch.tensor([1.0, 2, 0])], ids=["no object", "too few"])
def test_labels_that_choose_nothing_are_said(labels):
    read = made(COUNTS[: len(labels)], COUNTS)
    found = with_labels(read, 0, labels)
    assert found.by == "agreement" and found.because != without_labels(read, 0).because


@pytest.mark.parametrize(("number", "share"), [(10, 0.1), (20, 0.2), (20, 1.0)])
def test_labelled_photographs_drawn_at_random_are_seldom_unlike_the_others(number, share):
    """In about the 5 % that two standard errors are for, of a rare class as well; few that show none vary little."""
    rng = np.random.default_rng(0)
    counts = rng.poisson(3.0, 300) * (rng.uniform(size=300) < share) + rng.uniform(0, 0.1, 300)
    draws = [unlike(rng.choice(counts, number, replace=False), counts) for _ in range(2000)]
    assert sum(draw is not None for draw in draws) <= 0.06 * len(draws)


def test_photographs_of_another_place_are_unlike():
    rng = np.random.default_rng(0)
    here, there = rng.poisson(1.0, 20).astype(float), rng.poisson(3.0, 280).astype(float)
    found = unlike(here, np.concatenate([here, there]))
    assert found is not None and found == pytest.approx((here.mean(), there.mean()))
    assert unlike(here, here) is None
