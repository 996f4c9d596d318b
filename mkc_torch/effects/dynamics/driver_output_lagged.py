"""A recorded column that acts on an output of the simulation through a first-order lag."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from torch import Tensor

from mkc_torch.effects.context import Context, Shape
from mkc_torch.effects.dynamics.driver_output import DriverOutput
from mkc_torch.effects.waveforms import lagged

if TYPE_CHECKING:
    from jaxtyping import Float

SHARES = (0.002, 0.01, 0.05, 0.2)
"""Time constants to search, as shares of the longest run."""


class DriverOutputLagged(DriverOutput):
    """An output depends on a recorded column with a lag: a water table on a river, a gauge on its case's temperature.

    Simulation: adds ``γ (d_τ − d̄)`` to one output of differential equations, where d_τ is the column behind a
    first-order lag and d̄ its mean.
    Drivers: any column.
    Units: γ in the output's unit per unit of the column; the time constant in s.
    Plausible: any size, either sign.
    Source: interfering inputs of sensors, through a first-order lag; Doebelin, "Measurement Systems" (2003),
    2.3 and 3.3.
    """

    id = "driver_output_lagged"
    display_name = "output that depends on a column with a lag"
    continuous: Mapping[str, tuple[float, float]] = {"lag": (0.0005, 1.0 / 3.0)}
    fitted_shape: Mapping[str, tuple[float, float]] = {"lag": (0.0005, 1.0 / 3.0)}
    equation = "δy = γ (d_τ − d̄),  τ ḋ_τ = d − d_τ"
    explanation = "The measured output depends on this column with a lag."
    source = "interfering inputs of sensors, with a lag; Doebelin, Measurement Systems (2003), 2.3 and 3.3"

    def shapes(self, time: Float[Tensor, " N"]) -> Sequence[Shape]:
        length = float(time.max() - time.min())
        return tuple({"lag": share * length} for share in SHARES)

    def waveform(self, shape: Shape, context: Context) -> Float[Tensor, " N"]:
        return lagged(context.drivers[:, 0], context.time, shape.get("lag", 0.0), context.runs)

    def code(self, gamma: Sequence[float], shape: Shape, names: Mapping[str, str]) -> tuple[str, ...]:
        return (f"{gamma[0]!r} * lagged({names['driver']}, time, {shape['lag']!r})",)
