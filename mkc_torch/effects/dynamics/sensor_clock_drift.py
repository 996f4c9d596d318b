"""A sensor whose clock runs fast or slow compared with the clock of the inputs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.effects.base import Effect
from mkc_torch.effects.clock import resampled
from mkc_torch.effects.context import Context, Quantity, Shape
from mkc_torch.effects.dynamics.sensor_shift import SensorShift

if TYPE_CHECKING:
    from jaxtyping import Float

RATES = (0.05, 0.125, 0.2, 0.32, 0.5, 0.75, 1.15)
"""Rates in %, fast and slow, at which the effect is screened."""

_PER_CENT = 0.01

_NAMED = 0.01
"""Share of the largest rate from which the explanation names an output."""


class SensorClockDrift(Effect):
    """The clock of an output runs at another rate than the clock of the inputs; both start together in each run.

    Simulation: adds ``y_i(t₀ + (t − t₀) / (1 + γ_i)) − y_i(t)`` to each output, where t₀ is the start of the run.
        Outputs with a common clock share one γ.
    Drivers: the outputs only; tried only on a simulation with inputs, since without inputs any rate constants of the
        simulation scale with its time, and without restarts, which follow the recording's clock.
    Units: %; positive for a clock that runs fast.
    Plausible: |γ| up to 2 %, a wrong divider of a timer or a nominal sample rate.
    Source: Mills, RFC 5905 (2010): at most 0.05 % for clocks; up to 2 % for sample rates of inertial sensors,
        Bosch BMI088 data sheet (2018).
    """

    id = "sensor_clock_drift"
    port = "output"
    needs: tuple[str, ...] = ("driven",)
    follows_signal = True
    remembers = True
    open_loop_only = True
    mistaken_for = SensorShift()
    finite_size = "tried_rate"
    form_parameters: tuple[str, ...] = ("tried_rate",)
    lower = -5.0
    upper = 5.0
    plausible = 2.0
    equation = "δy = y(t₀ + (t − t₀) / (1 + γ)) − y(t)"
    explanation = "The clock of the outputs runs at another rate than the clock of the inputs."
    advice = "Take both times from one clock, or rescale the times of the outputs."
    recurrence = "the error of drifting clocks grows with the length of a recording"
    source = "Mills, RFC 5905 (2010)"

    @property
    def simpler(self) -> Effect:
        return CommonClockDrift()

    def shapes(self, time: Float[Tensor, " N"]) -> Sequence[Shape]:
        return tuple({"tried_rate": sign * rate} for rate in RATES for sign in (1.0, -1.0))

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:
        return (Quantity("clock_rate", len(context.channels), "%"),)

    def change(self, gamma: Float[Tensor, " q"], shape: Shape, context: Context) -> Float[Tensor, "N c"]:
        rates = _PER_CENT * gamma.expand(len(context.channels))
        each = zip(context.signal.unbind(-1), rates.unbind(), strict=True)
        return torch.stack([resampled(own, context.time, rate, context.runs) - own for own, rate in each], -1)

    def code(self, gamma: Sequence[float], shape: Shape, names: Mapping[str, str]) -> tuple[str, ...]:
        rates = tuple(gamma) * (len(names) // len(gamma))
        each = zip(names.values(), rates, strict=True)
        return tuple(f"resampled({own}, time, {rate!r} / 100.0, run) - {own}" for own, rate in each)

    def explained(self, gamma: Sequence[float], shape: Shape, context: Context) -> str:
        names = [f"`{name}`" for name in context.channels]
        if len(gamma) == len(names):
            least = _NAMED * max(abs(rate) for rate in gamma)
            drifting = [(name, rate) for name, rate in zip(names, gamma, strict=True) if abs(rate) >= least]
            each = [f"the clock of output {name} runs {rate_in_words(rate)}" for name, rate in drifting]
        else:
            each = [f"the clock of outputs {in_a_list(names)} runs {rate_in_words(gamma[0])}"]
        text = in_a_list(each)
        return f"{text[0].upper()}{text[1:]} relative to the clock of the inputs."

    def advised(self, gamma: Sequence[float], shape: Shape, context: Context) -> str:
        factors = [f"{1.0 / (1.0 + _PER_CENT * rate):.7g}" for rate in gamma]
        own = [f"the times of `{name}` by {factor}" for name, factor in zip(context.channels, factors, strict=False)]
        by = in_a_list(own) if len(gamma) == len(context.channels) else f"the times of the outputs by {factors[0]}"
        return f"Take both times from one clock, or multiply, from the start of each run, {by}."


class CommonClockDrift(SensorClockDrift):
    """One clock of all outputs."""

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:
        return (Quantity("clock_rate", 1, "%"),)


def rate_in_words(rate: float) -> str:
    """A rate in % compared with another clock, below 0.01 % in parts per million.

    Example:
        >>> rate_in_words(0.503), rate_in_words(-0.002)
        ('0.503 % fast', '20 ppm slow')
    """
    size = f"{abs(rate):.3g} %" if abs(rate) >= _PER_CENT else f"{1e4 * abs(rate):.3g} ppm"
    return f"{size} {'fast' if rate >= 0.0 else 'slow'}"


def in_a_list(texts: Sequence[str]) -> str:
    """Texts with commas, and an "and" before the last.

    Example:
        >>> in_a_list(["a", "b", "c"])
        'a, b and c'
    """
    return " and ".join((", ".join(texts[:-1]), texts[-1])) if len(texts) > 1 else texts[0]
