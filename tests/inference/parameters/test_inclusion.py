"""How likely objects are found."""

import torch

from probscene.inference.parameters.reading.inclusion import Inclusion

LINE, CIRCLE = torch.tensor([False]), torch.tensor([True])


def population(number: int, chance, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """``(K, 1)`` u, not uniform, and which are found, with a chance that goes by u."""
    torch.manual_seed(seed)
    u = torch.distributions.Beta(2.0, 3.0).sample((number, 1))
    return u, torch.rand(number) < chance(u[:, 0])


def rising(u):
    return (3 * u - 1).sigmoid()


def weighted_mean(inclusion: Inclusion, u: torch.Tensor) -> float:
    weight = inclusion.weight(torch.zeros(1, len(u), dtype=torch.int64), u[None])[0]
    return float((weight * u[:, 0]).sum() / weight.sum())


def test_what_is_found_less_often_counts_more():
    """Known from a population of another distribution, as renders of the prior are."""
    torch.manual_seed(1)
    known = torch.rand(4000, 1)
    kind = torch.zeros(4000, dtype=torch.int64)
    inclusion = Inclusion(kind, known, torch.rand(4000) < rising(known[:, 0]), LINE)
    u, found = population(20000, rising)
    assert abs(float(u[found].mean() - u.mean())) > 0.05
    assert abs(weighted_mean(inclusion, u[found]) - float(u.mean())) < 0.01


def test_a_circle_has_no_seam():
    torch.manual_seed(0)
    u, kind = torch.rand(2000, 1), torch.zeros(2000, dtype=torch.int64)
    inclusion = Inclusion(kind, u, torch.rand(2000) < 0.5 + 0.4 * (2 * torch.pi * u[:, 0]).cos(), CIRCLE)
    weight = inclusion.weight(torch.zeros(1, 3, dtype=torch.int64), torch.tensor([[[0.0], [1.0], [0.5]]]))[0]
    assert torch.allclose(weight[0], weight[1], atol=1e-4)
    assert weight[2] > 2 * weight[0]


def test_each_kind_counts_one_in_the_mean_and_an_unknown_one_everywhere():
    u, found = population(500, rising)
    inclusion = Inclusion(torch.full((500,), 2), u, found, LINE)
    kind = torch.tensor([[2, 2, 2, 7, -1]])
    weight = inclusion.weight(kind, torch.tensor([[[0.1], [0.5], [0.9], [0.3], [torch.nan]]]))
    assert abs(float(weight[0, :3].mean()) - 1) < 1e-5
    assert weight[0, 0] > weight[0, 1] > weight[0, 2]
    assert (weight[0, 3:] == 1).all()


def test_where_all_are_found_or_few_are_known_all_count_alike():
    u = torch.rand(300, 1)
    kind = torch.zeros(300, dtype=torch.int64)
    for found in (torch.ones(300, dtype=torch.bool), torch.arange(300) < 10):
        assert (Inclusion(kind, u, found, LINE).weight(kind[None], u[None]) == 1).all()
