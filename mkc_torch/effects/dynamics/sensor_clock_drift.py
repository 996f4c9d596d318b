"""A sensor whose clock runs fast or slow compared with the clock of the inputs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.effects.base import Effect
from mkc_torch.effects.clock import resampled
from mkc_torch.effects.context import Context, Quantity, Shape

if TYPE_CHECKING:
    from jaxtyping import Float

RATES = (0.0005, 0.00125, 0.002, 0.0032, 0.005, 0.0075, 0.0115)
"""Rates, fast and slow, from which the effect is searched."""


class SensorClockDrift(Effect):
    """The clock of an output runs at another rate than the clock of the inputs; both start together in each run.

    Simulation: adds ``y_i(t₀ + (t − t₀) / (1 + γ_i)) − y_i(t)`` to each output, where t₀ is the start of the run.
        Outputs with a common clock share one γ.
    Drivers: the outputs only; tried only on a simulation with inputs, since without inputs any rate constants of the
        simulation scale with its time.
    Units: γ is a share: 10⁻⁶ is one part per million; positive for a clock that runs fast.
    Plausible: |γ| up to 0.02, a wrong divider of a timer or a nominal sample rate.
    Source: Mills, RFC 5905 (2010): at most 5·10⁻⁴ for clocks; up to 0.02 for sample rates of inertial sensors,
        Bosch BMI088 data sheet (2018).
    """

    id = "sensor_clock_drift"
    port = "output"
    needs: tuple[str, ...] = ("driven",)
    follows_signal = True
    remembers = True
    open_loop_only = True
    finite_size = "tried_rate"
    form_parameters: tuple[str, ...] = ("tried_rate",)
    plausible = 0.02
    lower = -0.05
    upper = 0.05
    equation = "δy = y(t₀ + (t − t₀) / (1 + γ)) − y(t)"
    explanation = "The clock of the outputs runs at another rate than the clock of the inputs."
    advice = "Take both times from one clock, or rescale the times of the outputs."
    recurrence = "the error of drifting clocks grows with the length of a recording"
    source = "Mills, RFC 5905 (2010)"

    def shapes(self, time: Float[Tensor, " N"]) -> Sequence[Shape]:
        return tuple({"tried_rate": sign * rate} for rate in RATES for sign in (1.0, -1.0))

    @property
    def simpler(self) -> Effect:
        return CommonClockDrift()

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:
        return (Quantity("rate", len(context.channels), ""),)

    def change(self, gamma: Float[Tensor, " q"], shape: Shape, context: Context) -> Float[Tensor, "N c"]:
        each = zip(context.signal.unbind(-1), _per_output(gamma, len(context.channels)), strict=True)
        return torch.stack([resampled(own, context.time, rate, context.runs) - own for own, rate in each], -1)

    def code(self, gamma: Sequence[float], shape: Shape, names: Mapping[str, str]) -> tuple[str, ...]:
        rates = tuple(gamma) * (len(names) // len(gamma))
        each = zip(names.values(), rates, strict=True)
        return tuple(f"resampled({own}, time, {rate!r}, run) - {own}" for own, rate in each)

    def explained(self, gamma: Sequence[float], shape: Shape, context: Context) -> str:
        names = [f"`{name}`" for name in context.channels]
        if len(gamma) == 1:
            several = "s" if len(names) > 1 else ""
            return f"The clock of output{several} {_listed(names)} runs {rate_in_words(gamma[0])} beside the inputs' clock."
        each = [f"of {name} {rate_in_words(rate)}" for name, rate in zip(names, gamma, strict=True)]
        return f"The clocks of the outputs run beside the inputs' clock: {_listed(each)}."

    def advised(self, gamma: Sequence[float], shape: Shape, context: Context) -> str:
        factors = [f"{1.0 / (1.0 + rate):.7g}" for rate in gamma]
        of = "" if len(gamma) == 1 else f" of {_listed([f'`{name}`' for name in context.channels])}"
        return f"Take both times from one clock, or multiply the times{of} since the start of each run by {_listed(factors)}."


class CommonClockDrift(SensorClockDrift):
    """One clock of all outputs."""

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:
        return (Quantity("rate", 1, ""),)


def rate_in_words(rate: float) -> str:
    """A clock's rate compared with another clock.

    Example:
        >>> rate_in_words(0.00503), rate_in_words(-0.00002)
        ('0.503 % fast', '20 ppm slow')
    """
    size = f"{abs(1e6 * rate):.3g} ppm" if abs(rate) < 1e-4 else f"{abs(100.0 * rate):.3g} %"
    return f"{size} {'fast' if rate >= 0.0 else 'slow'}"


def _per_output(gamma: Float[Tensor, " q"], count: int) -> tuple[Tensor, ...]:
    return (gamma if len(gamma) == count else gamma.expand(count)).unbind()


def _listed(words: Sequence[str]) -> str:
    return " and ".join((", ".join(words[:-1]), words[-1])) if len(words) > 1 else words[0]
