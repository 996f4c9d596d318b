"""What disturbs a magnetometer without being physics to name: an offset that wanders, and sources that come by."""

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
"""How far an offset wanders, root mean square about its mean, over the standard deviation of the sensor's noise."""

BURSTS, BURST = (2, 5), (0.01, 0.04)
"""How many bursts a recording has, and the length of each as a share of it."""

HEIGHT = (5.0, 30.0)
"""Of a burst, over the standard deviation of the sensor's noise."""

PERIOD = (0.1, 0.6)
"""Shortest period of what is in a burst, s."""


def wandering(g: Generator, noise: Noise, samples: int) -> tuple[Noise, float]:
    """The noise with a random walk of each axis, and how far the walks go, over the noise."""
    wanted = log_uniform(g, *OVER_NOISE)
    # a walk of N steps goes √(N / 6) steps from its own mean, root mean square
    step = wanted * noise.sigma * math.sqrt(6.0 / samples)
    x, y, z = (Process((1.0,), step * uniform(g, 0.8, 1.25)) for _ in range(3))
    return replace(noise, kind=f"{noise.kind}, wander", walks=(x, y, z)), wanted


def bursts(g: Generator, sigma: float, samples: int, step: float) -> tuple[Float[Tensor, "N 3"], Bool[Tensor, " N"]]:
    """Fields that swell and fade in a few stretches, each way about nought: no passing dipole, which goes one path.

    Args:
        sigma: standard deviation of the sensor's noise, µT.
        samples: N.
        step: time between samples in s.

    Returns:
        The fields in µT in the sensor's axes, and where they are.
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
