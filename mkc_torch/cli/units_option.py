"""The options ``--convert`` and ``--unit-label``. Parsing the pairs needs no torch."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import typer

CONVERT_METAVAR = "NAME=UNIT,..."
CONVERT_HELP = "Convert a quantity or a column from this unit: mag=gauss,time=us"
LABEL_HELP = "Label the magnetometer's unit, such as counts; nothing is converted."
SENSOR_HELP = "The magnetometer to read from a file with several; `mkc inspect` lists their names."

# the same as in mkc_torch.recording.unit_words, which cannot be imported without torch; a test compares them
QUANTITIES = ("time", "mag", "field", "gyro", "accel", "position", "temperature", "current", "q")


def parsed_units(conversions: Sequence[str], label: str | None = None) -> dict[str, str]:
    """Return the unit of each quantity or column that the options name.

    Args:
        conversions: values of ``--convert``.
        label: value of ``--unit-label``; the magnetometer's unit, which is not converted.

    Raises:
        typer.BadParameter: a part without a unit, a name given twice, a magnetic unit that cannot be converted, or a
            label that is a unit to convert.

    Example:
        >>> parsed_units(["mag=gauss,time=us", "gyro=deg/s"]), parsed_units([], "counts")
        ({'mag': 'gauss', 'time': 'us', 'gyro': 'deg/s'}, {'mag': 'counts'})
    """
    units: dict[str, str] = {}
    for part in (part for text in conversions for part in re.split(r"[,\s]+(?=\S+=)", text.strip())):
        name, equals, unit = (piece.strip() for piece in part.partition("="))
        if not (equals and name and unit):
            raise typer.BadParameter(
                f'--convert "{part}" is not NAME=UNIT; write, for example, mag=gauss. A unit that is not converted, '
                "such as counts, is given by --unit-label."
            )
        if name in units:
            raise typer.BadParameter(f"--convert gives the unit of {name} twice; keep one of them.")
        units[name] = unit.rstrip(",")
    _refuse_unknown(units)
    return units if label is None else _with_label(units, label.strip())


def reading_options(
    columns: Mapping[str, str], conversions: Sequence[str], label: str | None = None, sensor: str | None = None
) -> tuple[str, ...]:
    """Return the options with which a recording was read, for a proposed command that reads it again.

    Args:
        columns: new name to column, of ``--columns``.
        conversions, label, sensor: values of ``--convert``, ``--unit-label`` and ``--sensor``.

    Example:
        >>> reading_options({"mag_x": "mx"}, ["time=ms"], None, "mag0")
        ('--columns', 'mag_x=mx', '--convert', 'time=ms', '--sensor', 'mag0')
    """
    named = ",".join(f"{name}={column}" for name, column in columns.items())
    pairs = [("--columns", named), *(("--convert", part) for part in conversions)]
    pairs += [("--unit-label", label or ""), ("--sensor", sensor or "")]
    return tuple(word for option, value in pairs if value for word in (option, value))


def _refuse_unknown(units: dict[str, str]) -> None:
    """Refuse magnetic units that cannot be converted."""
    for quantity in {"mag", "field"} & set(units):
        from mkc_torch.recording.unit_words import conversion, known_units

        if conversion(quantity, units[quantity]) is None:
            raise typer.BadParameter(
                f"--convert {quantity}={units[quantity]} cannot be converted; known units: {known_units(quantity)}. "
                "Label the magnetometer's own unit with --unit-label."
            )


def _with_label(units: dict[str, str], label: str) -> dict[str, str]:
    if not label:
        raise typer.BadParameter("--unit-label is empty; name the unit, such as counts.")
    if "mag" in units:
        raise typer.BadParameter("--convert mag=... and --unit-label exclude each other; keep one of them.")
    from mkc_torch.recording.unit_words import conversion

    if conversion("mag", label) is not None:
        raise typer.BadParameter(f"--unit-label {label} is a unit that can be converted; give --convert mag={label}.")
    return {**units, "mag": label}


def split_trailing_pairs(recordings: Sequence[Path], conversions: Sequence[str]) -> tuple[list[Path], list[str]]:
    """Move pairs that follow ``--convert NAME=UNIT``, separated by blanks, from the recordings to the conversions.

    Example:
        >>> [list(map(str, part)) for part in split_trailing_pairs([Path("a.csv"), Path("time=us")], ["mag=gauss"])]
        [['a.csv'], ['mag=gauss', 'time=us']]
    """
    pairs = [
        path for path in recordings if re.fullmatch(rf"({'|'.join(QUANTITIES)})=\S+", str(path)) and not path.exists()
    ]
    if not conversions:
        return list(recordings), []
    return [path for path in recordings if path not in pairs], [*conversions, *map(str, pairs)]
