"""Two residuals are told apart by what is new in each sample, whatever slow course their noise takes."""

import pytest
import torch

from mkc_torch.diagnosis.noise.innovations import agreed_innovation_gain, innovation_gain

N = 1500


def wanders(seed=0):
    """A random walk behind a little white noise, (N, 1)."""
    draws = torch.randn(N, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return (0.5 * draws[:, 0].cumsum(0) + 0.1 * draws[:, 1]).unsqueeze(-1)


FAST = 1.5 * torch.exp(-0.2 * (torch.arange(N, dtype=torch.float64) % 97.0)).unsqueeze(-1)
"""What a lag leaves behind each step of an input."""


def test_a_fit_that_follows_the_wander_loses_to_one_that_has_what_is_fast():
    """With noise taken for white it is by far the better one."""
    knows = wanders()
    slow = torch.nn.functional.avg_pool1d(knows.mT, 301, 1, 150, count_include_pad=False).mT
    follows = knows - 0.3 * slow + FAST
    white = 0.5 * N * float((knows.square().mean() / follows.square().mean()).log())
    assert white > 100.0
    assert agreed_innovation_gain(follows, knows) > 25.0
    assert agreed_innovation_gain(knows, follows) < -25.0


def test_it_is_the_least_gain_of_both_noises_or_nothing():
    one, other = wanders(0) + FAST, wanders(0)
    gains = innovation_gain(one, other), -innovation_gain(other, one)
    assert agreed_innovation_gain(one, other) == pytest.approx(min(gains))
    assert agreed_innovation_gain(other, one) == pytest.approx(-min(gains))


def test_where_each_is_the_better_one_in_its_own_noise_neither_is():
    noise = wanders()
    slow = torch.nn.functional.avg_pool1d(noise.mT, 301, 1, 150, count_include_pad=False).mT
    follows = noise - slow + FAST
    assert innovation_gain(follows, noise) > 0.0 < innovation_gain(noise, follows)
    assert agreed_innovation_gain(follows, noise) == 0.0


def test_gains_of_channels_add_up():
    one, other = torch.cat([wanders(0), wanders(1)], -1), torch.cat([wanders(0) + FAST, wanders(1)], -1)
    assert innovation_gain(other, one) == pytest.approx(innovation_gain(other[:, :1], one[:, :1]))
    assert innovation_gain(one, one) == 0.0


def test_a_unit_changes_nothing_and_wild_samples_little():
    one, other = wanders(3) + FAST, wanders(3)
    assert agreed_innovation_gain(1e3 * one, 1e3 * other) == pytest.approx(agreed_innovation_gain(one, other))
    wild = torch.zeros_like(one)
    wild[700], wild[300] = 1e6, -20.0
    assert agreed_innovation_gain(one + wild, other + wild) == pytest.approx(agreed_innovation_gain(one, other), rel=0.1)
