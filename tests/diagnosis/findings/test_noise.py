"""The noise that is left, as a user reads it."""

import pytest
import torch

from mkc_torch import Recording, diagnose
from mkc_torch.effects.sensor.hard_iron_step import HardIronStep
from mkc_torch.simulation import Magnetometer

pytestmark = pytest.mark.e2e


def told(step, correlation):
    """The noise that a diagnosis tells of, of a turning sensor whose offset walks by so much a sample."""
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


def test_an_offset_that_wanders_is_told_with_its_unit():
    noise = text(0.08, 0.0)
    assert noise.model == "random_walk"
    size = f"{noise.parameters['wander']:.2g} µT in all"
    assert noise.description.endswith(f"noise around an offset that wanders like a random walk, by {size}")
    assert 1.0 < noise.parameters["wander"] < 8.0  # 0.08 √2000 is 3.6
    assert noise.units["wander"] == noise.unit == "µT"


def test_noise_with_a_memory_is_coloured_and_without_one_white():
    coloured, white = text(0.0, 0.7), text(0.0, 0.0)
    assert (coloured.model, white.model) == ("ar", "white")
    # the noise is Gaussian, though the fitted σ need not be infinite
    assert (coloured.description, white.description) == ("Gaussian coloured noise", "Gaussian white noise")
    assert all(channel.is_gaussian for noise in (coloured, white) for channel in noise.tails)
    assert len(white.tails) == len(white.sigma)
