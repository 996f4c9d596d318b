"""The least-squares periodogram of unevenly sampled series, and how far each frequency is above its surroundings."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from mkc_torch.effects.periodic import FEWEST_CYCLES, OVERSAMPLING

if TYPE_CHECKING:
    from jaxtyping import Float, Int

EULER = 0.5772156649
"""Minus the mean of the logarithm of a power whose mean is 1, of an exponential distribution."""

REACH = 16
"""Resolutions to either side from which the level of the noise is estimated. Wider than a resonance of moderate damping
would hide it in the level, narrower leaves too few independent powers: a standard deviation of 0.24 with 30."""

_OWN = 2
"""Resolutions to either side that hold a line's own power: its main lobe and first side lobes."""

_FEWEST = 6
"""Fewest independent powers in a level."""

_CELLS = 4_000_000
"""Numbers of a block of sinusoids."""

_ALIKE = 1e-8
"""Relative determinant of sine and cosine below which the parameters explain them."""

_NODES = 15
"""Nodes of the quadrature over the error of a level."""

_LARGEST = 300.0
"""Largest logarithm of an excess, so that its exponential is finite."""

_STEEPEST = 6.0
"""Steepest slope of a spectrum below the lowest frequency, in powers of frequency."""


def slow_basis(
    time: Float[Tensor, " N"], counts: Float[Tensor, " N"], tangents: Float[Tensor, "N p"]
) -> Float[Tensor, "N k"]:
    """Return an orthonormal basis of a simulation's tangents and of all slow courses, at the samples that count.

    Slow courses have fewer cycles than the lowest frequency: without them steep noise would leak into all frequencies.

    Args:
        time: in s.
        counts: (N,), 0 for a masked sample.
        tangents: of the simulation's own parameters.
    """
    phase = math.pi * (time - time.min()) / (time.max() - time.min())
    slow = torch.cos(phase.unsqueeze(-1) * torch.arange(2 * FEWEST_CYCLES, dtype=time.dtype))
    columns = counts.unsqueeze(-1) * torch.cat([slow, tangents], -1)
    columns = columns / torch.linalg.vector_norm(columns, dim=0).clamp(min=1e-300)
    basis, size, _ = torch.linalg.svd(columns, full_matrices=False)
    return basis[:, size > 1e-8 * size[0]]


