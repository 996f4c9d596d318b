"""Units of columns: as stated by the file or the caller, and their conversion to this library's units."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from mkc_torch._support.note import Note
from mkc_torch.recording.column_names import split_unit
from mkc_torch.recording.formats.base import MissingColumnError, RecordingError, Topic, UsualUnit, listed, polars
from mkc_torch.recording.unit_words import CANONICAL, Conversion, conversion, is_unit, known_units

if TYPE_CHECKING:
    from mkc_torch.recording.choice import ColumnChoice

_AXES = {"mag": "xyz", "field": "xyz", "gyro": "xyz", "accel": "xyz", "position": "xyz", "q": "wxyz"}
DEFAULT_UNITS: Mapping[str, str] = {
    f"{quantity}_{axis}" if axis else quantity: unit
    for quantity, unit in CANONICAL.items()
    for axis in _AXES.get(quantity, " ").strip() or ("",)
}
"""Default unit of each canonical column name."""

_LABELLED = ("mag", "field")
"""Quantities that may keep an unknown unit as a label."""


class Units(NamedTuple):
    """Units of a table's columns.

    Attributes:
        written: units as stated by the file or the caller.
        conversions: conversions of the columns that are converted.
        labels: units that are kept as written.
        requested: columns whose unit the caller states.
    """

    written: dict[str, str]
    conversions: dict[str, Conversion]
    labels: dict[str, str]
    requested: frozenset[str]

    @property
    def with_stated_unit(self) -> frozenset[str]:
        """Columns whose unit the file or the caller states."""
        return frozenset(self.written)


def quantity_of(column: str) -> str | None:
    """The quantity of a column with a canonical name; None for other names.

    Example:
        >>> quantity_of("mag_x"), quantity_of("time"), quantity_of("mag_status")
        ('mag', 'time', None)
    """
    return column.split("_")[0] if column in DEFAULT_UNITS else None


def stated_units(choice: ColumnChoice, topic: Topic, names: Iterable[str]) -> dict[str, str]:
    """Units that a file states for columns: by its format, a row of units, or brackets behind a name."""
    stated = {}
    for name in names:
        old = choice.columns.get(name, name)
        unit = choice.units.get(name) or topic.units.get(old) or split_unit(old)[1]
        if unit:
            stated[name] = unit
    return stated


def in_units(path: Path, names: Iterable[str], stated: Mapping[str, str], given: Mapping[str, str]) -> Units:
    """Find the conversions that bring columns to this library's units.

    Args:
        path: path of the file, for messages.
        names: names of the columns.
        stated: units that the file states, by column.
        given: units that the caller states, by quantity (such as mag) or column; these take precedence.

    Raises:
        MissingColumnError: a key of ``given`` is neither a quantity nor a column of the file.
        RecordingError: a unit is unknown for its quantity, or the axes of a vector have incompatible units.
    """
    names = list(names)
    requested: dict[str, str] = {}
    for key, unit in given.items():
        mine = [name for name in names if name == key or (quantity_of(name) == key and key in CANONICAL)]
        if not mine and key not in CANONICAL:
            raise MissingColumnError(
                f"{path}: `--convert {key}={unit}` names no column of the file and no quantity; quantities are "
                f"{', '.join(CANONICAL)}."
            )
        requested |= dict.fromkeys(mine, unit.strip())
    written = {name: unit for name, unit in {**stated, **requested}.items() if name in names}
    conversions: dict[str, Conversion] = {}
    labels: dict[str, str] = {}
    for name, unit in written.items():
        quantity = quantity_of(name)
        known = None if quantity is None else conversion(quantity, unit)
        if known is not None and known.unit != CANONICAL[quantity or ""]:
            conversions[name] = known
        elif known is None:
            if quantity and quantity not in _LABELLED and name in requested:
                raise RecordingError(
                    f"{path}: `--convert {quantity}={unit}` is not a known unit of {quantity}; known: "
                    f"{known_units(quantity)}."
                )
            if quantity != "time":  # the values of a time determine its unit, not the label
                labels[name] = unit
    _refuse_mixed(path, labels, names)
    return Units(written, {k: c for k, c in conversions.items() if k != "time"}, labels, frozenset(requested))


def _refuse_mixed(path: Path, labels: Mapping[str, str], names: list[str]) -> None:
    axes = [name for name in names if quantity_of(name) == "mag"]
    units = {labels.get(name, "µT") for name in axes}
    if len(units) > 1:
        raise RecordingError(
            f"{path}: the axes of the magnetometer are in different units, {', '.join(sorted(units))}, which cannot be "
            "converted to a common unit; correct the column names, or give the unit, `--convert mag=...`."
        )


def converted(series: Any, numbers: Any, known: Conversion | None) -> Any:
    """Convert numbers to this library's unit; text is scaled by a power of ten without an extra rounding."""
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


def unit_conversion_warnings(units: Units, values: Mapping[str, Any]) -> list[str]:
    """Return the warnings about converted columns, and about unknown units that are kept."""
    warnings = [
        f"`{name}` and the other axes are not converted: {unit} is not a known unit of a magnetic field; known: "
        f"{known_units('mag')}."
        for name, unit in units.labels.items()
        if name == "mag_x" and name in units.requested and not is_unit(unit)
    ]
    done: set[tuple[str, str]] = set()
    for name, known in units.conversions.items():
        quantity = quantity_of(name) or ""
        if name not in values or (quantity, known.unit) in done:
            continue
        done.add((quantity, known.unit))
        same = [key for key, other in units.conversions.items() if quantity_of(key) == quantity and other == known]
        usual = isinstance(units.written[name], UsualUnit)
        why = "as the file says" if not usual else "the usual unit of this message, as the file states none"
        why = "as requested" if name in units.requested else why
        warnings.append(Note(f"{listed(same)}: converted from {known.unit}, {why}, to {CANONICAL[quantity]}."))
    return warnings
