"""An offset that depends on a recorded column: temperature, current, or a column of unknown role."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from torch import Tensor

from mkc_torch.effects.base import GainEffect
from mkc_torch.effects.context import Context, Shape
from mkc_torch.effects.waveforms import lagged

if TYPE_CHECKING:
    from jaxtyping import Float


class DriverOffset(GainEffect):
    """The sensor's offset depends linearly on a column of unknown meaning.

    Simulation: adds ``k (x − x̄)`` to the sensor's axes; the offset contains the contribution of the mean x̄.
    Drivers: a column of unknown role; effects of known roles derive from this class.
    Units: k in µT per unit of the column.
    Plausible: any size.
    Source: the linear response to any small disturbance.

    Attributes:
        gain: name of k in reports.
        lags: time constants in s to search, of a first-order lag of the column.

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

    def shapes(self, time: Float[Tensor, " N"]) -> Sequence[Shape]:
        return tuple({"lag": lag} if lag else {} for lag in self.lags)

    def waveform(self, shape: Shape, context: Context) -> Float[Tensor, " N"]:
        return lagged(context.drivers[:, 0], context.time, shape.get("lag", 0.0), context.runs)
