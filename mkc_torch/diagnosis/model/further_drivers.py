"""Drivers of effects at outputs of simulations without a state: their inputs, and pairs of columns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import torch

from mkc_torch.diagnosis.model.term import INPUT, PAIR, Driver, find_drivers
from mkc_torch.diagnosis.settings import DriverSettings
from mkc_torch.simulation.protocol import PreparedSimulation

_MOST_PAIRED = 6
"""Largest number of columns that are paired; more columns make so many pairs that a search of all finds less."""


def further_drivers(
    prepared: PreparedSimulation, drivers: Sequence[Driver], settings: DriverSettings
) -> tuple[Driver, ...]:
    """Return the inputs of a simulation without a state as drivers, and pairs of columns.

    Differential equations have neither: there an input acts on rates, and further columns are found by further moves.

    Args:
        prepared: the simulation with its recording.
        drivers: the recording's other columns that can drive an effect.
        settings: which columns are drivers.

    Returns:
        Drivers of the role "input", then those of the role "pair".
    """
    if not any("compared" in port.parts for port in prepared.ports.values()):
        return ()
    names = [name.removeprefix("input ") for name, port in prepared.ports.items() if port.kind == "input"]
    taken = frozenset(prepared.recording.names) - frozenset(names)
    inputs = find_drivers(prepared.recording, taken, settings).drivers
    inputs = tuple(
        replace(driver, role=INPUT, units=(prepared.ports[f"input {driver.columns[0]}"].unit,))
        for driver in inputs
        if len(driver.columns) == 1  # a position acts as a vector at a sensor only
    )
    return (*inputs, *_pairs(drivers))


def _pairs(drivers: Sequence[Driver]) -> tuple[Driver, ...]:
    single = [driver for driver in drivers if len(driver.columns) == 1]
    if len(single) > _MOST_PAIRED:
        return ()
    return tuple(
        Driver(
            (*first.columns, *other.columns),
            PAIR,
            torch.cat([first.values, other.values], -1),
            torch.cat([first.reference, other.reference]),
            (*first.units, *other.units),
        )
        for first, other in combinations(single, 2)
    )
