"""Correct the clocks of loggers: counters that turn over, and clocks coarser than the sampling interval."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float

_DAY, _WEEK = 86_400, 604_800
_CLOSE = 5.0
"""Largest step over the end of a counter, in median intervals."""

_STILL = 0.5
"""Smallest share of rows that repeat the time of the row before if the clock is coarser than the samples."""

_LARGEST = 1e100
"""Largest magnitude of a measured value; larger values are ignored."""

_PERIODS = (2, 3, 4)
"""Numbers of sensors whose rows may alternate."""

_APART = 4.0
"""Smallest ratio of two median distances if rows of several sensors alternate: to the row before, and to the row one
period before. With a single sensor the row before is closer; for a sensor that does not move, noise makes the two
distances equal."""


def turned_over(values: Float[np.ndarray, " N"], unit: float) -> tuple[Float[np.ndarray, " N"], int]:
    """The correction that unwraps a counter, and the value at which it turned over; 0 if it did not.

    A counter of 16 or 32 bits, or the seconds of the day or of the GPS week, turned over where it falls from just
    below its end to just above 0, such that the unwrapped step is at most five median intervals.

    Args:
        values: values of the counter.
        unit: its unit in s.

    Example:
        >>> added, end = turned_over(np.array([65510.0, 65530.0, 14.0, 34.0]), 1e-3)
        >>> added.tolist(), end
        ([0.0, 0.0, 65536.0, 65536.0], 65536)
    """
    added = np.zeros(len(values))
    rows = np.flatnonzero(np.isfinite(values))
    steps = np.diff(values[rows])
    forward = steps[steps > 0]
    if len(forward) == 0 or not (steps < 0).any():
        return added, 0
    interval = float(np.median(forward))
    ends = [2**16, 2**32, *(round(span / unit) for span in (_DAY, _WEEK))]
    for k in np.flatnonzero(steps < 0):
        before, after = float(values[rows[k]]), float(values[rows[k + 1]])
        for end in ends:
            if 0.0 <= after < before < end and after + end - before <= _CLOSE * interval:
                added[rows[k + 1] :] += end
                return _more(values, added, rows, end, interval), end
    return added, 0


def _more(values: np.ndarray, added: np.ndarray, rows: np.ndarray, end: int, interval: float) -> np.ndarray:
    """Add the further turns of a counter whose end is known."""
    steps = np.diff((values + added)[rows])
    for k in np.flatnonzero(steps < 0):
        if steps[k] + end <= _CLOSE * interval:
            added[rows[k + 1] :] += end
    return added


def spread(
    time: Float[np.ndarray, " N"], values: Float[np.ndarray, "N k"]
) -> tuple[Float[np.ndarray, " N"], int] | None:
    """Spread samples that share a time stamp evenly up to the next stamp.

    Args:
        time: times in the order of the rows.
        values: values of the sensor, which distinguish samples of equal time from duplicate rows.

    Returns:
        The times, and the largest number of samples that shared a stamp; None if the clock is fine enough.

    Example:
        >>> spread(np.array([0.0, 0.0, 1.0, 1.0, 1.0, 1.0]), np.arange(6.0)[:, None])[0].tolist()
        [0.0, 0.5, 1.0, 1.25, 1.5, 1.75]
    """
    steps = np.diff(time)
    still = (steps == 0) & (values[1:] != values[:-1]).any(-1)
    if len(still) < 2 or still.mean() < _STILL or not (steps >= 0).all() or interleaved(values):
        return None
    begins = np.flatnonzero(np.concatenate([[True], steps > 0]))
    if len(begins) < 2:
        return None
    counts = np.diff(np.append(begins, len(time)))
    lengths = np.diff(time[begins])
    usual = float(np.median(lengths))
    lengths = np.append(np.minimum(lengths, _CLOSE * usual), usual)
    place = np.arange(len(time)) - np.repeat(begins, counts)
    return time + place * np.repeat(lengths / counts, counts), int(counts.max())


def interleaved(values: Float[np.ndarray, "N k"]) -> int:
    """The number of sensors whose rows alternate in the table; 0 if rows do not alternate.

    Example:
        >>> turn = np.linspace(0.0, 6.0, 200)
        >>> interleaved(np.stack([np.cos(turn), np.cos(turn) + 9.0], -1).reshape(-1, 1)), interleaved(turn[:, None])
        (2, 0)
    """
    values = values[np.isfinite(values).all(-1) & (np.abs(values) < _LARGEST).all(-1)]
    if len(values) < 40 * max(_PERIODS):
        return 0
    size = {lag: float(np.median(np.linalg.norm(values[lag:] - values[:-lag], axis=-1))) for lag in (1, *_PERIODS)}
    for period in _PERIODS:
        if size[1] > _APART * size[period] > 0:
            return period
    return 0
