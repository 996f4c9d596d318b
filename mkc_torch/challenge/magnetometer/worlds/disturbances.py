"""What disturbs a magnetometer without being physics to name: an offset that wanders, and sources that come by."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Generator, Tensor

from mkc_torch.challenge.draws import direction, log_uniform, uniform, whole
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


def wandering(g: Generator, noise: Noise, samples: int) -> tuple[Noise, float]:
    """The noise with a random walk of each axis, and how far the walks go, over the noise."""
    wanted = log_uniform(g, *OVER_NOISE)
    # a walk of N steps goes √(N / 6) steps from its own mean, root mean square
    step = wanted * noise.sigma * math.sqrt(6.0 / samples)
    x, y, z = (Process((1.0,), step * uniform(g, 0.8, 1.25)) for _ in range(3))
    return replace(noise, kind=f"{noise.kind}, wander", walks=(x, y, z)), wanted


def bursts(g: Generator, sigma: float, samples: int) -> tuple[Float[Tensor, "N 3"], Bool[Tensor, " N"]]:
    """Fields of sources that come and go in a few stretches, µT in the sensor's axes, and where they are."""
    field, mask = torch.zeros(samples, 3, dtype=torch.float64), torch.zeros(samples, dtype=torch.bool)
    for _ in range(whole(g, *BURSTS)):
        length = max(round(uniform(g, *BURST) * samples), 3)
        start = whole(g, 0, samples - length)
        rise = torch.sin(math.pi * (torch.arange(length, dtype=torch.float64) + 0.5) / length)
        field[start : start + length] += log_uniform(g, *HEIGHT) * sigma * rise[:, None] * direction(g)
        mask[start : start + length] = True
    return field, mask
