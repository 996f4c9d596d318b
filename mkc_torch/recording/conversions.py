"""Units of columns: as the file says, as the caller says instead, and the numbers in this library's own."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from mkc_torch.recording.column_names import split_unit
from mkc_torch.recording.formats.base import MissingColumnError, RecordingError, Topic, listed, polars
from mkc_torch.recording.unit_words import CANONICAL, Conversion, conversion, is_unit, known_units

if TYPE_CHECKING:
    from mkc_torch.recording.choice import ColumnChoice

__all__ = ["DEFAULT_UNITS", "Units", "converted", "in_units", "quantity_of", "said_units", "units_told"]

_AXES = {"mag": "xyz", "field": "xyz", "gyro": "xyz", "accel": "xyz", "position": "xyz", "q": "wxyz"}
DEFAULT_UNITS: Mapping[str, str] = {
    f"{quantity}_{axis}" if axis else quantity: unit
    for quantity, unit in CANONICAL.items()
    for axis in _AXES.get(quantity, " ").strip() or ("",)
}
"""The units of the columns whose names have a meaning."""

_LABELLED = ("mag", "field")
"""Quantities that may be in a unit of the user's own."""


class Units(NamedTuple):
    """Units of a table's columns.

    Attributes:
        written: as the file or the caller writes them.
        conversions: of columns that are converted.
        labels: units that stay as they are written.
        asked: columns whose unit the caller says.
    """

    written: dict[str, str]
    conversions: dict[str, Conversion]
    labels: dict[str, str]
    asked: frozenset[str]

    @property
    def said(self) -> frozenset[str]:
        return frozenset(self.written)


def quantity_of(column: str) -> str | None:
    """The quantity of a column that has a name of a recording's own.

    Example:
        >>> quantity_of("mag_x"), quantity_of("time"), quantity_of("mag_status")
        ('mag', 'time', None)
    """
    return column.split("_")[0] if column in DEFAULT_UNITS else None


def said_units(choice: ColumnChoice, topic: Topic, names: Iterable[str]) -> dict[str, str]:
    """The units that a file says of columns: by its format, a row of units, or brackets behind a name."""
    told = {}
    for name in names:
        old = choice.columns.get(name, name)
        unit = choice.units.get(name) or topic.units.get(old) or split_unit(old)[1]
        if unit:
            told[name] = unit
    return told


def in_units(path: Path, names: Iterable[str], said: Mapping[str, str], given: Mapping[str, str]) -> Units:
    """What is to be done to columns so that they are in this library's units.

    Args:
        path: of the file, for messages.
        names: of the columns.
        said: units that the file says.
        given: units that the caller says, of a quantity such as mag or of one column; these win.

    Raises:
        MissingColumnError: ``given`` has neither a quantity nor a column of the file.
        RecordingError: a unit of a quantity is not known, or a vector's axes are not all in known ones.
    """
    names = list(names)
    asked: dict[str, str] = {}
    for key, unit in given.items():
        mine = [name for name in names if name == key or (quantity_of(name) == key and key in CANONICAL)]
        if not mine and key not in CANONICAL:
            raise MissingColumnError(
                f"{path}: `--unit {key}={unit}` names no column of the file and no quantity; quantities are "
                f"{', '.join(CANONICAL)}."
            )
        asked |= dict.fromkeys(mine, unit.strip())
    written = {name: unit for name, unit in {**said, **asked}.items() if name in names}
    conversions: dict[str, Conversion] = {}
    labels: dict[str, str] = {}
    for name, unit in written.items():
        quantity = quantity_of(name)
        known = None if quantity is None else conversion(quantity, unit)
        if known is not None and known.unit != CANONICAL[quantity or ""]:
            conversions[name] = known
        elif known is None:
            if quantity and quantity not in _LABELLED and name in asked:
                raise RecordingError(
                    f"{path}: `--unit {quantity}={unit}` is no unit of {quantity} that is known; known: "
                    f"{known_units(quantity)}."
                )
            if quantity != "time":  # what a time is called says less than what it holds
                labels[name] = unit
    _refuse_mixed(path, labels, names)
    return Units(written, {k: c for k, c in conversions.items() if k != "time"}, labels, frozenset(asked))


def _refuse_mixed(path: Path, labels: Mapping[str, str], names: list[str]) -> None:
    axes = [name for name in names if quantity_of(name) == "mag"]
    told = {labels.get(name, "µT") for name in axes}
    if len(told) > 1:
        raise RecordingError(
            f"{path}: the axes of the magnetometer are in different units, {', '.join(sorted(told))}, which cannot be "
            "converted to one; correct the names, or say `--unit mag=...`."
        )


def converted(series: Any, numbers: Any, known: Conversion | None) -> Any:
    """Numbers in this library's unit; of text that is a power of ten away without a rounding of its own."""
    if known is None:
        return numbers
    package = polars()
    power = known.power
    if power is None:
        return numbers * float(known.factor) + known.shift
    scaled = numbers * 10.0**power if power >= 0 else numbers / 10.0**-power
    if series.dtype != package.String:
        return scaled
    plain = series.str.strip_chars()
    exact = (plain + f"e{power}").cast(package.Float64, strict=False)
    return exact.zip_with(plain.str.contains(r"^[+-]?[\d.]+$").fill_null(False), scaled)


def units_told(units: Units, values: Mapping[str, Any]) -> list[str]:
    """Sentences about what was converted, and about units that stay."""
    told = [
        f"`{name}` and the others keep their numbers: {unit} is no unit of a magnetic field that is known; known: "
        f"{known_units('mag')}."
        for name, unit in units.labels.items()
        if name == "mag_x" and name in units.asked and not is_unit(unit)
    ]
    done: set[tuple[str, str]] = set()
    for name, known in units.conversions.items():
        quantity = quantity_of(name) or ""
        if name not in values or (quantity, known.unit) in done:
            continue
        done.add((quantity, known.unit))
        same = [one for one, other in units.conversions.items() if quantity_of(one) == quantity and other == known]
        why = "as asked for" if name in units.asked else "as the file says"
        told.append(f"{listed(same)}: converted from {known.unit}, {why}, to {CANONICAL[quantity]}.")
    return told
