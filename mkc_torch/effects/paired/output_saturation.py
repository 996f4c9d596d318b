"""A sensor at the end of its range."""

from __future__ import annotations

from mkc_torch.effects.share import Saturation


class OutputSaturation(Saturation):
    """Beyond the end of its range a sensor shows no more.

    Simulation: adds ``−γ (y − clip(y, ±c))`` to an output; a γ of one is a hard limit.
    Drivers: none but the output.
    Units: γ is a share; the shape ``limit`` in the output's unit.
    Plausible: γ from 0 to 1.
    Source: ranges in data sheets; Khalil, "Nonlinear Systems" (2002), 1.2.7.
    """

    id = "output_saturation"
    port = "output"
    needs = ("own", "compared")
    # what was measured at the limit is, but for noise, a little below the largest
    limits = (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95)
    equation = "δy = −γ (y − clip(y, ±c))"
    explanation = "The sensor reaches the end of its range: beyond it, it shows no more."
    advice = "Use a sensor of a wider range, or clip what is simulated there."
    recurrence = "a range ends at the same value again"
