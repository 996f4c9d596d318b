"""Split a table whose rows come from several sensors, named by a column, into a table for each sensor."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

from mkc_torch._support.note import Note
from mkc_torch.recording.column_names import is_about_magnetometer, meaning
from mkc_torch.recording.formats.base import Table, Topic, listed, polars

_SENSOR = {
    "sensor", "sensorid", "sensorname", "sensorindex", "device", "deviceid", "instance", "imu", "compass", "magid",
}  # fmt: skip
"""Names of columns that identify the sensor of a row."""

_KIND = {
    "id", "type", "sensortype", "topic", "source", "msg", "msgtype", "message", "channel", "node", "addr", "address",
}  # fmt: skip
"""Names of columns that may identify the sensor of a row; they count only if the sensors alternate."""

_TURNS = 0.2
"""Smallest share of rows that differ from the row before if sensors alternate."""

_MOST = 16
"""Most sensors of a table."""

_FEWEST = 9
"""Fewest rows of a sensor; an ellipsoid needs nine."""


def with_row_sensors(topics: Sequence[Topic]) -> list[Topic]:
    """Split a file's only table into a topic for each sensor if a column identifies the sensor of each row.

    The table must have a magnetometer's columns, or columns x, y, z and a sensor such as ``MAG``.

    Example:
        >>> import polars as pl
        >>> columns = {"sensor": ["a", "b"] * 20, "mag_x": [1.0, 2.0] * 20, "mag_y": [0.0] * 40, "mag_z": [0.0] * 40}
        >>> table = Table(list(columns), [pl.Series(values) for values in columns.values()], range(40), "row")
        >>> [(topic.name, topic.table.series[0][1]) for topic in with_row_sensors([Topic("", table)])]
        [('a', 1.0), ('b', 2.0)]
    """
    if len(topics) != 1:
        return list(topics)
    for name, series in zip(topics[0].table.names, topics[0].table.series, strict=True):
        word = re.sub(r"[\W_]+", "", name).lower()
        if word not in _SENSOR | _KIND:
            continue
        labels = _labels(series)
        if labels is None or (word in _KIND and not _take_turns(labels)):
            continue
        values = labels.unique(maintain_order=True).to_list()
        if _are_sensors(topics[0].table.names, values):
            return [_part(topics[0], name, labels, value, values) for value in values]
    return list(topics)


def _labels(series: Any) -> Any | None:
    """The cells of a column as text; None unless the column has a few values that occur often."""
    package = polars()
    if series.dtype.is_float() or series.dtype.is_nested() or series.dtype.is_temporal():
        return None
    labels = series.cast(package.String).str.strip_chars()
    counts = labels.value_counts()
    if labels.null_count() or not 2 <= len(counts) <= _MOST or int(counts["count"].min()) < _FEWEST:
        return None
    plain = labels.unique()
    return None if bool((plain == "").any() | plain.str.contains(r"^[+-]?\d*\.\d").any()) else labels


def _take_turns(labels: Any) -> bool:
    return int((labels != labels.shift(1)).sum() or 0) >= _TURNS * len(labels)


def _axes(names: Sequence[str]) -> list[str]:
    meanings = {name: meaning(name) for name in names if name}
    return [name for name, known in meanings.items() if known is not None and known.quantity == "mag"]


def _are_sensors(names: Sequence[str], values: Sequence[str]) -> bool:
    if len(_axes(names)) == len("xyz"):
        return True
    return {"x", "y", "z"} <= {name.lower() for name in names} and any(map(is_about_magnetometer, values))


def _part(topic: Topic, column: str, labels: Any, value: str, values: Sequence[str]) -> Topic:
    """The rows of a sensor; if it is not a magnetometer, its axes are renamed to x, y, z."""
    rows = labels == value
    table = topic.table
    called = [_called(column, other) for other in values]
    kept = [i for i, name in enumerate(table.names) if name != column]
    names = [table.names[i] for i in kept]
    known = meaning(f"{value}_x")
    if known is not None and known.quantity != "mag":
        axes = dict(zip(_axes(names), "xyz", strict=False))
        names = [axes.get(name, name) for name in names]
    lines = [line for line, taken in zip(table.lines, rows.to_list(), strict=True) if taken]
    note = Note(f"The column `{column}` identifies the sensor of each row: {listed(called)}.")
    part = Table(names, [table.series[i].filter(rows) for i in kept], lines, table.line)
    correction = topic.correction
    if correction is not None and correction.offsets is not None:
        correction = correction._replace(offsets=correction.offsets[rows.to_numpy()])
    return Topic(_called(column, value), part, topic.units, (*topic.warnings, note), correction=correction)


def _called(column: str, value: str) -> str:
    return f"{column}{value}" if value.lstrip("+-").isdigit() else value
