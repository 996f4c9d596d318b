"""An error of the zero of a sensor of a simulation that steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from mkc_torch.effects.paired.offset import Offset


class SensorOffset(Offset):
    """An output of a simulation that steps differs from the recorded output by a constant, as from a wrong zero.

    Simulation: adds γ to an output of a :class:`mkc_torch.simulation.Stepper`. Differential equations have a parameter
        for it where they need one.
    Drivers: none.
    Units: γ in the output's unit.
    Plausible: any size.
    Source: see :class:`Offset`.
    """

    port = "single output"
    needs = ("own", "stepped")

    def code(self, gamma: Sequence[float], shape: Mapping[str, float], names: Mapping[str, str]) -> tuple[str, ...]:
        return (f"{gamma[0]!r}",)
