"""Simulations by name, for files that know no more than it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mkc_torch.recording import Recording
from mkc_torch.simulation.dynamics import Dynamics, DynamicsCorrection
from mkc_torch.simulation.magnetometer import MagnetometerCorrection
from mkc_torch.simulation.protocol import Correction, Simulation

__all__ = ["correction_of"]


def correction_of(
    name: str, state: Mapping[str, Any], recording: Recording, simulation: Simulation | None = None
) -> Correction:
    """How a simulation corrects a recording.

    Args:
        name: of the simulation.
        state: of the one that was fitted.
        recording: to correct.
        simulation: a user's own.

    Raises:
        ValueError: no simulation of this name corrects recordings.
        MissingColumnError: the recording lacks a column.
    """
    if isinstance(simulation, Dynamics):
        return DynamicsCorrection(simulation, recording)
    if name != "magnetometer":
        raise ValueError(
            f'No simulation "{name}" is known that corrects recordings; known: magnetometer. A simulation of your own '
            "has to be given beside the model."
        )
    return MagnetometerCorrection(state, recording)
