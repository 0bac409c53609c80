import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from probscene.errors import ProbsceneError
from probscene.inference.features.counting.muon import Muon, orthogonalise
from probscene.inference.training import restore_training, training_state

A, B, C = 3.4445, -4.7750, 2.0315
SIZES, SEEDS = st.integers(1, 40), st.integers(0, 2**31)


def quintic(matrix):
    """Five Newton-Schulz steps of the reference, on the singular values in float64."""
    U, s, V = np.linalg.svd(matrix, full_matrices=False)
    s = s / max(np.sqrt((s**2).sum()), 1e-7)
    for _ in range(5):
        s = A * s + B * s**3 + C * s**5
    return U * s @ V


def with_values(values, m, n, seed):
    """A random matrix ``(m, n)`` with these singular values."""
    generator = np.random.default_rng(seed)
    U, V = (np.linalg.qr(generator.normal(size=(size, len(values))))[0] for size in (m, n))
    return U * values @ V.T


def walk(optimiser, parameters, gradients):
    for step in gradients:
        for parameter, gradient in zip(parameters, step, strict=True):
            parameter.grad = gradient.clone()
        optimiser.step()


@given(SIZES, SIZES, st.floats(0, 0.99), st.floats(1e-3, 1), SEEDS)
def test_steps_are_those_of_the_definition(m, n, momentum, rate, seed):
    generator = torch.Generator().manual_seed(seed)
    start, *gradients = torch.randn(4, m, n, generator=generator)
    parameter = torch.nn.Parameter(start.clone())
    walk(Muon([parameter], lr=rate, momentum=momentum), [parameter], [[g] for g in gradients])
    expected, mean = start.numpy().astype(np.float64), np.zeros((m, n))
    for gradient in gradients:
        gradient = gradient.numpy().astype(np.float64)
        mean = momentum * mean + (1 - momentum) * gradient
        update = quintic(momentum * mean + (1 - momentum) * gradient)
        expected -= rate * max(1, m / n) ** 0.5 * update
    assert np.allclose(parameter.detach().numpy(), expected, atol=1e-4)


@given(SIZES, SIZES, st.floats(0, 12), SEEDS)
def test_small_singular_values_are_not_lost(m, n, decades, seed):
    matrix = with_values(np.logspace(0, -decades, min(m, n)), m, n, seed)
    assert np.allclose(orthogonalise(torch.from_numpy(matrix).float()).numpy(), quintic(matrix), atol=1e-4)


@given(SIZES, SIZES, st.floats(1e-4, 1e4), SEEDS)
def test_singular_values_come_near_one_whatever_they_were(m, n, scale, seed):
    values = np.random.default_rng(seed).uniform(0.1, 1, min(m, n)) * scale
    matrix = torch.from_numpy(with_values(values, m, n, seed)).float()
    values = torch.linalg.svdvals(orthogonalise(matrix))
    assert values.min() > 0.67
    assert values.max() < 1.21


@pytest.mark.parametrize(("m", "n"), [(32, 144), (64, 64), (48, 16)])
def test_agrees_with_torch_to_the_accuracy_of_bfloat16(m, n):
    torch.manual_seed(0)
    start, *gradients = torch.randn(6, m, n)
    ours, theirs = torch.nn.Parameter(start.clone()), torch.nn.Parameter(start.clone())
    walk(Muon([ours], lr=0.1, momentum=0.8), [ours], [[g] for g in gradients])
    torchs = torch.optim.Muon([theirs], lr=0.1, momentum=0.8, weight_decay=0.0)
    walk(torchs, [theirs], [[g] for g in gradients])
    assert (ours - theirs).norm() < 0.02 * (ours - start).norm()


def test_goes_on_from_a_state_bit_for_bit():
    torch.manual_seed(0)
    gradients = [[torch.randn(6, 9), torch.randn(9, 4)] for _ in range(6)]

    def begin():
        torch.manual_seed(1)
        module = torch.nn.ParameterList([torch.randn(6, 9), torch.randn(9, 4)])
        return module, Muon(module.parameters(), lr=0.1, momentum=0.8)

    (whole, one), (first, two), (second, three) = begin(), begin(), begin()
    walk(one, list(whole), gradients)
    walk(two, list(first), gradients[:3])
    restore_training(second, {"muon": three}, training_state(first, {"muon": two}))
    walk(three, list(second), gradients[3:])
    assert all(torch.equal(a, b) for a, b in zip(whole, second, strict=True))


def test_nothing_moves_without_a_gradient():
    still, at_rest = torch.nn.Parameter(torch.ones(3, 4)), torch.nn.Parameter(torch.ones(3, 4))
    at_rest.grad = torch.zeros(3, 4)
    Muon([still, at_rest], lr=0.1).step()
    assert torch.equal(still, torch.ones(3, 4))
    assert torch.equal(at_rest, torch.ones(3, 4))


def test_takes_matrices_alone():
    with pytest.raises(ProbsceneError, match="expected matrices"):
        Muon([torch.nn.Parameter(torch.ones(3))])
