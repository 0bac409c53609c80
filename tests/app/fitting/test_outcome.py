"""Classes that cannot be read, and whose number changes all the same."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from probscene.app.fitting.outcome import _said, _worse_said, moved, worse_than_labels
from probscene.app.labels.partial_labels import PartialLabels

N = 500


def counts(means: list[float], seed: int) -> torch.Tensor:
    """Poisson counts ``(N, K)``."""
    rates = torch.tensor(means, dtype=torch.float64).expand(N, -1)
    return torch.poisson(rates, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("mean", [0.05, 1.0, 20.0])
@pytest.mark.parametrize("seed", range(0, 20, 2))
def test_chance_is_not_told(seed, mean):
    assert moved(counts([mean], seed), counts([mean], seed + 1), {"car": 0}) == {}


@given(st.integers(0, 2**31), st.floats(1, 20))
def test_twice_as_many_are_told_with_their_means(seed, mean):
    prior, learnt = counts([5.0, mean], seed), counts([9.0, 2 * mean], seed + 1)
    assert moved(learnt, prior, {"car": 1}) == {"car": (prior[:, 1].mean().item(), learnt[:, 1].mean().item())}


def test_a_change_that_is_sure_and_small_is_not_told():
    prior = torch.full((N, 1), 20.0, dtype=torch.float64)
    assert moved(prior + 1, prior, {"car": 0}) == {} and "car" in moved(prior + 3, prior, {"car": 0})


def test_the_sentence_names_them_and_says_what_to_do():
    assert _said({}) == ""
    assert "car (from 1.66 to 2.01 a scene)" in _said({"car": (1.66, 2.01)}) and "Label ten" in _said({"a": (1, 2)})


@pytest.mark.parametrize("seed", range(8))
def test_what_was_learnt_is_held_against_the_labels_histogram(seed):
    """As many as the labels have are as good, whatever the labels; five more an image are worse. A class without
    labels is left out."""
    drawn = counts([1.0, 2.0, 1.0], seed)
    labels = PartialLabels(torch.arange(10), drawn[:10, :2].long(), ("dead", "live"), None, ())
    learnt = dict(zip(("dead", "live", "other"), drawn.T.numpy(), strict=True))
    assert worse_than_labels(labels, learnt) == {} and _worse_said({}) == ""
    found = worse_than_labels(labels, learnt | {"dead": learnt["dead"] + 5})
    assert found.keys() == {"dead"} and found["dead"][0] > found["dead"][1] + 1
    assert f"dead ({found['dead'][0]:.2f} against {found['dead'][1]:.2f})" in _worse_said(found)
    assert worse_than_labels(labels, {}) == {}
