"""Simulations by name, for files that know no more than it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mkc_torch.recording.recording import Recording
from mkc_torch.simulation.dynamics.correction import DynamicsCorrection
from mkc_torch.simulation.dynamics.definition import Dynamics
from mkc_torch.simulation.magnetometer import MagnetometerCorrection
from mkc_torch.simulation.paired import Paired, PairedCorrection
from mkc_torch.simulation.protocol import Correction, Simulation
from mkc_torch.simulation.static import Static, StaticCorrection

__all__ = ["correction_of", "refuse_unknown"]

_MAGNETOMETER = "magnetometer"


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
        ValueError: no simulation of this name corrects recordings, or the one that is given has another.
        MissingColumnError: the recording lacks a column.
    """
    refuse_unknown(name, simulation)
    if isinstance(simulation, Dynamics):
        return DynamicsCorrection(simulation, recording)
    if isinstance(simulation, Static):
        return StaticCorrection(simulation, state.get("fixed", ()), recording)
    if isinstance(simulation, Paired):
        return PairedCorrection(simulation, state["channels"], recording)
    if name != _MAGNETOMETER:
        raise ValueError(
            f'The simulation "{name}" corrects no recordings; derive it from mkc_torch.simulation.Dynamics or Static.'
        )
    return MagnetometerCorrection(state, recording)


def refuse_unknown(name: str, simulation: Simulation | None) -> None:
    """Refuses a model whose simulation is not at hand: a file of a model never says what code is run.

    Args:
        name: of the model's simulation.
        simulation: what was given.

    Raises:
        ValueError: nothing was given for a simulation of the user's own, or another one.

    Example:
        >>> refuse_unknown("Pendulum", None)
        Traceback (most recent call last):
        ValueError: the model is of the simulation "Pendulum", which is not this package's own: ...
    """
    if simulation is None and name == Paired.name:
        raise ValueError(
            "the model is of a simulator's output: give what it wrote for this recording with `--simulated SIM.csv` "
            "(in Python `simulation=Paired(...)`)."
        )
    if simulation is None and name != _MAGNETOMETER:
        raise ValueError(
            f'the model is of the simulation "{name}", which is not this package\'s own: no code is run because a '
            f"model's file names it. Give it with `--simulation FILE.py:{name}` (in Python `simulation=`)."
        )
    if simulation is not None and simulation.name != name:
        raise ValueError(f'the model is of the simulation "{name}" but "{simulation.name}" was given.')
