"""An output that follows a column along a bend."""

from __future__ import annotations

from mkc_torch.effects.paired.driver_linear import DriverLinear


class DriverQuadratic(DriverLinear):
    """What is measured follows a recorded column along a parabola.

    Simulation: adds ``b + k₁ (x − x̄) + k₂ (x − x̄)²`` to an output; without b where a parameter moves the zero.
    Drivers: any one column.
    Units: k in the output's unit for each unit of the column, and for each of its square; b in the output's.
    Plausible: any size.
    Source: the response to any disturbance, to second order.
    """

    id = "driver_quadratic"
    display_name = "quadratic dependence"
    equation = "δy = b + k₁ (x − x̄) + k₂ (x − x̄)²"
    explanation = "What is measured follows this column along a bend."
    advice = "Find out how the column acts on the sensor or the system; correct with the fitted curve until then."
    source = "the response to a driver, to second order"
    degree = 2
