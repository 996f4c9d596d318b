"""Disturbances of a magnetometer that are not physics to name: a drifting offset, and passing sources."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Generator, Tensor

from mkc_torch.challenge.draws import log_uniform, smooth, uniform, whole
from mkc_torch.challenge.magnetometer.noise import Noise
from mkc_torch.challenge.magnetometer.process import Process

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

OVER_NOISE = (2.0, 8.0)
"""RMS drift of an offset about its mean, over the standard deviation of the sensor's noise."""

BURSTS, BURST = (2, 5), (0.01, 0.04)
"""Number of bursts in a recording, and the length of each as a share of it."""

HEIGHT = (5.0, 30.0)
"""Size of a burst, over the standard deviation of the sensor's noise."""

PERIOD = (0.1, 0.6)
"""Shortest period within a burst, s."""


def drifting(g: Generator, noise: Noise, samples: int) -> tuple[Noise, float]:
    """Add a random walk to the noise of each axis. Returns the noise and the size of the drift over it."""
    wanted = log_uniform(g, *OVER_NOISE)
    # the RMS of a walk of N steps about its own mean is √(N / 6) steps
    step = wanted * noise.sigma * math.sqrt(6.0 / samples)
    x, y, z = (Process((1.0,), step * uniform(g, 0.8, 1.25)) for _ in range(3))
    return replace(noise, kind=f"{noise.kind}, wander", walks=(x, y, z)), wanted


def bursts(g: Generator, sigma: float, samples: int, step: float) -> tuple[Float[Tensor, "N 3"], Bool[Tensor, " N"]]:
    """Draw fields of both signs that rise and fade in a few intervals, unlike the field of a passing dipole.

    Args:
        sigma: standard deviation of the sensor's noise, µT.
        samples: N.
        step: time between samples in s.

    Returns:
        The fields in the sensor's axes, µT, and the mask of their samples.
    """
    field, mask = torch.zeros(samples, 3, dtype=torch.float64), torch.zeros(samples, dtype=torch.bool)
    for _ in range(whole(g, *BURSTS)):
        length = max(round(uniform(g, *BURST) * samples), 3)
        start = whole(g, 0, samples - length)
        rise = torch.sin(math.pi * (torch.arange(length, dtype=torch.float64) + 0.5) / length)
        path = smooth(g, length, 3, step, log_uniform(g, *PERIOD))
        field[start : start + length] += log_uniform(g, *HEIGHT) * sigma / math.sqrt(3.0) * rise[:, None] * path
        mask[start : start + length] = True
    return field, mask
