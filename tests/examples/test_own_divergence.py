"""The example of a divergence of one's own: the derivative of the energy distance, and a fit with it."""

from pathlib import Path

import torch
from hypothesis import given
from hypothesis import strategies as st

import probscene as ps
from probscene.app.modules import import_file

EXAMPLES = Path(__file__).parents[2] / "examples"
FILE = EXAMPLES / "own_divergence.py"
ENERGY = import_file(FILE).energy


def distance(x, y, q, p):
    """The energy distance of weights q on points x and p on points y."""
    across, one, other = torch.cdist(x, y), torch.cdist(x, x), torch.cdist(y, y)
    return 2 * q @ across @ p - q @ one @ q - p @ other @ p


@given(st.integers(2, 12), st.integers(1, 12), st.integers(1, 3), st.integers(0, 2**31))
def test_it_is_the_derivative_of_the_energy_distance(N, L, D, seed):
    torch.manual_seed(seed)
    x, y = torch.randn(N, D, dtype=torch.float64), torch.randn(L, D, dtype=torch.float64)
    q = torch.full((N,), 1 / N, dtype=torch.float64, requires_grad=True)
    p = torch.full((L,), 1 / L, dtype=torch.float64)
    distance(x, y, q, p).backward()
    # The cost leaves a scene itself out of the mean, as an unbiased estimate does; the derivative does not.
    others = torch.cdist(x, x).sum(1) * (1 / (N - 1) - 1 / N)
    torch.testing.assert_close(ENERGY(x, y), q.grad - 2 * others, atol=1e-6, rtol=1e-6)


def test_scenes_near_the_real_ones_cost_less():
    torch.manual_seed(0)
    generated, real = torch.randn(200, 2), torch.randn(300, 2) + 1
    cost = ENERGY(generated, real)
    assert torch.corrcoef(torch.stack([cost, -generated.sum(1)]))[0, 1] > 0.9


def test_it_is_fitted(both_ways):
    ways = both_ways(["--divergence", f"{FILE}:energy"], {"divergence": ENERGY})
    assert ps.Run.open(ways.command).record["config"]["divergence"] == f"{FILE}:energy"


def test_it_goes_on_to_the_same_bytes(goes_on):
    goes_on("structure", divergence=ENERGY)
