"""The options that name a simulation and the columns of a recording, checked together. This file needs no torch."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import typer

from mkc_torch.cli.console import parsed_columns, parsed_pairs
from mkc_torch.cli.diagnosis_request import (
    INPUT_HOLDS,
    MAGNETOMETER,
    SIMULATIONS,
    is_file_of_a_simulation,
    is_model_of_mujoco,
)
from mkc_torch.cli.units_option import parsed_units

OWN_SIMULATION = (
    "FILE.py:CLASS, FILE.py with a single class, MODEL.fmu, or a model of MuJoCo, MODEL.xml or MODEL.urdf. The code in "
    "the file is run."
)
"""The forms of ``--simulation`` that name a file, for its help."""

COLUMNS_METAVAR = "NAME=COLUMN,..."
COLUMNS_HELP = "Names of the columns in the file: mag_x=mx,temperature=IMU_T"
INPUT_HOLD_HELP = f"Known course of an input between samples: {', '.join(INPUT_HOLDS)}."
SIZES_OF_HELP = "Diagnosed recording whose sizes apply, where a size differs between recordings."
FIT_HELP = (
    "Numbers of a model of MuJoCo to fit: joint:*.damping,actuator:*.kp; default: damping, armature, frictionloss, kp "
    "and kv that the file gives."
)
ALL, EACH = "all", "each"

MOST_TOGETHER = 2
"""Number of measured joints up to which all of them are simulated at once unless the user decides."""

JOINTS_HELP = (
    "Joints of a model of MuJoCo that are simulated at once, while the others follow their recorded positions: "
    f"pan,lift; {ALL}; or {EACH}, one after the other (default for more than {MOST_TOGETHER} measured joints)."
)

RUN_COLUMN_HELP = "Column that separates the runs of a table; default: experiment, if any."


def checked_simulation(simulation: str | None, simulator_output: Path | None) -> str:
    """Return the value of ``--simulation``; empty without it.

    Raises:
        typer.BadParameter: the simulation is unknown, or ``--simulator-output`` is given as well.

    Example:
        >>> checked_simulation("pendulum.py:Pendulum", None), checked_simulation(None, Path("simulated.csv"))
        ('pendulum.py:Pendulum', '')
    """
    if simulation is not None and simulator_output is not None:
        raise typer.BadParameter(
            "give one of --simulation and --simulator-output: a simulation, or the table that a simulator wrote."
        )
    if simulation is not None and simulation not in SIMULATIONS and not is_file_of_a_simulation(simulation):
        raise typer.BadParameter(
            f'--simulation "{simulation}" is unknown; give {", ".join(SIMULATIONS)}, or your own simulation as '
            "FILE.py:CLASS, MODEL.fmu or MODEL.xml."
        )
    return simulation or ""


def checked_columns(columns: str | None, run_column: str | None) -> dict[str, str]:
    """Return the column in the file by name, from ``--columns`` and ``--run-column``.

    Raises:
        typer.BadParameter: a part is not a pair, ``--run-column`` is empty, or the options disagree.

    Example:
        >>> checked_columns("angle=phi", "trial")
        {'angle': 'phi', 'experiment': 'trial'}
    """
    names = parsed_columns(columns)
    if run_column is None:
        return names
    if not run_column.strip():
        raise typer.BadParameter("--run-column is empty; name the column that separates the runs.")
    if names.setdefault("experiment", run_column.strip()) != run_column.strip():
        raise typer.BadParameter("--columns and --run-column name different columns for experiment; leave one out.")
    return names


def parsed_fit(texts: Sequence[str], simulation: str | None) -> tuple[str, ...]:
    """Return the patterns of the numbers to fit, from ``--fit``.

    Raises:
        typer.BadParameter: the simulation is no model of MuJoCo, or a part is empty.

    Example:
        >>> parsed_fit(["joint:*.damping,actuator:*.kp"], "arm.xml")
        ('joint:*.damping', 'actuator:*.kp')
    """
    parts = tuple(part.strip() for text in texts for part in text.split(","))
    if parts and not is_model_of_mujoco(simulation or ""):
        raise typer.BadParameter("--fit applies to a model of MuJoCo, MODEL.xml or MODEL.urdf; leave it out.")
    if not all(parts):
        raise typer.BadParameter("--fit has an empty part; write --fit joint:*.damping,actuator:*.kp.")
    return parts


def parsed_joints(text: str | None, simulation: str | None) -> tuple[str, ...]:
    """Return the names in ``--joints``; empty without it.

    Raises:
        typer.BadParameter: the simulation is no model of MuJoCo, or a name is empty.

    Example:
        >>> parsed_joints("pan, lift", "arm.xml"), parsed_joints(None, "arm.fmu")
        (('pan', 'lift'), ())
    """
    if text is None:
        return ()
    if not is_model_of_mujoco(simulation or ""):
        raise typer.BadParameter("--joints applies to a model of MuJoCo, MODEL.xml or MODEL.urdf; leave it out.")
    names = tuple(part.strip() for part in text.split(","))
    if not all(names):
        raise typer.BadParameter(f"--joints has an empty part; write --joints pan,lift, {ALL} or {EACH}.")
    return names


def checked_units(conversions: list[str], label: str | None, simulation: str | None) -> dict[str, str]:
    """Return the unit by quantity or column, from ``--convert`` and ``--unit-label``.

    Raises:
        typer.BadParameter: a unit is not understood, or a magnetometer's unit is given for another simulation.

    Example:
        >>> checked_units(["time=us"], None, "pendulum.py:Pendulum")
        {'time': 'us'}
    """
    units = parsed_units(conversions, label)
    if "mag" in units and simulation not in (None, MAGNETOMETER):
        raise typer.BadParameter(
            "--unit-label and --convert mag=... apply to a magnetometer. Your own simulation declares its units in "
            "`units`; its time and its columns can be converted by name: --convert time=us."
        )
    return units


def checked_sensor(sensor: str | None, simulation: str | None) -> str | None:
    """Return the value of ``--sensor``.

    Raises:
        typer.BadParameter: the simulation is not the magnetometer.

    Example:
        >>> checked_sensor("mag0", "magnetometer")
        'mag0'
    """
    if sensor is not None and simulation not in (None, MAGNETOMETER):
        raise typer.BadParameter("--sensor names a magnetometer; your own simulation takes columns by name.")
    return sensor


def checked_input_hold(texts: list[str]) -> dict[str, str]:
    """Return the hold by input, from ``--input-hold``. The names are checked when the simulation is loaded.

    Raises:
        typer.BadParameter: a part is not a pair, or the hold is unknown.

    Example:
        >>> checked_input_hold(["torque=held"])
        {'torque': 'held'}
    """
    pairs = parsed_pairs("--input-hold", texts, "torque=held")
    for name, hold in pairs.items():
        if hold not in INPUT_HOLDS:
            raise typer.BadParameter(f'--input-hold {name}="{hold}" is unknown; known: {", ".join(INPUT_HOLDS)}.')
    return pairs
