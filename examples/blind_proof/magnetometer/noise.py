"""Errors of the sensor: white and coloured noise, random walks, outliers, drifts, passing sources."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Generator, Tensor

from examples.blind_proof.draws import choose, happens, log_uniform, smooth, uniform, unit_variance, whole
from examples.blind_proof.magnetometer.process import Process, autoregressive, resonance

if TYPE_CHECKING:
    from jaxtyping import Bool, Float


KINDS = ("white", "ar1", "ar2", "offset walk", "ar1 and offset walk", "ambient ar", "ambient walk")
KIND_SHARES = (0.35, 0.16, 0.12, 0.12, 0.09, 0.08, 0.08)
FAMILIES = ("gaussian", "laplace", "student")
SIGMA = (0.2, 0.8)
"""Range of the standard deviation of an axis, µT."""

CLEAN_SHARE = 0.15
"""Share of the recordings without outliers."""

MOST_OUTLIERS = 0.20


@dataclass(frozen=True)
class Noise:
    """Errors of a sensor; standard deviations in µT.

    ``white`` (three axes) is independent from sample to sample, ``axes`` adds a process to each axis and ``walks`` a
    random walk, ``ambient`` a process to the length of the field, and ``attitude`` (radians, a process on each axis of
    the world frame) turns the recorded attitude.
    """

    kind: str
    family: str
    sigma: float
    white: tuple[float, float, float]
    axes: tuple[Process, Process, Process] | None = None
    walks: tuple[Process, Process, Process] | None = None
    ambient: Process | None = None
    attitude: Process | None = None

    def numbers(self) -> dict[str, Any]:
        """Return the noise as JSON data."""
        return asdict(self)


@dataclass(frozen=True)
class Outliers:
    """Outliers: their share, the mean length of a burst (1: isolated), the side, and the sizes in sigmas."""

    share: float
    burst: float
    one_sided: bool
    sizes: tuple[float, float]


def draw_noise(g: Generator, samples: int, rate: float) -> Noise:
    """Draw a noise model for recordings of this many samples."""
    kind, family = choose(g, KINDS, KIND_SHARES), choose(g, FAMILIES)
    sigma = uniform(g, *SIGMA)
    deviations = [sigma * uniform(g, 0.8, 1.25) for _ in range(3)]
    white = (deviations[0], deviations[1], deviations[2])
    attitude = autoregressive(
        (math.exp(-1.0 / (rate * log_uniform(g, 1.0, 20.0))),), math.radians(uniform(g, 0.2, 0.5)) / math.sqrt(3.0)
    )
    step = uniform(g, 0.5, 5.0) * sigma / math.sqrt(samples)
    steps = [step * uniform(g, 0.7, 1.4) for _ in range(3)]
    walks = (Process((1.0,), steps[0]), Process((1.0,), steps[1]), Process((1.0,), steps[2]))
    if kind == "offset walk":
        return Noise(kind, family, sigma, white, walks=walks, attitude=attitude)
    if kind in ("ar1", "ar2", "ar1 and offset walk"):
        mixed = happens(g, 0.5)
        part = math.sqrt(0.5) if mixed else 1.0
        x, y, z = (_coloured(g, kind, part * deviation, family) for deviation in deviations)
        rest = (part * white[0], part * white[1], part * white[2]) if mixed else (0.0, 0.0, 0.0)
        also = walks if kind == "ar1 and offset walk" else None
        return Noise(kind, family, sigma, rest, axes=(x, y, z), walks=also, attitude=attitude)
    if kind == "ambient walk":
        return Noise(kind, family, sigma, white, ambient=Process((1.0,), step), attitude=attitude)
    if kind == "ambient ar":
        ambient = autoregressive((uniform(g, 0.5, 0.98),), sigma * uniform(g, 0.3, 1.5))
        return Noise(kind, family, sigma, white, ambient=ambient, attitude=attitude)
    return Noise(kind, family, sigma, white, attitude=attitude)


def _coloured(g: Generator, kind: str, deviation: float, family: str) -> Process:
    if kind != "ar2":
        return autoregressive((uniform(g, 0.3, 0.98),), deviation, family)
    return autoregressive(resonance(uniform(g, 0.6, 0.95), uniform(g, 0.01, 0.2)), deviation, family)


def axis_errors(g: Generator, noise: Noise, samples: int) -> Float[Tensor, "N 3"]:
    """Draw errors of the three axes in µT. The mean of a walk is removed, because it is part of the offset."""
    errors = unit_variance(g, noise.family, samples, 3) * torch.tensor(noise.white, dtype=torch.float64)
    for known in (noise.axes, noise.walks):
        if known is not None:
            errors = errors + torch.stack([_centred(process, process.sample(g, samples)) for process in known], -1)
    return errors


def ambient_errors(g: Generator, noise: Noise, samples: int) -> Float[Tensor, " N"]:
    """Draw changes of the length of the field in µT."""
    if noise.ambient is None:
        return torch.zeros(samples, dtype=torch.float64)
    return _centred(noise.ambient, noise.ambient.sample(g, samples))


def _centred(process: Process, values: Tensor) -> Tensor:
    return values - values.mean() if process.walks else values


def draw_outliers(g: Generator) -> Outliers:
    """Draw a model of outliers."""
    share = 0.0 if happens(g, CLEAN_SHARE) else uniform(g, 0.0, MOST_OUTLIERS)
    burst = 1.0 if happens(g, 0.5) else log_uniform(g, 3.0, 40.0)
    return Outliers(share, burst, happens(g, 0.5), (5.0, log_uniform(g, 10.0, 100.0)))


def contaminate(
    g: Generator, outliers: Outliers, sigma: float, directions: Float[Tensor, "N 3"]
) -> tuple[Float[Tensor, "N 3"], Float[Tensor, " N"]]:
    """Draw outliers in µT, and their mask.

    Args:
        directions: unit vectors of the field in the sensor's axes; a one-sided outlier leans towards them.
    """
    samples = len(directions)
    wanted = round(outliers.share * samples)
    mask = torch.zeros(samples, dtype=torch.bool)
    lean = torch.randn((samples, 3), generator=g, dtype=torch.float64)
    if outliers.burst > 1.0:
        while int(mask.sum()) < wanted:
            length = max(round(log_uniform(g, 0.5, 2.0) * outliers.burst), 1)
            length = min(length, wanted - int(mask.sum()))
            start = whole(g, 0, samples - length)
            mask[start : start + length] = True
            # one source, one direction
            lean[start : start + length] = lean[start].clone()
    else:
        mask[torch.randperm(samples, generator=g)[:wanted]] = True
    low, high = (math.log(size) for size in outliers.sizes)
    size = torch.exp(low + (high - low) * torch.rand(samples, generator=g, dtype=torch.float64)) * sigma
    way = torch.nn.functional.normalize(lean, dim=-1)
    if outliers.one_sided:
        way = torch.nn.functional.normalize(directions + 0.5 * way, dim=-1)
    return torch.where(mask[:, None], size[:, None] * way, 0.0), mask


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
