"""The ports that a simulation can have, from its declarations alone, without a recording."""

from __future__ import annotations

from collections.abc import Mapping

import torch

from mkc_torch.recording.recording import DEFAULT_UNITS, Recording
from mkc_torch.simulation.dynamics.definition import Dynamics
from mkc_torch.simulation.dynamics.ports import PortContext
from mkc_torch.simulation.dynamics.user_functions import check_names, kinematic
from mkc_torch.simulation.magnetometer import Magnetometer
from mkc_torch.simulation.magnetometer.view import AXES
from mkc_torch.simulation.outputs import output_ports
from mkc_torch.simulation.paired import Paired
from mkc_torch.simulation.parameter import SimulationError, known_parameters
from mkc_torch.simulation.ports import Port, SignalTimes
from mkc_torch.simulation.protocol import Simulation
from mkc_torch.simulation.static import Static, static_ports

_NOT_COMPARED = ("time", "experiment")
"""Columns of a simulator's output that are not compared."""


def declared_ports(simulation: Simulation) -> Mapping[str, Port]:
    """Return every port that a recording could give a simulation, with every part that it could have.

    What only a recording shows is assumed: all states change sign, no parameter shifts or scales an output, and an
    attitude is recorded. Only the names, units and parts of the ports are meaningful, not the sizes of their signals.

    Raises:
        SimulationError: the simulation is of another kind, which declares no states, inputs or outputs.

    Example:
        >>> class Tank(Dynamics):
        ...     states, inputs, parameters = ("level",), ("inflow",), {"drain": 0.3}
        ...
        ...     def derivative(self, time, x, u, p):
        ...         return {"level": u.inflow - p.drain * x.level}
        >>> list(declared_ports(Tank()))[2:]
        ['resonant rate of level', 'input inflow', 'parameter drain', 'output level', 'output']
    """
    if isinstance(simulation, Dynamics):
        return _of_equations(simulation)
    if isinstance(simulation, Static):
        return _of_function(simulation)
    if isinstance(simulation, Paired):
        return _of_table(simulation)
    if isinstance(simulation, Magnetometer):
        return {
            "sensor": Port(AXES, "µT"),
            "field": Port(("east", "north", "up"), "µT"),
            "heading": Port(("heading",), "°"),
        }
    raise SimulationError(f"{simulation.name} does not declare where effects can act; give a recording.")


def _of_equations(system: Dynamics) -> dict[str, Port]:
    check_names(system)
    outputs = system.outputs or system.states
    signs = torch.tensor([-1.0, 1.0], dtype=torch.float64)
    names = dict.fromkeys((*system.inputs, *outputs))
    recording = Recording({"time": signs, **dict.fromkeys(names, signs)}, units=_units(system, names))
    number = torch.arange(2)
    known = known_parameters(system.name, system.parameters)
    return PortContext(
        system=system,
        recording=recording,
        channels=outputs,
        known=known,
        kinematic=kinematic(system, known),
        guess=signs.unsqueeze(-1).expand(2, len(system.states)),
        clock=SignalTimes(signs, number, number, torch.zeros(2, dtype=torch.float64)),
        run=torch.zeros(2, dtype=torch.long),
    ).ports()


def _of_function(system: Static) -> dict[str, Port]:
    names = (*system.inputs, *system.outputs)
    units = _units(system, names)
    inputs = torch.zeros(2, len(system.inputs), dtype=torch.float64)
    outputs = torch.zeros(2, len(system.outputs), dtype=torch.float64)
    return static_ports(system, units, "", inputs, outputs, system.outputs, system.outputs)


def _of_table(simulator: Paired) -> dict[str, Port]:
    table = simulator.simulated
    names = simulator.outputs or tuple(name for name in table.names if name not in _NOT_COMPARED)
    units = {name: table.units[name] for name in names}
    return output_ports(names, units, "", table.stack(*names), names, names)


def _units(system: Dynamics | Static, names: Mapping[str, None] | tuple[str, ...]) -> dict[str, str]:
    """Return the declared units, or the defaults of the names."""
    return {name: system.units.get(name, DEFAULT_UNITS.get(name, "")) for name in names}