def powers(
    time: Float[Tensor, " N"],
    counts: Float[Tensor, " N"],
    basis: Float[Tensor, "N k"],
    series: Float[Tensor, "N B"],
    frequency: Float[Tensor, " F"],
) -> Float[Tensor, "F B"]:
    """Return the squares that a sinusoid of each frequency explains of each series, next to a basis.

    The generalised Lomb-Scargle periodogram: least squares at the samples' own times, so that gaps and uneven times
    need no care.

    Args:
        time: in s.
        counts: (N,), 0 for a masked sample.
        basis: orthonormal columns that are fitted too.
        series: B of them.
        frequency: in Hz.

    Example:
        >>> time = torch.arange(40.0, dtype=torch.float64)
        >>> none = torch.zeros(40, 0, dtype=torch.float64)
        >>> wave = torch.sin(2.0 * math.pi * time / 4.0).unsqueeze(-1)
        >>> powers(time, torch.ones_like(time), none, wave, torch.tensor([0.25, 0.35]).double()).round(decimals=4)
        tensor([[20.],
                [ 0.]], dtype=torch.float64)
    """
    series = counts.unsqueeze(-1) * series
    series = series - basis @ (basis.mT @ series)
    at_once = max(_CELLS // (2 * len(time)), 1)
    found = [_power(_sinusoids(time, counts, basis, part), series) for part in frequency.split(at_once)]
    return torch.cat(found) if found else series.new_zeros(0, series.shape[1])


def without_lines(
    time: Float[Tensor, " N"],
    counts: Float[Tensor, " N"],
    basis: Float[Tensor, "N k"],
    series: Float[Tensor, "N B"],
    frequency: Float[Tensor, " B"],
) -> Float[Tensor, "N B"]:
    """Return series at the samples that count, each less the basis and the sinusoid of a frequency of its own."""
    left = counts.unsqueeze(-1) * series
    left = (left - basis @ (basis.mT @ left)).mT
    columns = torch.linalg.qr(_sinusoids(time, counts, basis, frequency).mT)[0]
    return (left - (columns @ (columns.mT @ left.unsqueeze(-1))).squeeze(-1)).mT


def _sinusoids(time: Tensor, counts: Tensor, basis: Tensor, frequency: Tensor) -> Float[Tensor, "F 2 N"]:
    phase = 2.0 * math.pi * frequency.unsqueeze(-1) * (time - time.min())
    both = counts * torch.stack([phase.cos(), phase.sin()], 1)
    flat = both.flatten(0, 1)
    return (flat - (flat @ basis) @ basis.mT).unflatten(0, (-1, 2))


def _power(both: Float[Tensor, "F 2 N"], series: Float[Tensor, "N B"]) -> Float[Tensor, "F B"]:
    inner = both @ series
    gram = both @ both.mT
    a, b, c = (gram[:, i, j].unsqueeze(-1) for i, j in ((0, 0), (0, 1), (1, 1)))
    det = a * c - b.square()
    known = det > _ALIKE * (a + c).square()
    x, y = inner[:, 0], inner[:, 1]
    explained = (c * x.square() - 2.0 * b * x * y + a * y.square()) / torch.where(known, det, 1.0)
    return torch.where(known, explained, 0.0)


def log_level(
    power: Float[Tensor, "F B"], frequency: Float[Tensor, " F"], *, own: bool = False
) -> Float[Tensor, "F B"]:
    """Return the logarithm of the mean power around each frequency: a straight line in the log of the frequency.

    The mean of logarithms hardly depends on a line among the powers.

    Args:
        power: on the grid of :func:`mkc_torch.effects.periodic.frequencies`.
        frequency: of the grid.
        own: include the frequency itself and its main lobe.

    Returns:
        The level; NaN where there are too few powers.
    """
    y = power.clamp(min=1e-300).log()
    index, inside, away = _around(frequency, own=own)
    n, sx, sxx = inside.sum(-1), away.sum(-1), away.square().sum(-1)
    weight = inside * (sxx.unsqueeze(-1) - sx.unsqueeze(-1) * away) / (n * sxx - sx.square()).unsqueeze(-1)
    value = torch.full_like(y, EULER)
    for k in range(index.shape[1]):
        value += weight[:, k].unsqueeze(-1) * y[index[:, k]]
    return torch.where((n >= _FEWEST).unsqueeze(-1), value, torch.nan)


def quiet_level(power: Float[Tensor, "F B"], frequency: Float[Tensor, " F"]) -> Float[Tensor, "F B"]:
    """Return the logarithm of the mean power of noise around each frequency, by its lower quartile.

    Lines at up to three in four of the frequencies do not raise it.
    """
    x, y = frequency.log() - frequency.log().mean(), power.clamp(min=1e-300).log()
    slope = (x @ (y - y.mean(0))) / x.square().sum()
    flat = y - x.unsqueeze(-1) * slope
    index, inside, _ = _around(frequency, own=True)
    there = torch.where((inside > 0.0).unsqueeze(-1), flat[index], torch.nan)
    # a quarter of an exponential distribution is below 0.288 of its mean
    return there.nanquantile(0.25, dim=1) - math.log(-math.log(0.75)) + x.unsqueeze(-1) * slope


def level_error(frequency: Float[Tensor, " F"]) -> Float[Tensor, " F"]:
    """Return the standard deviation of :func:`log_level` of noise: larger at the ends of the grid.

    The logarithm of a power of noise has a standard deviation of π / √6.
    """
    _, inside, away = _around(frequency, own=False)
    n, sx, sxx = inside.sum(-1), away.sum(-1), away.square().sum(-1)
    return math.pi / math.sqrt(6.0) * (sxx / (n * sxx - sx.square())).sqrt()


def _around(
    frequency: Float[Tensor, " F"], *, own: bool
) -> tuple[Int[Tensor, "F k"], Float[Tensor, "F k"], Float[Tensor, "F k"]]:
    """Return independent frequencies around each: their numbers, 1 within the grid, and distances of the logarithms."""
    nearest = 0 if own else _OWN
    offsets = [OVERSAMPLING * k for k in range(-REACH, REACH + 1) if abs(k) >= nearest]
    index = torch.arange(len(frequency)).unsqueeze(-1) + torch.tensor(offsets)
    inside = ((index >= 0) & (index < len(frequency))).to(frequency)
    index = index.clamp(0, len(frequency) - 1)
    x = frequency.log()
    return index, inside, (x[index] - x.unsqueeze(-1)) * inside


def evidence(excess: Float[Tensor, "F B"], error: Float[Tensor, " F"]) -> Float[Tensor, "F B"]:
    """Return minus the logarithm of the probability that noise has as large an excess over its level.

    A power of noise has an exponential distribution around its level, whose logarithm is known with a normal error.

    Args:
        excess: logarithm of the power over the level.
        error: standard deviation of the level's logarithm.

    Example:
        >>> evidence(torch.tensor([[3.0]]).double().log(), torch.tensor([0.0]).double()).round(decimals=3)
        tensor([[3.]], dtype=torch.float64)
    """
    at, weight = (torch.from_numpy(values) for values in np.polynomial.hermite_e.hermegauss(_NODES))
    logs = (weight / weight.sum()).log()
    total = torch.full_like(excess, -torch.inf)
    for node, share in zip(at, logs, strict=True):
        total = torch.logaddexp(total, share - (excess + error.unsqueeze(-1) * node).clamp(max=_LARGEST).exp())
    return -total


def drawn_noise(
    time: Float[Tensor, " N"],
    log_power: Float[Tensor, " F"],
    frequency: Float[Tensor, " F"],
    count: int,
    generator: torch.Generator,
) -> Float[Tensor, "N count"]:
    """Draw Gaussian noise with a given spectrum at the samples' own times, up to a common scale.

    A sum of sinusoids of twice the recording's length, so that its period does not show. Below the lowest frequency the
    spectrum continues as a power of the frequency.

    Args:
        time: in s.
        log_power: logarithm of the mean power at each frequency.
        frequency: in Hz.
        count: number of draws.
        generator: of the draws.
    """
    length = float(time.max() - time.min())
    at = torch.arange(1, max(int(2.0 * length * float(frequency[-1]) + 0.5), 2), dtype=torch.float64) / (2.0 * length)
    first = slice(0, OVERSAMPLING * REACH)
    x, y = frequency[first].log(), log_power[first]
    slope = float(((x - x.mean()) * (y - y.mean())).sum() / (x - x.mean()).square().sum().clamp(min=1e-300))
    below = (at.clamp(max=float(frequency[0])) / frequency[0]).log() * min(max(slope, -_STEEPEST), 0.0)
    place = ((at - frequency[0]) / (frequency[1] - frequency[0])).round().long().clamp(0, len(frequency) - 1)
    root = (0.5 * (log_power[place] - log_power.max() + below)).exp()
    total = time.new_zeros(len(time), count)
    at_once = max(_CELLS // len(time), 1)
    for part, size in zip(at.split(at_once), root.split(at_once), strict=True):
        phase = 2.0 * math.pi * (time - time.min()).unsqueeze(-1) * part
        drawn = torch.randn(2, len(part), count, generator=generator, dtype=torch.float64) * size.unsqueeze(-1)
        total += phase.cos() @ drawn[0] + phase.sin() @ drawn[1]
    return total


def neighbours(values: Float[Tensor, "F B"]) -> Float[Tensor, "F B"]:
    """Return the largest value within the main lobe and the first side lobes of each frequency."""
    reach = OVERSAMPLING * _OWN
    padded = torch.nn.functional.pad(values.mT, (reach, reach), value=-torch.inf)
    return padded.unfold(-1, 2 * reach + 1, 1).amax(-1).mT
