"""The noise around a fit whose parameters are kept."""

import torch

from mkc_torch import MKCDistribution
from mkc_torch.diagnosis.model.process_noise import has_process_noise, with_noise_around
from mkc_torch.diagnosis.settings import NoiseSettings
from tests.diagnosis.swing import fitted_pendulum


def lag_one(residual: torch.Tensor) -> float:
    away = residual[:, 0] - residual[:, 0].mean()
    return float((away[1:] @ away[:-1]) / (away @ away))


def test_the_parameters_stay_and_the_residuals_become_white():
    free = fitted_pendulum("slow").free
    assert free is not None
    found = with_noise_around(free, {}, NoiseSettings())
    assert has_process_noise(found)
    assert torch.equal(found.parameters, free.parameters)
    assert lag_one(free.residual) > 0.9
    assert abs(lag_one(found.residual)) < 0.2
    density = MKCDistribution(found.sigma, found.d, found.bound)
    expected = float(density.log_prob(found.residual).sum())
    assert abs(found.log_likelihood - expected) < 1e-6 * abs(expected)


def test_a_fit_with_white_noise_only_is_returned_unchanged():
    free = fitted_pendulum("none").free
    assert free is not None
    assert with_noise_around(free, {}, NoiseSettings()) is free
