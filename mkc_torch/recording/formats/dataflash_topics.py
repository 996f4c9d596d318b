"""Convert the messages of a DataFlash log, binary or text, to topics."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from mkc_torch.recording.formats.base import Topic, is_number
from mkc_torch.recording.formats.compass_parameters import compass_correction
from mkc_torch.recording.formats.dataflash_messages import MessageFormat, c_text, instance_column, units_of
from mkc_torch.recording.formats.topics import topic_of

DEFINITIONS = frozenset({"FMT", "FMTU", "UNIT", "MULT", "PARM", "MSG", "FILE"})
"""Messages that hold no measurements."""


class Statements(NamedTuple):
    """Units and multipliers that a log states.

    Attributes:
        units, multipliers: contents of UNIT and MULT, by letter.
        of_messages: contents of FMTU by message number: the letters of the columns' units and multipliers.
        parameters: contents of PARM: each parameter's different values, in the order of the log.
    """

    units: Mapping[str, str]
    multipliers: Mapping[str, float]
    of_messages: Mapping[int, tuple[str, str]]
    parameters: Mapping[str, list[float]]


def statements(messages: Mapping[str, Mapping[str, list[object]]]) -> Statements:
    """Collect a log's UNIT, MULT, FMTU and PARM messages, given as columns; damaged messages are skipped."""

    def rows(name: str, *columns: str) -> list[tuple[object, ...]]:
        found = messages.get(name, {})
        return list(zip(*(found[column] for column in columns), strict=True)) if set(columns) <= set(found) else []

    def letter(number: object) -> str:
        return chr(int(str(number)) & 0xFF)

    parameters: dict[str, list[float]] = {}
    for key, value in rows("PARM", "Name", "Value"):
        values = parameters.setdefault(str(key).strip(), [])
        if is_number(str(value)) and float(str(value)) not in values[-1:]:
            values.append(float(str(value)))
    return Statements(
        {letter(key): str(label).strip() for key, label in rows("UNIT", "Id", "Label")},
        {letter(key): float(str(factor)) for key, factor in rows("MULT", "Id", "Mult")},
        {
            int(str(key)): (str(unit), str(factor))
            for key, unit, factor in rows("FMTU", "FmtType", "UnitIds", "MultIds")
        },
        {name: values for name, values in parameters.items() if values},
    )


def topics_of_message(
    kind: int, message: MessageFormat, columns: Mapping[str, np.ndarray], stated: Statements
) -> list[Topic]:
    """The topic of a message, or a topic for each of its instances: ``BARO``, ``MAG[0]``, ``MAG[1]``.

    Args:
        kind: the message number, by which FMTU refers to the message.
        message: its format.
        columns: name to values of all its rows.
        stated: units that the log states.
    """
    unit_ids, multiplier_ids = stated.of_messages.get(kind, ("", ""))
    units = units_of(message, unit_ids, multiplier_ids, stated.units, stated.multipliers)
    instance = instance_column(message, unit_ids)
    if instance is None or instance not in columns:
        return _topics(message.name, columns, units, stated)
    cells = columns[instance]
    topics: list[Topic] = []
    for value in np.unique(cells[~np.isnan(cells)] if cells.dtype.kind == "f" else cells).tolist():
        here = cells == value
        name = c_text(value) if isinstance(value, bytes | str) else f"{value:g}"
        chosen = {key: values[here] for key, values in columns.items()}
        topics += _topics(f"{message.name}[{name}]", chosen, units, stated)
    return topics


def _topics(name: str, columns: Mapping[str, np.ndarray], units: Mapping[str, str], stated: Statements) -> list[Topic]:
    """The topic of these columns in a list; empty if no column holds numbers."""
    topic = topic_of(name, columns, units, line="message")
    return [topic._replace(correction=compass_correction(name, columns, stated.parameters))] if topic else []
