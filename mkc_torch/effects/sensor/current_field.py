"""The magnetic field of a current in the wiring near the sensor."""

from __future__ import annotations

from mkc_torch.effects.sensor.driver_offset import DriverOffset


class CurrentField(DriverOffset):
    """Wires that are fixed to the sensor produce a field in proportion to their current.

    Simulation: adds ``k (I − Ī)`` to the sensor's axes; the offset contains the field of the mean current Ī.
    Drivers: a column with the role current.
    Units: k in µT/A.
    Plausible: up to 20 µT/A, 1 cm from the wire; 0.1 µT/A is a good installation, and bad installations reach 70 % of
    the Earth's field at half throttle.
    Source: Biot-Savart's law, µ₀ I / (2π r).

    Example:
        >>> import torch
        >>> from mkc_torch.effects import Context
        >>> current = torch.tensor([[-1.0], [0.0], [1.0]])  # in A, less its mean
        >>> context = Context(torch.arange(3.0), current, ("A",), torch.zeros(3, 2), "µT", ("x", "y"))
        >>> CurrentField().change(torch.tensor([0.5, -2.0]), {}, context)
        tensor([[-0.5000,  2.0000],
                [ 0.0000, -0.0000],
                [ 0.5000, -2.0000]])
    """

    id = "current_field"
    display_name = "current field"
    roles = ("current",)
    gain = "field_per_ampere"
    equation = "δB = k (I − Ī)"
    explanation = "The field of a current in the wiring adds to what the sensor measures."
    advice = "Move the sensor away from the power wires, twist them, or correct with the fitted gain."
    plausible = 20.0
    plausible_unit = "µT/A"
    source = "Biot-Savart: 20 µT at 1 cm from a wire with 1 A; 0.1 µT/A is a good installation"
