"""The residual noise as reported to the user."""

import pytest
import torch

from mkc_torch import Recording, diagnose
from mkc_torch.effects.sensor.hard_iron_step import HardIronStep
from mkc_torch.simulation import Magnetometer

pytestmark = pytest.mark.e2e


def reported_noise(step, correlation):
    """Return the noise that a diagnosis reports for a turning sensor whose offset drifts by `step` µT per sample."""
    generator = torch.Generator().manual_seed(4)
    time = 0.02 * torch.arange(2000, dtype=torch.float64)
    turn = torch.stack([torch.sin(0.9 * time), torch.cos(1.3 * time), torch.sin(1.7 * time + 1.0)], -1)
    field = 50.0 * turn / torch.linalg.vector_norm(turn, dim=-1, keepdim=True)
    white = torch.randn(2, len(time), 3, generator=generator, dtype=torch.float64)
    noise = white[0].clone()
    for k in range(1, len(time)):
        noise[k] += correlation * noise[k - 1]
    readings = field + 0.3 * noise + step * white[1].cumsum(0)
    columns = dict(zip(("mag_x", "mag_y", "mag_z"), readings.unbind(-1), strict=True))
    return diagnose(
        Magnetometer(), Recording({"time": time, **columns}), effects=(HardIronStep(),), max_findings=0
    ).noise


def test_a_drifting_offset_is_reported_with_its_unit():
    noise = reported_noise(0.08, 0.0)
    assert noise.model == "random_walk"
    size = f"{noise.parameters['drift']:.2g} µT"
    assert noise.description.endswith(f"noise around an offset with a random walk of standard deviation {size}")
    assert 1.0 < noise.parameters["drift"] < 8.0  # 0.08 √2000 is 3.6
    assert noise.units["drift"] == noise.unit == "µT"


def test_correlated_noise_is_coloured_and_uncorrelated_noise_is_white():
    coloured, white = reported_noise(0.0, 0.7), reported_noise(0.0, 0.0)
    assert (coloured.model, white.model) == ("ar", "white")
    # the noise is Gaussian, though the fitted σ need not be infinite
    assert (coloured.description, white.description) == ("Gaussian coloured noise", "Gaussian white noise")
    assert all(channel.is_gaussian for noise in (coloured, white) for channel in noise.tails)
    assert len(white.tails) == len(white.sigma)
