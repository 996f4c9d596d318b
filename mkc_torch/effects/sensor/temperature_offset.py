"""An offset that depends on the temperature."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from torch import Tensor

from mkc_torch.effects.context import Context, Shape
from mkc_torch.effects.sensor.driver_offset import DriverOffset
from mkc_torch.effects.waveforms import per

if TYPE_CHECKING:
    from jaxtyping import Float


class TemperatureOffset(DriverOffset):
    """The offset of the sensing element and its amplifier changes with their temperature.

    Simulation: adds ``k (T − T̄)`` to the sensor's axes, with T as recorded or behind a first-order lag, because the
    sensing element may warm up later than the thermometer; or ``k (T − T̄)(1 + c (T − T̄))``, with a small curvature.
    Drivers: a column with the role temperature.
    Units: k in µT/K, the lag in s, the curvature c in 1/K.
    Plausible: up to 5 µT/K.
    Source: data sheets of MEMS magnetometers, about 0.2 µT/K.

    Example:
        >>> import torch
        >>> from mkc_torch.effects import Context
        >>> temperature = torch.tensor([[-10.0], [0.0], [10.0]])  # in °C, less its mean
        >>> context = Context(torch.arange(3.0), temperature, ("°C",), torch.zeros(3, 1), "µT", ("x",))
        >>> TemperatureOffset().change(torch.tensor([0.2]), {}, context).squeeze(-1)
        tensor([-2.,  0.,  2.])
        >>> TemperatureOffset().change(torch.tensor([0.2]), {"curvature": 0.02}, context).squeeze(-1)
        tensor([-1.6000,  0.0000,  2.4000])
    """

    id = "temperature_offset"
    display_name = "temperature offset"
    roles = ("temperature",)
    gain = "offset_per_kelvin"
    equation = "δB = k (T − T̄) (1 + c (T − T̄))"
    explanation = "The sensor's offset changes with temperature."
    advice = "Correct with the fitted coefficient, or calibrate at the temperature of use."
    plausible = 5.0
    plausible_unit = "µT/K"
    source = "offset temperature coefficients of MEMS magnetometers, about 0.2 µT/K in data sheets"
    lags = (0.0, 1.0, 5.0)
    continuous: Mapping[str, tuple[float, float]] = {"lag": (0.0, 0.2)}

    def shapes(self, time: Float[Tensor, " N"]) -> Sequence[Shape]:
        return (*super().shapes(time), {"curvature": 0.02}, {"curvature": -0.02})

    def equation_of(self, shape: Shape, context: Context) -> str:
        if "curvature" in shape:
            return self.equation
        if shape.get("lag", 0.0) > 0.0:
            return "δB = k (T_τ − T̄),  τ dT_τ/dt = T − T_τ,  τ the lag"
        return "δB = k (T − T̄)"

    def unit_of_shape(self, name: str, context: Context) -> str:
        return per("1", context.units[0]) if name == "curvature" else super().unit_of_shape(name, context)

    def waveform(self, shape: Shape, context: Context) -> Float[Tensor, " N"]:
        linear = super().waveform(shape, context)
        return linear * (1.0 + shape.get("curvature", 0.0) * linear)
