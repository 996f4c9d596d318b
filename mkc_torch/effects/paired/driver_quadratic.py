"""Quadratic dependence of an output on a column."""

from __future__ import annotations

from mkc_torch.effects.paired.driver_linear import DriverLinear


class DriverQuadratic(DriverLinear):
    """The measured output depends on a recorded column by a parabola.

    Simulation: adds ``b + k₁ (x − x̄) + k₂ (x − x̄)²`` to an output; without b where a parameter shifts the output.
    Drivers: any column.
    Units: k₁ in the output's unit per unit of the column, k₂ per square of that unit; b in the output's unit.
    Plausible: any size.
    Source: the response to any disturbance, to second order.
    """

    id = "driver_quadratic"
    display_name = "quadratic dependence"
    equation = "δy = b + k₁ (x − x̄) + k₂ (x − x̄)²"
    explanation = "The measured output depends on this column by a parabola."
    advice = "Find out how the column acts on the sensor or the system; correct with the fitted curve until then."
    source = "the response to a driver, to second order"
    degree = 2
