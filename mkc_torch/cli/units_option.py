"""The option ``--unit``: units of the magnetometer, or of any quantity; nothing here needs torch."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import typer

__all__ = ["HELP", "METAVAR", "QUANTITIES", "SENSOR_HELP", "parsed_units", "without_units"]

METAVAR = "UNIT or QUANTITY=UNIT,..."
HELP = (
    "Units that are converted: mag=gauss,time=us. One that is not known, such as counts, is the magnetometer's label."
)
SENSOR_HELP = "Which magnetometer, where a file holds several, as `mkc inspect` names them; accel: the accelerometer."

# those of mkc_torch.recording.unit_words, which cannot be imported without torch; a test holds them together
QUANTITIES = ("time", "mag", "field", "gyro", "accel", "position", "temperature", "current", "q")


def parsed_units(texts: Sequence[str]) -> dict[str, str]:
    """Units by quantity or column; one without a quantity is the magnetometer's.

    Raises:
        typer.BadParameter: a part without a unit, or a quantity given twice.

    Example:
        >>> parsed_units(["mag=gauss,time=us", "gyro=deg/s"]), parsed_units(["counts"])
        ({'mag': 'gauss', 'time': 'us', 'gyro': 'deg/s'}, {'mag': 'counts'})
    """
    units: dict[str, str] = {}
    for text in texts:
        parts = re.split(r"[,\s]+(?=\S+=)", text.strip()) if "=" in text else [text]
        for part in parts:
            name, equals, unit = (piece.strip() for piece in part.partition("="))
            if not equals:
                name, unit = "mag", name
            if not (name and unit):
                raise typer.BadParameter("--unit is empty; name the unit, such as counts, or mag=gauss.")
            if name in units:
                raise typer.BadParameter(f"--unit says the unit of {name} twice.")
            units[name] = unit.rstrip(",")
    return units


def without_units(recordings: Sequence[Path], texts: Sequence[str]) -> tuple[list[Path], list[str]]:
    """Recordings, and units that were written after the first one without the option's name before them.

    Example:
        >>> [list(map(str, part)) for part in without_units([Path("a.csv"), Path("time=us")], ["mag=gauss"])]
        [['a.csv'], ['mag=gauss', 'time=us']]
    """
    units = [
        path for path in recordings if re.fullmatch(rf"({'|'.join(QUANTITIES)})=\S+", str(path)) and not path.exists()
    ]
    if not texts:
        return list(recordings), []
    return [path for path in recordings if path not in units], [*texts, *map(str, units)]
