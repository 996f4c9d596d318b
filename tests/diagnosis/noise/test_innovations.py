"""Comparison of two residuals by their innovations, whatever the slow noise."""

import pytest
import torch

from mkc_torch.diagnosis.noise.spectrum import agreed_innovation_gain, innovation_gain

N = 1500


def drifting_noise(seed=0):
    """Return a random walk plus white noise, (N, 1)."""
    draws = torch.randn(N, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return (0.5 * draws[:, 0].cumsum(0) + 0.1 * draws[:, 1]).unsqueeze(-1)


FAST = 1.5 * torch.exp(-0.2 * (torch.arange(N, dtype=torch.float64) % 97.0)).unsqueeze(-1)
"""The residual of a missing lag after each step of an input."""


def test_a_fit_with_the_fast_effect_has_better_innovations_than_a_fit_to_the_drift():
    """Under white noise the fit to the drift has the higher likelihood."""
    knows = drifting_noise()
    slow = torch.nn.functional.avg_pool1d(knows.mT, 301, 1, 150, count_include_pad=False).mT
    follows = knows - 0.3 * slow + FAST
    white = 0.5 * N * float((knows.square().mean() / follows.square().mean()).log())
    assert white > 100.0
    assert agreed_innovation_gain(follows, knows) > 25.0
    assert agreed_innovation_gain(knows, follows) < -25.0


def test_the_agreed_gain_is_the_smaller_gain_of_both_noises():
    first, other = drifting_noise(0) + FAST, drifting_noise(0)
    gains = innovation_gain(first, other), -innovation_gain(other, first)
    assert agreed_innovation_gain(first, other) == pytest.approx(min(gains))
    assert agreed_innovation_gain(other, first) == pytest.approx(-min(gains))


def test_the_agreed_gain_is_zero_if_each_wins_in_its_own_noise():
    noise = drifting_noise()
    slow = torch.nn.functional.avg_pool1d(noise.mT, 301, 1, 150, count_include_pad=False).mT
    follows = noise - slow + FAST
    assert innovation_gain(follows, noise) > 0.0 < innovation_gain(noise, follows)
    assert agreed_innovation_gain(follows, noise) == 0.0


def test_gains_of_channels_add_up():
    first, other = (
        torch.cat([drifting_noise(0), drifting_noise(1)], -1),
        torch.cat([drifting_noise(0) + FAST, drifting_noise(1)], -1),
    )
    assert innovation_gain(other, first) == pytest.approx(innovation_gain(other[:, :1], first[:, :1]))
    assert innovation_gain(first, first) == 0.0


def test_the_agreed_gain_does_not_depend_on_units_and_hardly_on_outliers():
    first, other = drifting_noise(3) + FAST, drifting_noise(3)
    assert agreed_innovation_gain(1e3 * first, 1e3 * other) == pytest.approx(agreed_innovation_gain(first, other))
    wild = torch.zeros_like(first)
    wild[700], wild[300] = 1e6, -20.0
    assert agreed_innovation_gain(first + wild, other + wild) == pytest.approx(
        agreed_innovation_gain(first, other), rel=0.1
    )
