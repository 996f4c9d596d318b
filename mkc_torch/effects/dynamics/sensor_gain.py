"""An error of the scale of a sensor of a simulation that steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from mkc_torch.effects.paired.gain import Gain


class SensorGain(Gain):
    """An output of a simulation that steps is a constant share larger or smaller than the recorded output.

    Simulation: adds ``γ y`` to an output y of a :class:`mkc_torch.simulation.Stepper`. Differential equations have a
        parameter for it where they need one.
    Drivers: the output only.
    Units: γ is a share.
    Plausible: |γ| up to 0.5.
    Source: see :class:`Gain`.
    """

    port = "single output"
    needs = ("own", "stepped")

    def code(self, gamma: Sequence[float], shape: Mapping[str, float], names: Mapping[str, str]) -> tuple[str, ...]:
        return (f"{gamma[0]!r} * {names['own']}",)
