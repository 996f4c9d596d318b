"""Options for the format of an export and the sensor of the vehicle that it is for."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import typer

# the same as in mkc_torch.calibration.exports, which imports torch; a wrong name is reported before that import
KINDS = ("px4", "ardupilot", "c-header", "ros-yaml", "imu-calib", "json")
_NUMBERED = ("px4", "ardupilot")

INSTANCE = Annotated[
    int | None,
    typer.Option(
        metavar="N", help="Number of the sensor on the autopilot: PX4 from 0, ArduPilot from 1; default: the first."
    ),
]
DEVICE_ID = Annotated[
    int | None,
    typer.Option(metavar="ID", help="Device id of the sensor for CAL_MAGn_ID of PX4; default: none."),
]


def checked_exports(option: str, kinds: Sequence[str], instance: int | None, device_id: int | None) -> tuple[str, ...]:
    """Return the export formats without duplicates.

    Args:
        option: name of the option, for messages.
        kinds: names of the formats.
        instance, device_id: the sensor on the vehicle.

    Raises:
        typer.BadParameter: an unknown format, or a sensor number for formats that have none.

    Example:
        >>> checked_exports("--export", ["px4", "json", "px4"], 1, None)
        ('px4', 'json')
    """
    for kind in kinds:
        if kind not in KINDS:
            raise typer.BadParameter(f'{option} "{kind}" is unknown; choose from {", ".join(KINDS)}.')
    for name, value, known in (("--instance", instance, _NUMBERED), ("--device-id", device_id, ("px4",))):
        if value is None:
            continue
        if value < 0:
            raise typer.BadParameter(f"{name} must be an integer of at least 0 but is {value}.")
        if not set(kinds) & set(known):
            raise typer.BadParameter(f"{name} is only for {' and '.join(known)}; choose such a format with {option}.")
    return tuple(dict.fromkeys(kinds))
