"""An actuator at its limit."""

from __future__ import annotations

from mkc_torch.effects.share import Saturation


class InputSaturation(Saturation):
    """Beyond a limit the actuator gives no more.

    Simulation: adds ``−γ (u − clip(u, ±c))`` to an input; a γ of one is a hard limit.
    Drivers: none but the input.
    Units: γ is a share; the shape ``limit`` in the unit of what it is of.
    Plausible: γ from 0 to 1.
    Source: Khalil, "Nonlinear Systems" (2002), 1.2.7.
    """

    id = "input_saturation"
    limits = (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
    equation = "δu = −γ (u − clip(u, ±c))"
    explanation = "The actuator reaches its limit: beyond it, a larger command has no more effect."
    advice = "Limit the input to this size."
