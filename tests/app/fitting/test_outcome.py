"""Classes that cannot be read, and whose number changes all the same."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from probscene.app.fitting.learnt.outcome import _said, moved

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
    assert "car (from 1.66 to 2.01 in a structure)" in _said({"car": (1.66, 2.01)}) and "Label ten" in _said(
        {"a": (1, 2)}
    )
