"""An offset that follows a recorded column: temperature, current, or one whose role is not known."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from torch import Tensor

from mkc_torch.effects.base import GainEffect
from mkc_torch.effects.context import Context, Shape
from mkc_torch.effects.courses import lagged

if TYPE_CHECKING:
    from jaxtyping import Float


class DriverOffset(GainEffect):
    """The sensor's offset is in proportion to a quantity that nothing else is known about.

    Simulation: adds ``k (x − x̄)`` to the sensor's axes; the part of the mean x̄ is in the offset.
    Drivers: a column of no known role; effects of a known role build on this one.
    Units: k in µT for each unit of the column.
    Plausible: any size.
    Source: the linear response to any small disturbance.

    Attributes:
        gain: what a user reads k as.
        lags: time constants in s that are tried, behind which the sensor follows the column.

    Example:
        >>> import torch
        >>> from mkc_torch.effects import Context
        >>> column = torch.tensor([[-2.0], [0.0], [2.0]])  # less its mean
        >>> context = Context(torch.arange(3.0), column, ("V",), torch.zeros(3, 1), "µT", ("x",))
        >>> DriverOffset().change(torch.tensor([1.5]), {}, context).squeeze(-1)
        tensor([-3.,  0.,  3.])
        >>> DriverOffset().quantities({}, context)
        (Quantity(name='offset_per_unit', size=1, unit='µT/V'),)
    """

    id = "driver_offset"
    display_name = "offset dependence"
    roles: tuple[str, ...] = ("any",)
    gain = "offset_per_unit"
    equation = "δB = k (x − x̄)"
    explanation = "The sensor's offset follows this column."
    advice = "Find out what the column stands for; correct with the fitted gain until then."
    source = "linear response, first order in the driver"
    lags: tuple[float, ...] = (0.0,)

    def shapes(self, time: Float[Tensor, " N"]) -> Sequence[Shape]:  # noqa: ARG002
        return tuple({"lag": lag} if lag else {} for lag in self.lags)

    def waveform(self, shape: Shape, context: Context) -> Float[Tensor, " N"]:
        return lagged(context.drivers[:, 0], context.time, shape.get("lag", 0.0), context.runs)
