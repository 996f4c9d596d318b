"""Whether the fit without the last finding is clearly less likely, whatever the standard error of its size."""

import types

import pytest
import torch

from mkc_torch.diagnosis.pipeline.build import _clearly_better
from mkc_torch.diagnosis.settings import NamingSettings

SAMPLES = 400


def fits(*residuals):
    """Return fits with these residuals, each with an effect of one amplitude and one fitted shape number."""
    effect = types.SimpleNamespace(fitted_shape={"time_constant": (0.1, 1.0)})
    model = types.SimpleNamespace(sizes=[1], terms=[types.SimpleNamespace(effect=effect)])
    return [
        types.SimpleNamespace(model=model, residual=residual.unsqueeze(-1), recorded=None) for residual in residuals
    ]


def noise(seed):
    return 0.1 * torch.randn(SAMPLES, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize(("size", "better"), [(0.0, False), (0.02, False), (1.0, True)])
def test_the_last_finding_needs_a_gain_above_its_penalty(size, better):
    decay = size * torch.exp(-(torch.arange(SAMPLES) % 100) / 10.0)
    assert _clearly_better(fits(noise(0) + decay, noise(0)), 0, NamingSettings()) is better


def test_the_gain_of_a_later_finding_does_not_count_for_an_earlier_finding():
    decay = torch.exp(-(torch.arange(SAMPLES) % 100) / 10.0)
    three = fits(noise(0) + 2.0 * decay, noise(0) + decay, noise(0))
    assert not _clearly_better(three, 0, NamingSettings())
    assert _clearly_better(three, 1, NamingSettings())
