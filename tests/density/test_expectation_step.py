"""The expectation step: maximum likelihood, annealing, narrow domains, and damping."""

import math

import pytest
import torch

from mkc_torch import MKCDistribution, fit_density
from mkc_torch.density.expectation_step import damped, damped_kappa, expectation_step

INF = math.inf
DOMAIN = {"bound": torch.tensor([20.0, 30.0]).double(), "d_min": torch.tensor([1e-3, 1e-3]).double()}


def residuals(count=3000, seed=0):
    """A heavy-tailed channel and a Gaussian channel."""
    torch.manual_seed(seed)
    heavy = MKCDistribution(torch.tensor(2.0).double(), torch.tensor(0.5).double(), 20.0).sample((count,))
    gaussian = torch.erfinv(2 * (torch.arange(count).double() + 0.5) / count - 1) * 2**0.5  # quantiles
    return torch.stack([heavy, 0.7 * gaussian], -1)


def test_the_step_has_the_maximum_likelihood_for_weighted_residuals():
    error = residuals()
    weight = torch.rand_like(error)
    found = expectation_step(error, weight, **DOMAIN)
    fit = fit_density(error, weight=weight, **DOMAIN)
    torch.testing.assert_close(found.d, fit.d)
    torch.testing.assert_close(found.kappa, fit.sigma.pow(-2))
    assert not found.narrow.any()


def test_gaussian_residuals_reach_infinite_sigma_exactly():
    error = residuals()
    found = expectation_step(error, torch.ones_like(error), **DOMAIN)
    assert found.kappa[1] == 0
    assert found.d[1].item() == pytest.approx(0.7, rel=2e-3)


def test_annealed_step_takes_a_share_of_kappa_and_fits_d_for_it():
    error = residuals()
    weight = torch.ones_like(error)
    full = expectation_step(error, weight, **DOMAIN)
    part = expectation_step(error, weight, **DOMAIN, share=0.25)
    torch.testing.assert_close(part.kappa, 0.25 * full.kappa)
    d = fit_density(error, **DOMAIN, sigma=2 * full.kappa.rsqrt()).d
    torch.testing.assert_close(part.d, d)
    assert part.d[0] > full.d[0]


def test_a_narrow_domain_gets_least_squares_and_does_not_affect_other_channels():
    error = residuals()
    wide = error * torch.tensor([1000.0, 1.0])
    found = expectation_step(wide, torch.ones_like(error), **DOMAIN)
    assert found.narrow.tolist() == [True, False]
    assert found.kappa[0] == 0
    assert found.d[0] == 10
    alone = expectation_step(error, torch.ones_like(error), **DOMAIN)
    torch.testing.assert_close((found.kappa[1], found.d[1]), (alone.kappa[1], alone.d[1]))


def test_a_single_residual_equals_two_of_its_size():
    error, weight = torch.tensor([[0.5, -2.0]]).double(), torch.tensor([[3.0, 1.0]]).double()
    found = expectation_step(error, weight, **DOMAIN)
    twice = expectation_step(error.repeat(2, 1), weight.repeat(2, 1), **DOMAIN)
    torch.testing.assert_close((found.kappa, found.d), (twice.kappa, twice.d))
    assert bool((found.d > DOMAIN["d_min"]).all())


def test_residuals_of_zero_end_at_the_floor():
    found = expectation_step(torch.zeros(50, 2).double(), torch.ones(50, 2).double(), **DOMAIN)
    torch.testing.assert_close(found.d, DOMAIN["d_min"])


def test_damping_interpolates_in_log_d():
    before, after = torch.tensor([1.0, 4.0]).double(), torch.tensor([100.0, 4.0]).double()
    torch.testing.assert_close(damped(before, after, 0.5), torch.tensor([10.0, 4.0]).double())
    torch.testing.assert_close(damped(before, after, 0.0), after)


@pytest.mark.parametrize("keep", [0.0, 0.3, 0.9])
def test_damped_kappa_lies_between_and_is_exact_at_infinite_sigma(keep):
    before, after = torch.tensor([4.0, 0.0, 0.0, 1.0]).double(), torch.tensor([0.25, 0.0, 1.0, 0.0]).double()
    found = damped_kappa(before, after, keep)
    assert found[1] == 0
    low, high = torch.minimum(before, after), torch.maximum(before, after)
    assert ((found >= low) & (found <= high * (1 + 1e-12))).all()
    torch.testing.assert_close(
        torch.log(found + 0.02), (1 - keep) * torch.log(after + 0.02) + keep * torch.log(before + 0.02)
    )
    if keep == 0:
        torch.testing.assert_close(found, after, rtol=1e-14, atol=0)


def test_damped_steps_converge_to_infinite_sigma():
    kappa = torch.tensor([1.0]).double()
    for _ in range(200):
        kappa = damped_kappa(kappa, torch.zeros(1).double(), 0.7)
    assert kappa.item() < 1e-20
