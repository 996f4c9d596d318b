"""From the messages of a DataFlash log, binary or text, to its topics."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from mkc_torch.recording.formats.base import Topic
from mkc_torch.recording.formats.dataflash_messages import MessageFormat, c_text, instance_column, units_of
from mkc_torch.recording.formats.topics import topic_of

__all__ = ["DEFINITIONS", "Statements", "statements", "topics_of_message"]

DEFINITIONS = frozenset({"FMT", "FMTU", "UNIT", "MULT", "PARM", "MSG", "FILE"})
"""Messages that hold no measurements."""


class Statements(NamedTuple):
    """What a log states of its units.

    Attributes:
        units, multipliers: of UNIT and MULT, by letter.
        of_messages: of FMTU, by the number of the message: a letter for each column, of its unit and of its multiplier.
    """

    units: Mapping[str, str]
    multipliers: Mapping[str, float]
    of_messages: Mapping[int, tuple[str, str]]


def statements(messages: Mapping[str, Mapping[str, list[object]]]) -> Statements:
    """The statements of a log's UNIT, MULT and FMTU messages, each given as columns; what is damaged is passed over."""

    def rows(name: str, *columns: str) -> list[tuple[object, ...]]:
        found = messages.get(name, {})
        return list(zip(*(found[column] for column in columns), strict=True)) if set(columns) <= set(found) else []

    def letter(number: object) -> str:
        return chr(int(str(number)) & 0xFF)

    return Statements(
        {letter(one): str(label).strip() for one, label in rows("UNIT", "Id", "Label")},
        {letter(one): float(str(factor)) for one, factor in rows("MULT", "Id", "Mult")},
        {
            int(str(one)): (str(unit), str(factor))
            for one, unit, factor in rows("FMTU", "FmtType", "UnitIds", "MultIds")
        },
    )


def topics_of_message(
    kind: int, message: MessageFormat, columns: Mapping[str, np.ndarray], stated: Statements
) -> list[Topic]:
    """The topic of a message, or one for each of its instances: ``BARO``, ``MAG[0]``, ``MAG[1]``.

    Args:
        kind: the number of the message, by which FMTU refers to it.
        columns: of all its rows.
    """
    unit_ids, multiplier_ids = stated.of_messages.get(kind, ("", ""))
    units = units_of(message, unit_ids, multiplier_ids, stated.units, stated.multipliers)
    instance = instance_column(message, unit_ids)
    if instance is None or instance not in columns:
        topic = topic_of(message.name, columns, units, line="message")
        return [topic] if topic else []
    cells = columns[instance]
    topics = []
    for value in np.unique(cells[~np.isnan(cells)] if cells.dtype.kind == "f" else cells).tolist():
        here = cells == value
        name = c_text(value) if isinstance(value, bytes | str) else f"{value:g}"
        chosen = {key: values[here] for key, values in columns.items()}
        topics.append(topic_of(f"{message.name}[{name}]", chosen, units, line="message"))
    return [topic for topic in topics if topic]
