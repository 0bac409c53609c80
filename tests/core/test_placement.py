"""Objects that are pushed apart."""

import torch
from hypothesis import given
from hypothesis import strategies as st

from probscene.placement import separate


@given(st.integers(0, 2**31), st.integers(1, 8))
def test_with_room_none_overlaps_and_all_stay_on_the_canvas(seed, number):
    rng = torch.Generator().manual_seed(seed)
    x, y = 200 * torch.rand(4, number, generator=rng), 100 * torch.rand(4, number, generator=rng)
    radius = 2 + 6 * torch.rand(4, number, generator=rng)
    present = torch.rand(4, number, generator=rng) < 0.8
    at = separate(x, y, radius, present, (100, 200))
    assert all(part.min() >= 0 and part.max() <= most for part, most in zip(at, (200, 100), strict=True))
    assert torch.equal(at[0][~present], x[~present]) and torch.equal(at[1][~present], y[~present])
    away = (torch.stack(at, -1).unsqueeze(2) - torch.stack(at, -1).unsqueeze(1)).norm(dim=-1)
    pair = present.unsqueeze(2) & present.unsqueeze(1) & ~torch.eye(number, dtype=torch.bool)
    overlap = (radius.unsqueeze(2) + radius.unsqueeze(1) - away).where(pair, -1.0)
    assert float(overlap.max()) < 1.0 and torch.equal(overlap, overlap.mT)


def test_those_that_do_not_overlap_stay():
    x, y = torch.tensor([[10.0, 50.0, 90.0]]), torch.full((1, 3), 20.0)
    at = separate(x, y, 8.0, torch.ones(1, 3, dtype=torch.bool), (40, 100))
    assert torch.equal(at[0], x) and torch.equal(at[1], y)


def test_two_at_one_place_part():
    """Which have no line between them."""
    at = separate(torch.full((1, 2), 50.0), torch.full((1, 2), 50.0), 5.0, torch.ones(1, 2, dtype=torch.bool), (99, 99))
    assert float(torch.hypot(*(part[:, 0] - part[:, 1] for part in at))) > 9.0
