"""Options that say in which form a calibration is exported, and to which sensor of a vehicle."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import typer

__all__ = ["DEVICE_ID", "INSTANCE", "KINDS", "checked_exports"]

# as in mkc_torch.calibration.exports, which loads torch: a mistake in a name is told before that
KINDS = ("px4", "ardupilot", "c-header", "ros-yaml", "json")
_NUMBERED = ("px4", "ardupilot")

INSTANCE = Annotated[
    int | None,
    typer.Option(
        metavar="N", help="The autopilot's number of the sensor, PX4 from 0, ArduPilot from 1; default: first."
    ),
]
DEVICE_ID = Annotated[
    int | None, typer.Option(metavar="ID", help="PX4's id of the sensor, for CAL_MAGn_ID; default: yours to set.")
]


def checked_exports(option: str, kinds: Sequence[str], instance: int | None, device_id: int | None) -> tuple[str, ...]:
    """The kinds, each once.

    Args:
        option: that they were given by.
        kinds: as given.
        instance, device_id: place on a vehicle.

    Raises:
        typer.BadParameter: a kind that is not known, or a place for kinds that have none.

    Example:
        >>> checked_exports("--export", ["px4", "json", "px4"], 1, None)
        ('px4', 'json')
    """
    for kind in kinds:
        if kind not in KINDS:
            raise typer.BadParameter(f'{option} "{kind}" is not known; known are {", ".join(KINDS)}.')
    for name, value, known in (("--instance", instance, _NUMBERED), ("--device-id", device_id, ("px4",))):
        if value is None:
            continue
        if value < 0:
            raise typer.BadParameter(f"{name} must be a whole number of at least 0 but is {value}.")
        if not set(kinds) & set(known):
            raise typer.BadParameter(f"{name} is for {' and '.join(known)}; name one of them with {option}.")
    return tuple(dict.fromkeys(kinds))
