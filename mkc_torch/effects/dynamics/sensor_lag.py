"""A sensor with a lag."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.effects.base import Effect
from mkc_torch.effects.context import Context, Quantity, Shape
from mkc_torch.effects.share import ShareEffect
from mkc_torch.effects.waveforms import lagged

if TYPE_CHECKING:
    from jaxtyping import Float

SHARES = (0.002, 0.005, 0.01, 0.02, 0.05)
"""Time constants to search, as shares of the longest run."""


class SensorLag(ShareEffect):
    """The sensor follows the measured quantity with a lag, as a thermometer in its housing does.

    Simulation: adds ``γ_i (y_τ − y)`` to each output, where y_τ is the output behind a first-order lag; γ = 1 is a pure
    lag. Identical sensors share one γ.
    Drivers: the output only.
    Units: γ is a share; the time constant in s.
    Plausible: γ from 0 to 1.
    Source: Doebelin, "Measurement Systems" (2003), 3.3.
    """

    id = "sensor_lag"
    remembers = True
    port = "output"
    needs = ()
    continuous: Mapping[str, tuple[float, float]] = {"lag": (0.0005, 0.2)}
    fitted_shape: Mapping[str, tuple[float, float]] = {"lag": (0.0005, 0.2)}
    equation = "δy = γ (y_τ − y),  τ ẏ_τ = y − y_τ"
    explanation = "The sensor follows the measured quantity with a lag."
    advice = "Put a lag of this time constant behind the output."
    source = "Doebelin, Measurement Systems (2003), 3.3"

    def shapes(self, time: Float[Tensor, " N"]) -> Sequence[Shape]:
        length = float(time.max() - time.min())
        return tuple({"lag": share * length} for share in SHARES)

    @property
    def simpler(self) -> Effect:
        return AlikeSensorLag()

    def change(self, gamma: Float[Tensor, " q"], shape: Shape, context: Context) -> Float[Tensor, "N c"]:
        behind = [lagged(output, context.time, shape["lag"], context.runs) for output in context.signal.unbind(-1)]
        return gamma * (torch.stack(behind, -1) - context.signal)

    def code(self, gamma: Sequence[float], shape: Shape, names: Mapping[str, str]) -> tuple[str, ...]:
        lag = shape["lag"]
        shares = tuple(gamma) * (len(names) // len(gamma))
        each = zip(shares, names.values(), strict=True)
        return tuple(f"{share!r} * (lagged({own}, time, {lag!r}, run) - {own})" for share, own in each)


class AlikeSensorLag(SensorLag):
    """A lag of identical sensors: one share for all outputs."""

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:
        return (Quantity(self.gain, 1, ""),)
