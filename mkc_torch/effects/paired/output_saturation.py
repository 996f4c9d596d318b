"""Saturation of a sensor."""

from __future__ import annotations

from mkc_torch.effects.share import Saturation


class OutputSaturation(Saturation):
    """A sensor saturates at the end of its range.

    Simulation: adds ``−γ (y − clip(y, ±c))`` to an output y; γ = 1 is a hard limit.
    Drivers: the output only.
    Units: γ is a share; the shape ``limit`` in the output's unit.
    Plausible: γ from 0 to 1.
    Source: ranges in data sheets; Khalil, "Nonlinear Systems" (2002), 1.2.7.
    """

    id = "output_saturation"
    port = "output"
    needs = ("own", "compared")
    # because of noise the limit is a little below the largest measured value
    limits = (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95)
    equation = "δy = −γ (y − clip(y, ±c))"
    explanation = "The sensor saturates at the end of its range."
    advice = "Use a sensor with a wider range, or clip the simulated output there."
    recurrence = "a sensor saturates at the same value again"
