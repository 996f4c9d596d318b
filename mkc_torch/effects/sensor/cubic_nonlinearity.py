"""A nonlinear response of a sensor at large fields."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from torch import Tensor

from mkc_torch.effects.base import Effect
from mkc_torch.effects.context import Context, Quantity, Shape

if TYPE_CHECKING:
    from jaxtyping import Float


class CubicNonlinearity(Effect):
    """The sensing element's response to the field is not linear.

    Simulation: adds ``α_i B_i³`` to each axis of the sensor, the first odd term beyond a linear response, where B is
    the simulated measurement without its offset; or ``α_i B_i³ + β_i B_i²``, where the element also measures a nearby
    magnet, an offset: the cube of the sum contains a square.
    Drivers: the field only.
    Units: α in 1/µT², β in 1/µT.
    Plausible: up to 4e-5 /µT², 10 % at 50 µT.
    Source: data sheets of AMR, Hall and TMR sensors, linearity of 0.1-1 % of full scale.

    Example:
        >>> import torch
        >>> from mkc_torch.effects import Context
        >>> field = torch.tensor([[50.0, 0.0, -25.0]])
        >>> context = Context(torch.zeros(1), torch.zeros(1, 0), (), field, "µT", ("x", "y", "z"))
        >>> CubicNonlinearity().change(torch.tensor([4e-5, 4e-5, 4e-5]), {}, context)
        tensor([[ 5.0000,  0.0000, -0.6250]])
    """

    id = "cubic_nonlinearity"
    follows_signal = True
    equation = "δB_i = α_i B_i³ (+ β_i B_i²)"
    explanation = "The sensor's response is not linear at large fields."
    advice = "Correct with the fitted coefficients; check the sensor's range setting."
    recurrence = "a nonlinear response is there at all times, wherever the field along an axis is large"
    form_parameters = ("terms",)
    plausible = 4e-5
    plausible_unit = "1/µT²"
    source = (
        "linearity of 0.1-1 % of full scale in data sheets of AMR, Hall and TMR sensors; 4e-5 /µT² are 10 % at 50 µT"
    )

    def shapes(self, time: Float[Tensor, " N"]) -> Sequence[Shape]:
        return ({}, {"terms": 2.0})

    def equation_of(self, shape: Shape, context: Context) -> str:
        return "δB_i = α_i B_i³" + (" + β_i B_i²" if "terms" in shape else "") + ",  for each axis i"

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:
        cubic = Quantity("coefficient", len(context.channels), f"1/{context.signal_unit}²")
        if "terms" not in shape:
            return (cubic,)
        return cubic, Quantity("quadratic_coefficient", len(context.channels), f"1/{context.signal_unit}")

    def change(self, gamma: Float[Tensor, " q"], shape: Shape, context: Context) -> Float[Tensor, "N c"]:
        field = context.signal
        if "terms" not in shape:
            return gamma * field.pow(3)
        cubic, quadratic = gamma.unflatten(-1, (2, -1)).unbind(-2)
        return cubic * field.pow(3) + quadratic * field.square()
