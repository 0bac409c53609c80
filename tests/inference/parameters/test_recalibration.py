"""Readings that are made likelihoods."""

import math

import pytest
import torch
from scipy.stats import truncnorm, vonmises

from probscene.inference.parameters.learning import PRIOR_PROBABILITY
from probscene.inference.parameters.recalibration import MIN_KNOWN, Recalibration, likeliest, negative_log_likelihood
from probscene.inference.parameters.schedule import ParameterSchedule

LINE, CIRCLE = torch.tensor([False]), torch.tensor([True])


def readings(number, slope, scale):
    """u that is uniform, and what a reader says of it whose normal distributions are too far out and too wide: u given
    a reading is normal, cut off, with mean .5 + slope (mean - .5) and standard deviation scale * sd."""
    torch.manual_seed(0)
    u, error = torch.rand(number, 1), 0.05 + 0.2 * torch.rand(number, 1)
    at = u + error * torch.randn(number, 1)  # a likelihood of u
    return 0.5 + (at - 0.5) / slope, error / scale, u


@pytest.mark.parametrize(("slope", "scale"), [(1.0, 1.0), (0.65, 0.7), (1.0, 1.6), (1.3, 0.8)])
def test_what_was_distorted_is_found(slope, scale):
    found = Recalibration.from_readings(*readings(6000, slope, scale), LINE)
    assert abs(float(found.slope) / slope - 1) < 0.05 and abs(float(found.scale) / scale - 1) < 0.05
    mean, sd, u = readings(6000, slope, scale)
    after = negative_log_likelihood(*found.apply(mean, sd), u, False).mean()
    assert after <= negative_log_likelihood(mean, sd, u, False).mean() + 1e-6


def test_the_renders_of_a_round_say_a_slope_to_a_twentieth():
    """Of one value a render, read with an error of 0.2; what is learnt of its spread is as far off as the slope."""
    slopes, known = [], round(ParameterSchedule().recalibration_renders * PRIOR_PROBABILITY)
    for seed in range(20):
        torch.manual_seed(seed)
        u = torch.rand(known)
        mean = 0.5 + (u + 0.2 * torch.randn(known) - 0.5) / 0.7
        slopes.append(likeliest(mean, torch.full((known,), 0.2 / 0.7), u, circle=False)[0])
    assert torch.tensor(slopes).div(0.7).sub(1).square().mean().sqrt() < 0.055


def test_readings_that_say_nothing_are_outliers():
    mean, sd, u = readings(6000, 1.0, 1.0)
    wrong = torch.rand(6000, 1) < 0.1
    found = Recalibration.from_readings(mean, sd, torch.rand(6000, 1).where(wrong, u), LINE)
    assert abs(float(found.outliers) - 0.1) < 0.03 and abs(float(found.scale) - 1) < 0.1


def test_a_circle_has_a_scale_alone():
    torch.manual_seed(0)
    u, sd = torch.rand(6000, 1), torch.full((6000, 1), 0.06)
    mean = (u + 0.5 * sd * torch.randn(6000, 1)).remainder(1.0)
    found = Recalibration.from_readings(mean, sd, u, CIRCLE)
    assert float(found.slope) == 1.0 and abs(float(found.scale) / 0.5 - 1) < 0.05
    assert torch.equal(found.apply(mean, sd)[0], mean)


def test_few_known_values_change_nothing():
    mean, sd, u = readings(400, 0.5, 0.5)
    u[MIN_KNOWN - 1 :] = torch.nan
    found = Recalibration.from_readings(mean, sd, u, LINE)
    assert (float(found.slope), float(found.scale)) == (1.0, 1.0)


def test_densities_are_scipys():
    torch.manual_seed(0)
    mean, sd, u = 2 * torch.rand(50).double() - 0.5, 0.05 + torch.rand(50).double(), torch.rand(50).double()
    expected = -truncnorm.logpdf(u, -mean / sd, (1 - mean) / sd, mean, sd)
    assert torch.allclose(negative_log_likelihood(mean, sd, u, False), torch.from_numpy(expected), atol=1e-6)
    narrow = torch.full((50,), 0.02).double()  # where a wrapped normal and a von Mises distribution are one
    turn = 2 * math.pi
    expected = -vonmises.logpdf(turn * (u - mean), 1 / (turn * 0.02) ** 2) - math.log(turn)
    near = ((u - mean + 0.5).remainder(1.0) - 0.5).abs() < 0.05
    found = negative_log_likelihood(mean, narrow, u, True)
    assert torch.allclose(found[near], torch.from_numpy(expected)[near], atol=0.1)
