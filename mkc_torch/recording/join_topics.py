"""Resample the columns of a log's other topics at the times of its magnetometer."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from mkc_torch._support.note import Note
from mkc_torch.recording.clock import ClockError, TimeAxis, clock_of
from mkc_torch.recording.conversions import converted, quantity_of
from mkc_torch.recording.formats.base import Topic, counted, listed
from mkc_torch.recording.formats.cells import as_numbers
from mkc_torch.recording.recognise import companion_columns, time_column
from mkc_torch.recording.unit_words import conversion

if TYPE_CHECKING:
    from jaxtyping import Float

_GAP = 10.0
"""Longest interval, in median intervals of a topic, across which values are interpolated."""


class ResampledColumns(NamedTuple):
    """Columns at the magnetometer's times, with NaN for missing values, and warnings."""

    columns: dict[str, np.ndarray]
    warnings: list[str]


def join_topics(topics: Sequence[Topic], own: int, clock: TimeAxis, there: set[str]) -> ResampledColumns:
    """Interpolate gyroscope, accelerometer, attitude, temperature and current of other topics linearly.

    Args:
        topics: topics of the file.
        own: index of the magnetometer's topic.
        clock: times of the magnetometer.
        there: names of the columns that its topic already has.
    """
    columns: dict[str, np.ndarray] = {}
    warnings: list[str] = []
    for number, names, units in companion_columns(topics, own):
        topic = topics[number]
        mine = {new: old for new, old in names.items() if new not in there and new not in columns}
        other = _clock(topic)
        if not mine or other is None:
            continue
        at, times = _on_one_axis(clock, other)
        values = []
        for new, old in mine.items():
            series = topic.table.series[topic.table.names.index(old)]
            numbers, bad = as_numbers(series)
            if bad.any():
                break
            known = conversion(quantity_of(new) or "", units.get(new, ""))
            values.append(converted(series, numbers, known).fill_null(float("nan")).to_numpy())
        if len(values) < len(mine):
            continue
        table = np.stack(values, -1)
        found = interpolated(at, times, _one_sign(table) if "q_w" in mine else table)
        if "q_w" in mine:
            found = found / np.linalg.norm(found, axis=-1, keepdims=True)
        missing = int(np.isnan(found).any(-1).sum())
        columns |= dict(zip(mine, found.T, strict=True))
        without = f"; {counted(missing, 'sample')} outside of its times or in its gaps have no value" if missing else ""
        how = f"of topic `{topic.name}`, interpolated linearly at the magnetometer's times"
        warnings.append(Note(f"{listed(mine)}: {how}{without}."))
    return ResampledColumns(columns, warnings)


def interpolated(
    at: Float[np.ndarray, " N"], times: Float[np.ndarray, " M"], values: Float[np.ndarray, "M k"]
) -> Float[np.ndarray, "N k"]:
    """Interpolate linearly; NaN outside of the samples, and in gaps of more than ten median intervals.

    Args:
        at: times at which values are needed, in s.
        times: times of the values in s, in any order; repeated times count once.
        values: a row for each time.

    Example:
        >>> interpolated(np.array([0.5, 3.0]), np.array([0.0, 1.0]), np.array([[0.0], [2.0]]))
        array([[ 1.],
               [nan]])
    """
    usable = np.isfinite(times) & np.isfinite(values).all(-1)
    times, first = np.unique(times[usable], return_index=True)
    values = values[usable][first]
    if len(times) < 2:
        return np.full((len(at), values.shape[-1]), np.nan)
    right = np.clip(np.searchsorted(times, at, side="left"), 1, len(times) - 1)
    step = times[right] - times[right - 1]
    share = ((at - times[right - 1]) / step)[:, None]
    found = values[right - 1] + share * (values[right] - values[right - 1])
    outside = ~((at >= times[0]) & (at <= times[-1])) | (step > _GAP * np.median(np.diff(times)))
    exact = times[right] == at
    found[exact] = values[right][exact]
    found[outside & ~exact] = np.nan
    return found


def _clock(topic: Topic) -> TimeAxis | None:
    named = time_column(topic)
    if named is None:
        return None
    try:
        return clock_of(topic.table.series[topic.table.names.index(named[0])], named[1])
    except ClockError:
        return None


def _on_one_axis(clock: TimeAxis, other: TimeAxis) -> tuple[np.ndarray, np.ndarray]:
    """Times of two topics in s, with a common origin."""
    if clock.ticks is None or other.ticks is None:
        return clock.seconds, other.seconds
    begin = clock.ticks[int(np.isfinite(clock.seconds).argmax())]
    return _from(clock, clock.ticks, begin), _from(other, other.ticks, begin)


def _from(clock: TimeAxis, ticks: np.ndarray, begin: np.int64) -> np.ndarray:
    return np.where(np.isnan(clock.seconds), np.nan, (ticks - begin) / 1e9)


def _one_sign(quaternions: np.ndarray) -> np.ndarray:
    """Choose the signs of quaternions so that the dot products of neighbours are not negative."""
    dots = (quaternions[1:] * quaternions[:-1]).sum(-1)
    signs = np.concatenate([[1.0], np.cumprod(np.where(dots < 0.0, -1.0, 1.0))])
    return quaternions * signs[:, None]
