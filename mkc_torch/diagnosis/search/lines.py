"""The search for a line in the spectrum of a residual: a disturbance of a fixed, unknown period."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.diagnosis.noise.periodogram import (
    REACH,
    drawn_noise,
    evidence,
    level_error,
    log_level,
    neighbours,
    powers,
    quiet_level,
    slow_basis,
    without_lines,
)
from mkc_torch.effects.periodic import OVERSAMPLING, frequencies

if TYPE_CHECKING:
    from jaxtyping import Float, Int

_WRONG_SIGN = 2.5
"""Ratio of the amplitudes of residual and output up to which a delay of any length, or a wrong sign, can be the cause:
``|1 - exp(i phi)| <= 2``, and a quarter more for the noise in both."""

_CHANCE = math.log(3.0)
"""Logarithm of the ratio by which a line's excess in the residual has to exceed that in a signal: the level of each is
known to a quarter of its size, and three standard errors of both together are a factor of 3."""

_FALSE = 0.05
"""Expected number of lines of noise among the lines of all signals."""

_FLOOR = 1e-4
"""Level of a noise-free signal, over its mean power: lines below a millionth of its variance are rounding."""

_FIRST_DRAWS = 19
"""Draws after which the test ends if the line is no larger than theirs."""

_WIDTHS = (0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0)
"""Half-widths of a resonance of the noise, in resolutions."""

_ZOOM = 3
"""Rounds in which the frequency is refined, by a factor of 4 each."""


@dataclass(frozen=True)
class Line:
    """A line in the spectrum of a residual.

    Attributes:
        frequency: in Hz.
        channel: number of the residual's channel.
        evidence: minus the logarithm of the probability of its power in noise of the level around it, in nats.
        p_value: of the largest evidence at any frequency and in any channel.
    """

    frequency: float
    channel: int
    evidence: float
    p_value: float


@dataclass(frozen=True)
class _Spectrum:
    """The samples that count of one channel, and the signals whose lines it can repeat."""

    time: Float[Tensor, " N"]
    counts: Float[Tensor, " N"]
    basis: Float[Tensor, "N k"]
    series: Float[Tensor, " N"]
    slow: Float[Tensor, "N s"]
    own: Float[Tensor, " N"]
    signals: tuple[Float[Tensor, " N"], ...]

    @cached_property
    def frequency(self) -> Float[Tensor, " F"]:
        return frequencies(self.time)

    def powers(self, series: Float[Tensor, "N B"]) -> Float[Tensor, "F B"]:
        return powers(self.time, self.counts, self.basis, series, self.frequency)

    def evidence(self, power: Float[Tensor, "F B"]) -> Float[Tensor, "F B"]:
        """Return the evidence for a line at each frequency in nats; minus infinity where a signal can be the cause.

        An error of a linear response changes each frequency of the signal by a factor that is smooth in the frequency,
        so that the residual's line is no higher above its surroundings than the signal's. Where the simulated output
        has a line, an error of it is hardly larger than twice its amplitude, if the size of the response is right. An
        error of a nonlinear response has the frequencies of powers and signs of the signal: harmonics, sums and
        differences.
        """
        excess = power.clamp(min=1e-300).log() - log_level(power, self.frequency)
        of_signals, of_output, output_power = self._of_signals
        repeats = excess <= of_signals.unsqueeze(-1) + _CHANCE
        responds = of_output.isfinite().unsqueeze(-1) & (power <= _WRONG_SIGN**2 * output_power.unsqueeze(-1))
        found = evidence(excess, level_error(self.frequency))
        return torch.where(repeats | responds | excess.isnan(), -torch.inf, found)

    def strongest(self, series: Float[Tensor, "N B"]) -> tuple[Float[Tensor, " B"], Int[Tensor, " B"]]:
        """Return the evidence for each series' strongest line, and its frequency's number.

        The level around the strongest is that of the series without it: its side lobes would raise the level.
        """
        power = self.powers(series)
        found, place = self.evidence(power).max(0)
        left = without_lines(self.time, self.counts, self.basis, series, self.frequency[place])
        level = log_level(self.powers(left), self.frequency).gather(0, place.unsqueeze(0))[0]
        excess = power.gather(0, place.unsqueeze(0))[0].clamp(min=1e-300).log() - level
        again = evidence(excess.unsqueeze(-1), level_error(self.frequency)[place])[:, 0]
        return torch.where(found.isfinite(), again, found), place

    @cached_property
    def _of_signals(self) -> tuple[Float[Tensor, " F"], Float[Tensor, " F"], Float[Tensor, " F"]]:
        """Return the excess of signals' lines near each frequency, and excess and power of the output's.

        The excess is minus infinity where there is no line.
        """
        signals = [other for signal in (self.own, *self.signals) for other in responses(signal)]
        known = torch.stack([self.own, *self.signals, *signals], -1)
        # the parameters' tangents can span the outputs themselves
        power = powers(self.time, self.counts, self.slow, known, self.frequency)
        mean = (self.counts.unsqueeze(-1) * (known - known.mean(0)).square()).sum(0) / len(power) * OVERSAMPLING
        level = torch.maximum(quiet_level(power, self.frequency), (_FLOOR * mean).clamp(min=1e-300).log())
        excess = neighbours(power.clamp(min=1e-300).log() - level)
        least = math.log(math.log(power.numel() / OVERSAMPLING / _FALSE))
        excess = torch.where(excess > least, excess, -torch.inf)
        return excess[:, 1:].amax(-1), excess[:, 0], neighbours(power[:, :1])[:, 0]

    def nulls(self, place: int) -> list[Float[Tensor, " F"]]:
        """Return the logarithms of the spectra of noise without a line.

        The smooth level of the residual's powers, the line among them; and that of the residual less the line, with a
        resonance at the line's frequency if the powers next to it show one.
        """
        plain = log_level(self.powers(self.series.unsqueeze(-1)), self.frequency, own=True)
        frequency = self.zoomed(place)
        known = self.time, self.counts, self.basis, self.series.unsqueeze(-1)
        left = without_lines(*known, torch.tensor([frequency], dtype=torch.float64))
        power = self.powers(left)
        rest = log_level(power, self.frequency, own=True)
        line = float(powers(*known, torch.tensor([frequency], dtype=torch.float64)))
        resonance = _resonance(power[:, 0], rest[:, 0], self.frequency, frequency, line)
        return [plain[:, 0], rest[:, 0] + resonance]

    def zoomed(self, place: int) -> float:
        """Return the frequency of the largest power near a frequency of the grid."""
        step, found = float(self.frequency[1] - self.frequency[0]), float(self.frequency[place])
        for _ in range(_ZOOM):
            near = found + step * torch.linspace(-1.0, 1.0, 9, dtype=torch.float64)
            power = powers(self.time, self.counts, self.basis, self.series.unsqueeze(-1), near)
            found, step = float(near[int(power[:, 0].argmax())]), 0.25 * step
        return found


def line_of(
    time: Float[Tensor, " N"],
    values: Float[Tensor, "N m"],
    counts: Float[Tensor, "N m"],
    tangents: Float[Tensor, "N m p"],
    outputs: Float[Tensor, "N m"],
    signals: Sequence[Float[Tensor, " N"]],
    *,
    draws: int,
    generator: torch.Generator,
) -> Line | None:
    """Return the line of a residual with the most evidence against the noise around it; None without a possible line.

    The maximum over all frequencies and channels is compared with the same maximum of noise without a line. A
    frequency at which a signal has a line itself is left out: an error of the simulation's response to it looks alike.

    Args:
        time: in s, ascending; None is returned where it is not, for runs with clocks of their own.
        values: the residual.
        counts: 0 for a masked value.
        tangents: of the simulation's own parameters.
        outputs: the simulated outputs.
        signals: the inputs and the recorded drivers.
        draws: number of draws of each kind of noise; 0 for a bound of the p-value by independent frequencies.
        generator: of the draws.

    Returns:
        The line. Its p-value is the largest of those of two kinds of noise and of independent frequencies in noise of
        a known level; the latter alone where it is above a half.
    """
    if bool((time.diff() < 0.0).any()) or len(frequencies(time)) < OVERSAMPLING * REACH:
        return None
    spectra = [
        _Spectrum(
            time,
            counts[:, k],
            slow_basis(time, counts[:, k], tangents[:, k]),
            counts[:, k] * values[:, k],
            slow_basis(time, counts[:, k], tangents[:, k, :0]),
            outputs[:, k],
            tuple(signals),
        )
        for k in range(values.shape[1])
    ]
    found = [spectrum.strongest(spectrum.series.unsqueeze(-1)) for spectrum in spectra]
    channel = max(range(len(found)), key=lambda k: float(found[k][0]))
    largest, place = float(found[channel][0]), int(found[channel][1])
    if not math.isfinite(largest):
        return None
    frequency = spectra[channel].zoomed(place)
    expected = sum(len(spectrum.frequency) for spectrum in spectra) / OVERSAMPLING * math.exp(-largest)
    if expected > math.log(2.0) or not draws:
        return Line(frequency, channel, largest, min(expected, 1.0))
    kinds = [spectrum.nulls(int(found[k][1])) for k, spectrum in enumerate(spectra)]
    p_values = [_p_value(spectra, null, largest, draws, generator) for null in zip(*kinds, strict=True)]
    return Line(frequency, channel, largest, max(expected, *p_values))


def responses(signal: Float[Tensor, " N"]) -> tuple[Float[Tensor, " N"], ...]:
    """Return nonlinear functions of a signal, which have the frequencies that nonlinear responses to it have.

    Square and cube stand for smooth responses, the sign for dead zones and stops, the sign of the rate for friction and
    backlash.

    Example:
        >>> [values.tolist() for values in responses(torch.tensor([-1.0, 0.0, 1.0]))]
        [[1.0, 0.0, 1.0], [-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0], [1.0, 1.0, 1.0]]
    """
    away = signal - signal.mean()
    return away.square(), away**3, away.sign(), torch.gradient(away)[0].sign()


def _p_value(
    spectra: Sequence[_Spectrum],
    null: Sequence[Float[Tensor, " F"]],
    largest: float,
    draws: int,
    generator: torch.Generator,
) -> float:
    """Return the share of draws whose largest evidence over frequencies and channels is as large."""
    as_large = total = 0
    for count in (min(_FIRST_DRAWS, draws), draws - min(_FIRST_DRAWS, draws)):
        if not count:
            break
        found = []
        for spectrum, log_power in zip(spectra, null, strict=True):
            noise = drawn_noise(spectrum.time, log_power, spectrum.frequency, count, generator)
            scale = spectrum.series.square().sum() / (spectrum.counts.unsqueeze(-1) * noise).square().sum(0)
            found.append(spectrum.strongest(scale.sqrt() * noise)[0])
        as_large += int((torch.stack(found).amax(0) >= largest).sum())
        total += count
        if as_large > 0.2 * total:
            break
    return (1 + as_large) / (1 + total)


def _resonance(
    power: Float[Tensor, " F"],
    level: Float[Tensor, " F"],
    frequency: Float[Tensor, " F"],
    center: float,
    line: float,
) -> Float[Tensor, " F"]:
    """Return the logarithm of a resonance of the noise in place of a line; 0 where a line is more likely.

    Resonances are Lorentzians, compared by Whittle's likelihood with a line whose power is free.

    Args:
        power, level: of the residual less the line; the level is a logarithm.
        frequency: of the grid.
        center: frequency of the line.
        line: power of the line.
    """
    step = float(frequency[1] - frequency[0]) * OVERSAMPLING
    first = round((center - float(frequency[0])) / step * OVERSAMPLING)
    index = first + OVERSAMPLING * torch.tensor([k for k in range(-REACH, REACH + 1) if k])
    index = index[(index >= 0) & (index < len(frequency))]
    there, base = power[index], level[index].exp()
    own = level[min(max(first, 0), len(frequency) - 1)].exp()
    width, offset, height = torch.meshgrid(
        step * torch.tensor(_WIDTHS, dtype=torch.float64),
        torch.linspace(-1.0, 1.0, 9, dtype=torch.float64),
        torch.logspace(-0.5, 5.0, 34, dtype=torch.float64),
        indexing="ij",
    )
    width, offset, height = width.flatten(), offset.flatten(), height.flatten()
    middle = center + offset * width

    def shape(at: Tensor) -> Float[Tensor, "H n"]:
        away = (at - middle.unsqueeze(-1)) / width.unsqueeze(-1)
        return torch.log1p(height.unsqueeze(-1) / (1.0 + away.square()))

    mean = base * shape(frequency[index]).exp()
    ratio = there / mean
    scale = ratio.mean(-1, keepdim=True)
    at_line = own * scale[:, 0] * shape(torch.tensor([center], dtype=torch.float64))[:, 0].exp()
    value = -(mean.log() + scale.log() + ratio / scale).sum(-1) - at_line.log() - line / at_line
    # the line is the largest of the independent powers within the resonance
    value += (math.pi * width / step).clamp(min=1.0).log()
    alone = (there / base).mean()
    plain = -float((base.log() + alone.log() + there / base / alone).sum()) - math.log(line) - 1.0
    best = int(value.argmax())
    if not float(value[best]) > plain:
        return torch.zeros_like(frequency)
    return shape(frequency)[best]
